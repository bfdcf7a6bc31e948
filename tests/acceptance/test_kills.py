"""Kill each process of the service in turn during an experiment, which continues without loss."""

import io
import json
from contextlib import closing
from datetime import timedelta

import av
import pytest

from acceptance.accord_service import STEPS_PER_ITERATION, TINY, Accord, Client, alive
from accord.services import workers
from accord.store.database import Database
from accord.store.tables import ClaimRow, WorkerRow, utc_now
from accord.workers.policy_run import CHECKPOINT_ITERATIONS
from support.waiting import PATIENCE_SECONDS, until

pytestmark = pytest.mark.slow

#: the processes to kill, each with the number of acknowledged labels at which it is killed
VICTIMS = {"render": 2, "reward": 10, "policy": 16, "api": 20, "child": 24, "supervisor": 30}


def test_an_experiment_finishes_although_each_process_is_killed_once(accord: Accord) -> None:
    accord.start({"ACCORD_LOG_FORMAT": "json"})
    client = Client(accord, accord.token("ada", "researcher"))
    id = client.create_experiment()
    acknowledged: dict[str, float] = {}
    steps = [0]

    def label_until(count: int) -> None:
        def enough() -> bool:
            acknowledged.update(client.label_some(id))
            steps.append(client.experiment(id)["steps"])
            return len(acknowledged) >= count

        until(enough, f"{count} labels, after {list(VICTIMS)}")

    for victim, count in VICTIMS.items():
        label_until(count)
        if victim == "supervisor":
            kill_supervisor(accord)
        else:
            kill(accord, victim)
    label_until(TINY["label_budget"])

    def finished() -> bool:
        experiment = client.experiment(id)
        steps.append(experiment["steps"])
        assert experiment["status"] in {"running", "finished"}, experiment["phase_detail"]
        return experiment["status"] == "finished"

    until(finished, "the experiment finishes")
    assert_restarts_are_reset(accord)
    assert_labels_kept(accord, id, acknowledged)
    assert_training_continued(accord, id, steps)
    assert_clips_complete(accord)
    assert_policy_recorded(accord, id)
    assert_logged(accord, id)


def assert_logged(accord: Accord, id: str) -> None:
    """Every line of every process is JSON with its worker, those about the experiment with its id."""
    logs = {file.stem: [json.loads(line) for line in file.read_text().splitlines()] for file in accord.logs()}
    assert set(logs) == {"api", "policy-0", "render-0", "reward-0"}
    for name, lines in logs.items():
        assert {line["worker_id"] for line in lines} == {name}
    assert id in {line.get("experiment_id") for line in logs["policy-0"]}
    printed = [json.loads(line) for line in accord.log.read_text().splitlines() if line.startswith("{")]
    killed = {line["worker_id"] for line in printed if "killed by SIGKILL" in line["event"]}
    assert killed == {"api", "policy-0", "render-0", "reward-0"}


def assert_restarts_are_reset(accord: Accord) -> None:
    """Each supervisor counts restarts from zero, and no child of the last one was killed."""
    assert dict(accord.rows("SELECT id, restarts FROM workers")) == {"policy-0": 0, "render-0": 0, "reward-0": 0}


def kill(accord: Accord, role: str) -> None:
    """Kill one process and wait until its parent has started another."""
    victim = until(lambda: accord.processes().get(role), f"the {role} process runs")
    victim.kill()
    until(
        lambda: (current := accord.processes().get(role)) and current.pid != victim.pid, f"another {role} process runs"
    )
    if role in {"render", "reward", "policy"}:
        row = "SELECT 1 FROM workers WHERE role = ? AND restarts = 1"
        until(lambda: accord.rows(row, role), f"the restart of the {role} worker is stored")


def kill_supervisor(accord: Accord) -> None:
    """Kill the supervisor, wait until all its processes have ended, and start the service again."""
    processes = list(until(accord.all_running, "all processes run").values())
    accord.supervisor.kill()
    accord.supervisor.wait(PATIENCE_SECONDS)
    until(lambda: not any(alive(process) for process in processes), "all processes end with the supervisor")
    accord.start({"ACCORD_LOG_FORMAT": "json"})


