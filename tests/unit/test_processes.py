"""Worker processes: what they tell, and how they are ended."""

import os
import signal
import subprocess
import sys
import time
from multiprocessing import active_children
from pathlib import Path

import pytest

from mapt.errors import InvalidConfig
from mapt.processes import JobProcess, ParentConnection, end_job_processes, run_jobs, worker_slot


def count(job: int, parent: ParentConnection) -> int:
    for number in range(job):
        parent.send(number)
    return 10 * job


def wait_until_cancelled(job: str, parent: ParentConnection) -> str:
    parent.send(os.getpid())
    while not parent.cancelled():
        time.sleep(0.01)
    return f"{job} ended"


def fail(job: str, parent: ParentConnection) -> None:
    raise InvalidConfig("a sentence") if job == "ours" else LookupError("nothing there")


def test_what_is_told_comes_in_order_and_before_the_result():
    heard: list[tuple[int, int]] = []
    done = list(run_jobs(count, [3, 0, 2], 1, on_message=lambda job, news: heard.append((job, news))))
    assert heard == [(3, 0), (3, 1), (3, 2), (2, 0), (2, 1)]
    assert [(each.job, each.result, each.failure) for each in done] == [(3, 30, None), (0, 0, None), (2, 20, None)]


def test_a_wish_to_stop_ends_what_is_in_hand_and_begins_nothing():
    begun: list[str] = []
    heard: list[int] = []
    running = run_jobs(
        wait_until_cancelled,
        ["a", "b", "c"],
        2,
        on_start=begun.append,
        on_message=lambda job, news: heard.append(news),
        should_stop=lambda: len(heard) == 2,
    )
    assert sorted(done.result or "" for done in running) == ["a ended", "b ended"]
    assert begun == ["a", "b"]
    assert len(set(heard)) == 2
    assert not active_children()


@pytest.mark.parametrize(
    ("job", "failure"), [("ours", "a sentence"), ("another", "LookupError: nothing there (test_processes.py, line ")]
)
def test_an_error_of_this_library_is_its_sentence_another_says_where(job, failure):
    (done,) = run_jobs(fail, [job], 1)
    assert (done.failure or "").startswith(failure)
    assert done.result is None


def kill_itself(job: str, parent: ParentConnection) -> str:
    if job == "killed":
        os.kill(os.getpid(), signal.SIGKILL)
    return f"{job} ended"


def test_a_killed_worker_fails_only_its_own_job():
    killed, other = run_jobs(kill_itself, ["killed", "other"], 1)
    assert (killed.job, killed.result) == ("killed", None)
    assert "killed by SIGKILL" in (killed.failure or "")
    assert (other.result, other.failure) == ("other ended", None)


def return_or_wait(job: str, parent: ParentConnection) -> str:
    return job if job == "quick" else wait_until_cancelled(job, parent)


def slot_of_two(job: int, parent: ParentConnection) -> int:
    parent.send(job)
    while not parent.cancelled():
        time.sleep(0.01)
    return worker_slot()


def test_workers_that_run_side_by_side_have_different_slots():
    started: list[int] = []
    both = run_jobs(
        slot_of_two, [0, 1], 2, on_message=lambda job, _: started.append(job), should_stop=lambda: len(started) == 2
    )
    assert sorted((done.job, done.result) for done in both) == [(0, 0), (1, 1)]
    assert worker_slot() == 0


def test_closing_the_iterator_ends_the_workers():
    running = run_jobs(return_or_wait, ["quick", "long"], 2)
    assert next(running).result == "quick"
    assert active_children()
    running.close()
    assert not active_children()


def test_leaving_early_ends_the_workers():
    def leave(job: str, news: int) -> None:
        raise RuntimeError("enough")

    with pytest.raises(RuntimeError, match="enough"):
        list(run_jobs(wait_until_cancelled, ["a"], 1, on_message=leave))
    assert not active_children()


class Sum:
    """A job function that keeps what it was given."""

    def __init__(self, start: int) -> None:
        self._total = start

    def __call__(self, job: int, parent: ParentConnection) -> int:
        if job == 0:
            raise InvalidConfig("Zero adds nothing.")
        if job < 0:
            os.kill(os.getpid(), signal.SIGKILL)
        self._total += job
        return self._total


def test_a_job_process_keeps_its_state_and_reports_failures():
    one, other = processes = [JobProcess(Sum(10)), JobProcess(Sum(20))]
    for process in processes:
        process.send(1)
    assert [process.receive().result for process in processes] == [11, 21]
    one.send(0)
    assert one.receive().failure == "Zero adds nothing."
    one.send(5)
    assert one.receive().result == 16
    one.send(-1)
    assert "killed by SIGKILL" in (one.receive().failure or "")
    other.send(2)
    assert other.receive().result == 23
    end_job_processes(processes)
    assert not active_children()


def test_a_signal_to_the_whole_group_leaves_workers_to_their_parent():
    process = JobProcess(Sum(10))
    process.send(1)
    assert process.receive().result == 11
    (worker,) = active_children()
    assert worker.pid is not None
    os.kill(worker.pid, signal.SIGTERM)
    process.send(2)
    assert process.receive().result == 13
    end_job_processes([process])
    assert worker.exitcode == 0


LEAVES_A_PROCESS = """
from mapt.processes import JobProcess


def doubled(job, parent):
    return 2 * job


if __name__ == "__main__":
    process = JobProcess(doubled)
    process.send(4)
    print(process.receive().result)
"""


def test_a_program_that_leaves_its_processes_open_ends_at_once(tmp_path: Path):
    program = tmp_path / "program.py"
    program.write_text(LEAVES_A_PROCESS)
    ended = subprocess.run([sys.executable, program], timeout=20, capture_output=True, text=True, check=False)
    assert (ended.returncode, ended.stdout, ended.stderr) == (0, "8\n", "")


def sum_in_a_process(job: int, parent: ParentConnection) -> int:
    process = JobProcess(Sum(1))
    process.send(job)
    result = process.receive().result
    end_job_processes([process])
    return result


def test_a_job_may_have_a_process_of_its_own():
    (done,) = run_jobs(sum_in_a_process, [41], 1)
    assert (done.result, done.failure) == (42, None)
