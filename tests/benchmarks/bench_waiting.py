"""How long a labeller at the page waits for the next pair while the service trains, in a whole service.

The labeller answers every `--pause` seconds, and a reward version is trained after every sixth of the labels. The label
budget is larger than what is given, so that pairs are due whenever the labeller asks. A wait is the time from asking
for a pair until both of its clips have been received; the first one includes the service's start and the first rollout.
The page asks for the next pair while the present one is shown, so that people notice only waits beyond their answer.

    python tests/benchmarks/bench_waiting.py [--labels 60] [--pause 4] [--teacher recency] [--task HalfCheetah-6x1]
        [--pacing wait|labels|free]
"""

import argparse
import statistics
import time
from pathlib import Path
from tempfile import TemporaryDirectory

from accord.api.schemas import BatchLabel, Query
from accord.cli.own_service import OwnService
from accord.cli.teach import SegmentReader, TeacherChoice, judge
from accord.client import Client
from accord.domain.enums import Role

POLL_SECONDS = 0.1
#: label budget over labels given
BUDGET_FACTOR = 8
#: longer than any start
LONGEST_WAIT_SECONDS = 180.0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--labels", type=int, default=60)
    parser.add_argument("--pause", type=float, default=4.0)
    parser.add_argument("--teacher", default="recency")
    parser.add_argument("--task", default="HalfCheetah-6x1")
    parser.add_argument("--pacing", default="wait")
    arguments = parser.parse_args()
    with TemporaryDirectory() as folder:
        service = OwnService(Path(folder), {})
        try:
            client = Client(service.url(), service.token("labeller", Role.RESEARCHER))
            settings = {
                "name": "waiting",
                "task": arguments.task,
                "pacing": arguments.pacing,
                "label_budget": BUDGET_FACTOR * arguments.labels,
                "initial_labels": max(2, arguments.labels // 6),
                "labels_per_version": max(1, arguments.labels // 6),
            }
            experiment = client.create_experiment(**settings).id
            waits = label(client, experiment, TeacherChoice.parse(arguments.teacher), arguments.labels, arguments.pause)
            state = client.experiment(experiment)
            client.close()
        finally:
            service.close()
    first, rest = waits[0], sorted(waits[1:])
    print(
        f"{arguments.task}, {arguments.labels} labels of {arguments.teacher}, one every {arguments.pause:g} s, pacing"
        f" {arguments.pacing}; reward versions {state.reward_version}, {state.steps:,} steps"
    )
    print(
        f"wait for the first pair {first:.1f} s; later waits: median {statistics.median(rest):.2f} s,"
        f" 95% below {rest[int(0.95 * len(rest))]:.2f} s, longest {rest[-1]:.2f} s"
    )


def label(client: Client, experiment: str, choice: TeacherChoice, labels: int, pause: float) -> list[float]:
    """Label one pair at a time; return the seconds of each wait."""
    teacher = choice.teacher(0)
    reader, waits = SegmentReader(client, teacher), list[float]()
    while len(waits) < labels:
        started = time.perf_counter()
        query = _next_pair(client, experiment)
        for side in (query.left, query.right):
            assert side.clip_url is not None  # the task is rendered
            client.get_bytes(side.clip_url.removeprefix("/api/v1"))
        waits.append(time.perf_counter() - started)
        time.sleep(pause)
        answer = judge(teacher, reader, [query])[0]
        client.put_labels(experiment, [BatchLabel(query_id=query.id, label=answer, teacher=teacher.parameters())])
    return waits


def _next_pair(client: Client, experiment: str) -> Query:
    deadline = time.monotonic() + LONGEST_WAIT_SECONDS
    while time.monotonic() < deadline:
        items = client.next_queries(experiment, returns=True).items
        if items:
            return items[0]
        time.sleep(POLL_SECONDS)
    raise TimeoutError(f"no pair within {LONGEST_WAIT_SECONDS:.0f} s")


if __name__ == "__main__":
    main()