def assert_labels_kept(accord: Accord, id: str, acknowledged: dict[str, float]) -> None:
    """Every acknowledged label is stored, and the last reward version used the whole budget."""
    stored = dict(accord.rows("SELECT query_id, value FROM labels WHERE experiment_id = ? AND state = 'label'", id))
    assert acknowledged.items() <= stored.items()
    used = accord.rows("SELECT max(label_count) FROM reward_versions WHERE experiment_id = ?", id)
    assert used == [(TINY["label_budget"],)]


def assert_training_continued(accord: Accord, id: str, steps: list[int]) -> None:
    """Training loses at most the iterations between two checkpoints, and every iteration has its metrics."""
    highest = 0
    for step in steps:
        highest = max(highest, step)
        assert highest - step <= CHECKPOINT_ITERATIONS * STEPS_PER_ITERATION
    curve = accord.rows(
        "SELECT step FROM metrics WHERE experiment_id = ? AND name = 'learned_return' ORDER BY step", id
    )
    total = TINY["total_steps"]
    assert [step for (step,) in curve] == list(range(STEPS_PER_ITERATION, total + 1, STEPS_PER_ITERATION))
    versions = accord.rows("SELECT number FROM reward_versions WHERE experiment_id = ? ORDER BY number", id)
    assert [number for (number,) in versions] == list(range(1, len(versions) + 1))


def assert_clips_complete(accord: Accord) -> None:
    ready = accord.rows("SELECT blob_key, frames FROM clips WHERE status = 'ready'")
    assert ready
    for blob_key, frames in ready:
        with av.open(io.BytesIO((accord.home / "blobs" / blob_key).read_bytes())) as container:
            assert sum(1 for _ in container.decode(video=0)) == frames == TINY["segment_steps"]


def assert_policy_recorded(accord: Accord, id: str) -> None:
    """There is one recording of the untrained policy, and one after each reward version that it learned from."""
    recorded = accord.rows(
        "SELECT r.policy_steps, coalesce(v.number, 0), r.blob_key FROM recordings r"
        " LEFT JOIN reward_versions v ON v.id = r.reward_version_id WHERE r.experiment_id = ? ORDER BY r.policy_steps",
        id,
    )
    used = accord.rows(
        "SELECT DISTINCT value FROM metrics WHERE experiment_id = ? AND name = 'reward_version' ORDER BY value", id
    )
    assert [number for _, number, _ in recorded] == [0, *(int(number) for (number,) in used)]
    assert (recorded[0][0], recorded[-1][0]) == (0, TINY["total_steps"])
    assert all((accord.home / "blobs" / key).is_file() for _, _, key in recorded)


def test_a_worker_and_a_server_that_hang_are_killed_and_restarted(accord: Accord) -> None:
    accord.start({"ACCORD_API_TIMEOUT_SECONDS": "1"}, without=["reward", "render", "child"])
    worker = until(lambda: accord.processes().get("policy"), "the policy worker runs")
    until(lambda: accord.rows("SELECT pid FROM workers WHERE id = 'policy-0'") == [(worker.pid,)], "it reports")
    server = accord.processes()["api"]
    for hung in (worker, server):
        hung.suspend()
    until(lambda: not alive(worker) and not alive(server), "they are killed")

    def replaced() -> bool:
        [(pid, state)] = accord.rows("SELECT pid, state FROM workers WHERE id = 'policy-0'")
        return pid not in (0, worker.pid) and state == "idle"

    until(replaced, "another worker works in its place")
    until(lambda: (api := accord.processes().get("api")) and api.pid != server.pid, "another server runs")
    assert accord.http.get(f"{accord.url}/api/v1/health", timeout=PATIENCE_SECONDS).is_success
    assert "unanswered" in accord.log.read_text()


def test_leases_of_before_the_clock_was_set_back_end(accord: Accord) -> None:
    accord.start(without=["policy", "reward", "render", "child"])
    ahead = utc_now() + timedelta(hours=1)
    with closing(Database.open(f"sqlite:///{accord.home / 'accord.db'}")) as database:
        with database.transaction() as session:
            session.add(ClaimRow(subject="policy:exp_1", holder="policy-0:1:a", expires_at=ahead))
            session.add(WorkerRow(id="policy-9", role="policy", pid=0, state="working", heartbeat_at=ahead))

        def ended() -> bool:
            with database.reading() as session:
                heartbeat = session.get_one(WorkerRow, "policy-9").heartbeat_at
                return workers.is_free(session, "policy:exp_1") and heartbeat <= utc_now()

        until(ended, "another worker may do the job")
    assert "the clock was set back" in accord.log.read_text()
