"""kill -9 each process in turn during a run, and go on."""

import io

import av

from acceptance.accord_service import STEPS_PER_ITERATION, TINY, Accord, Person, alive
from accord.workers.policy_run import CHECKPOINT_ITERATIONS
from support.waiting import PATIENCE_SECONDS, until

#: who is killed once so many labels are acknowledged
VICTIMS = {"render": 2, "reward": 10, "policy": 16, "api": 20, "child": 24, "supervisor": 30}


def test_no_process_is_missed_when_it_is_killed(accord: Accord) -> None:
    accord.start()
    person = Person(accord, accord.token("ada", "researcher"))
    id = person.begin()
    acknowledged: dict[str, float] = {}
    steps = [0]

    def label_until(count: int) -> None:
        def enough() -> bool:
            acknowledged.update(person.label_some(id))
            steps.append(person.experiment(id)["steps"])
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
        experiment = person.experiment(id)
        steps.append(experiment["steps"])
        assert experiment["status"] in {"running", "finished"}, experiment["phase_detail"]
        return experiment["status"] == "finished"

    until(finished, "the experiment finishes")
    assert_page_is_told(accord)
    assert_labels_kept(accord, id, acknowledged)
    assert_training_went_on(accord, id, steps)
    assert_clips_whole(accord)


def assert_page_is_told(accord: Accord) -> None:
    """Deaths are counted anew by each supervisor: the last one killed none of its own."""
    assert dict(accord.rows("SELECT id, restarts FROM workers")) == {"policy-0": 0, "render-0": 0, "reward-0": 0}


def kill(accord: Accord, role: str) -> None:
    """kill -9 one process; the supervisor, or its parent, brings another."""
    victim = until(lambda: accord.processes().get(role), f"{role} runs")
    victim.kill()
    until(lambda: (found := accord.processes().get(role)) and found.pid != victim.pid, f"another {role} runs")
    if role in {"render", "reward", "policy"}:
        row = "SELECT 1 FROM workers WHERE role = ? AND restarts = 1"
        until(lambda: accord.rows(row, role), f"the page is told that {role} was started again")


def kill_supervisor(accord: Accord) -> None:
    """kill -9 the parent: nothing of it may go on. Then start again."""
    family = list(until(accord.all_up, "all processes run").values())
    accord.supervisor.kill()
    accord.supervisor.wait(PATIENCE_SECONDS)
    until(lambda: not any(alive(process) for process in family), "nothing outlives the supervisor")
    accord.start()


def assert_labels_kept(accord: Accord, id: str, acknowledged: dict[str, float]) -> None:
    stored = dict(accord.rows("SELECT query_id, value FROM labels WHERE experiment_id = ? AND state = 'label'", id))
    assert acknowledged.items() <= stored.items()
    used = accord.rows("SELECT max(label_count) FROM reward_versions WHERE experiment_id = ?", id)
    assert used == [(TINY["label_budget"],)]


def assert_training_went_on(accord: Accord, id: str, steps: list[int]) -> None:
    """Never back by more than a checkpoint's distance, and a curve without holes."""
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


def assert_clips_whole(accord: Accord) -> None:
    ready = accord.rows("SELECT blob_key, frames FROM clips WHERE status = 'ready'")
    assert ready
    for blob_key, frames in ready:
        with av.open(io.BytesIO((accord.home / "blobs" / blob_key).read_bytes())) as container:
            assert sum(1 for _ in container.decode(video=0)) == frames == TINY["segment_steps"]
