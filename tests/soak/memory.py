"""Memory of the server's process over many requests of every kind, as a page, programs and strangers send them.

Prints the resident memory every tenth of the requests. It must not grow with their number.

    python tests/soak/memory.py [--requests 50000] [--database sqlite|postgres]
"""

import argparse
import itertools
import sys
import tempfile
from collections import Counter
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))
sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))

import httpx
import psutil
from bench_load import database_url

from accord.domain.enums import Role
from accord.services import metrics
from support.api_process import running_server
from support.plain_http import PLAIN_HTTP
from support.sample_experiments import create_sample, user
from support.stores import Stores, open_stores

#: requests before the first measurement, in which caches and thread pools fill
WARM_UP = 2000


def requests(experiment: str, query: str, clip: str) -> list[tuple[str, str, object]]:
    """Method, path and body of one request of each kind; None for no body."""
    path = f"/api/v1/experiments/{experiment}"
    return [
        ("POST", f"{path}/queries/next", {}),
        ("PUT", f"/api/v1/queries/{query}/label", {"label": 1}),
        ("PUT", f"/api/v1/queries/{query}/label", {"label": 0}),
        ("PUT", f"/api/v1/queries/{query}/label", {"label": "both"}),
        ("GET", path, None),
        ("GET", f"{path}/metrics?max_points=300", None),
        ("GET", f"{path}/queries?limit=20", None),
        ("GET", f"{path}/quality", None),
        ("GET", f"{path}/costs", None),
        ("GET", f"{path}/labels/mine", None),
        ("GET", "/api/v1/experiments", None),
        ("GET", "/api/v1/experiments/exp_absent", None),
        ("GET", "/api/v1/me", None),
        ("GET", "/api/v1/ready", None),
        ("GET", clip, None),
        ("GET", "/", None),
        ("GET", f"{path}/events", None),
    ]


def fill(stores: Stores) -> tuple[str, str, list[str]]:
    """An experiment with curves and queries. Returns its id, a query, and tokens of all roles and a wrong one."""
    sample = create_sample(stores.database, stores.blobs, segments=20, queries=100, label_budget=100)
    with stores.database.transaction() as session:
        for step in range(1, 200):
            metrics.record(session, sample.experiment.id, step, {"labels": step, "entropy": 1 / step})
        tokens = [user(session, role.value, role)[1] for role in Role]
    return sample.experiment.id, sample.query_ids[0], [*tokens, "wrong"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--requests", type=int, default=50_000)
    parser.add_argument("--database", choices=["sqlite", "postgres"], default="sqlite")
    options = parser.parse_args()
    with (
        tempfile.TemporaryDirectory(prefix="accord-soak-") as folder,
        database_url(options.database) as url,
        open_stores(Path(folder), url) as stores,
    ):
        experiment, query, tokens = fill(stores)
        environment = {
            "ACCORD_DATABASE_URL": stores.database_url,
            "ACCORD_BLOB_URL": stores.blob_url,
            "ACCORD_FAILED_SIGN_INS_PER_MINUTE": "1000000",
        }
        with (
            running_server(Path(folder), environment) as server,
            httpx.Client(base_url=server.url, **PLAIN_HTTP) as http,
        ):
            teacher = {"Authorization": f"Bearer {tokens[list(Role).index(Role.TEACHER)]}"}
            [shown] = http.post(f"/api/v1/experiments/{experiment}/queries/next", headers=teacher, json={}).json()[
                "items"
            ]
            kinds = requests(experiment, query, shown["left"]["clip_url"])
            process = psutil.Process(server.process.pid)
            statuses: Counter[int] = Counter()
            sizes: list[float] = []
            every = max(1, options.requests // 10)
            mix = itertools.cycle(itertools.product(tokens, kinds))
            for number in range(WARM_UP + options.requests + 1):
                if number >= WARM_UP and (number - WARM_UP) % every == 0:
                    sizes.append(process.memory_info().rss / 1e6)
                    print(f"{number - WARM_UP:8} requests   {sizes[-1]:7.1f} MB resident", flush=True)
                token, (method, path, body) = next(mix)
                headers = {"Authorization": f"Bearer {token}"}
                with http.stream(method, path, json=body, headers=headers) as response:
                    statuses[response.status_code] += 1
                    if path.endswith("/events") and response.is_success:
                        next(response.iter_bytes())  # then the client goes away
                    else:
                        response.read()
            print(f"statuses: {dict(sorted(statuses.items()))}")
            later = len(sizes) // 2
            grown = (sizes[-1] - sizes[later]) / (options.requests - later * every) * 1e6
            print(f"growth in the second half: {grown:.0f} bytes a request")
            failed = sum(count for status, count in statuses.items() if status >= 500)
            assert failed == 0, f"{failed} requests failed"


if __name__ == "__main__":
    main()
