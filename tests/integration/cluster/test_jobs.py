"""Jobs on a Ray cluster: what they tell, and what happens when they fail, their process or their node dies."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from integration.cluster.conftest import ENVIRONMENT, NODE
from mapt.cluster import JobPool, RayCluster, load_ray
from mapt.errors import InvalidConfig
from mapt.io import atomic_write
from mapt.processes import ParentConnection
from support.waiting import until


@pytest.fixture(scope="module")
def address(cluster: Any) -> Iterator[str]:
    node = cluster.add_node(**NODE)
    yield cluster.address
    cluster.remove_node(node)


def pool(address: str, folder: Path, workers: int = 0) -> JobPool:
    return JobPool(workers, RayCluster(address, folder))


def count(job: int, parent: ParentConnection) -> int:
    for number in range(job):
        parent.send(number)
    return 10 * job


def test_messages_come_in_order_and_before_the_result(address: str, tmp_path: Path) -> None:
    heard: list[tuple[int, int]] = []
    begun: list[int] = []
    done = pool(address, tmp_path).run(
        count, [3, 0, 2], on_start=begun.append, on_message=lambda job, news: heard.append((job, news))
    )
    results = {each.job: (each.result, each.failure, [news for job, news in heard if job == each.job]) for each in done}
    assert results == {3: (30, None, [0, 1, 2]), 0: (0, None, []), 2: (20, None, [0, 1])}
    assert sorted(begun) == [0, 2, 3]


def fail(job: str, parent: ParentConnection) -> None:
    raise InvalidConfig("a sentence") if job == "ours" else LookupError("nothing there")


def test_a_failed_job_leaves_the_others_alone(address: str, tmp_path: Path) -> None:
    done = {each.job: each.failure or "" for each in pool(address, tmp_path).run(fail, ["ours", "another"])}
    assert done["ours"] == "a sentence"
    assert done["another"].startswith("LookupError: nothing there")


def be_killed_twice(job: Path, parent: ParentConnection) -> int:
    attempts = len(list(job.iterdir()))
    (job / str(attempts)).touch()
    parent.send(attempts)
    if attempts < 2:
        os.kill(os.getpid(), signal.SIGKILL)
    return attempts


def test_a_killed_process_runs_its_job_again(address: str, tmp_path: Path) -> None:
    begun: list[Path] = []
    (done,) = pool(address, tmp_path).run(be_killed_twice, [tmp_path], on_start=begun.append)
    assert (done.result, done.failure) == (2, None)
    assert begun == [tmp_path]


def wait_until_cancelled(job: str, parent: ParentConnection) -> str:
    parent.send(job)
    while not parent.cancelled():
        time.sleep(0.01)
    return f"{job} ended"


def test_a_request_to_stop_ends_the_running_job_and_starts_no_other(address: str, tmp_path: Path) -> None:
    heard: list[str] = []
    done = pool(address, tmp_path).run(
        wait_until_cancelled,
        ["a", "b", "c"],
        on_message=lambda job, news: heard.append(news),
        should_stop=lambda: bool(heard),
    )
    assert [(each.job, each.result) for each in done] == [(heard[0], f"{heard[0]} ended")]
    assert len(heard) == 1


def be_alone(folder: Path, job: int, parent: ParentConnection) -> None:
    running = folder / "running"
    running.touch(exist_ok=False)
    for _ in range(40):  # enough for another process to start
        parent.cancelled()
        time.sleep(0.2)
    running.unlink()


def test_a_job_that_asks_whether_it_should_end_keeps_its_core(address: str, tmp_path: Path) -> None:
    done = list(pool(address, tmp_path).run(partial(be_alone, tmp_path), [0, 1]))
    assert [each.failure for each in done] == [None, None]


def test_a_node_without_the_folder_fails_the_job(address: str, tmp_path: Path) -> None:
    (done,) = pool(address, tmp_path / "elsewhere").run(count, [1])
    assert str(tmp_path / "elsewhere") in (done.failure or "")


def wait_for_removal(folder: Path, job: int, parent: ParentConnection) -> int:
    """On the node that is removed, wait for the end of this process, which may outlive its node for a moment."""
    own, removed = load_ray().get_runtime_context().get_node_id(), folder / "removed"
    parent.send(own)
    until(lambda: removed.exists() and removed.read_text() != own, "the removal of another node")
    return job


def test_a_job_moves_to_another_node_when_its_own_is_removed(cluster: Any, address: str, tmp_path: Path) -> None:
    lost = cluster.add_node(**NODE)
    heard: dict[int, list[str]] = {0: [], 1: []}

    def note(job: int, node: str) -> None:
        heard[job].append(node)
        if node == lost.node_id:
            cluster.remove_node(lost, allow_graceful=False)
            atomic_write(tmp_path / "removed", node.encode())

    done = pool(address, tmp_path).run(partial(wait_for_removal, tmp_path), [0, 1], on_message=note)
    assert {each.job: (each.result, each.failure) for each in done} == {0: (0, None), 1: (1, None)}
    [moved] = [nodes for nodes in heard.values() if nodes[0] == lost.node_id]
    assert len(moved) == 2
    assert moved[1] != lost.node_id


def test_a_local_cluster_has_room_for_more_than_this_machine_has_cores() -> None:
    """In a process of its own, since this one is connected to a cluster."""
    needs = {"CPU": 300.0, "GPU": 0.0, "policy": 3.0}
    program = f"from mapt.cluster import connect; print(connect('local', {needs}).cluster_resources())"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True, timeout=120)
    assert "'CPU': 300.0" in done.stdout
    assert "'policy': 3.0" in done.stdout


def test_an_unknown_cluster_is_refused(tmp_path: Path) -> None:
    """In a process of its own, since this one is connected to a cluster."""
    command = [sys.executable, "-m", "mapt.cli", "train", "--output", str(tmp_path), "--ray", "127.0.0.1:1"]
    done = subprocess.run(command, env=ENVIRONMENT, capture_output=True, text=True, check=False, timeout=120)
    assert done.returncode == 2
    assert "127.0.0.1:1" in done.stderr
