"""Rollouts that actors of a cluster collect."""

import os
import signal
from dataclasses import fields
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from integration.cluster.conftest import NODE
from mapt.cluster import connect
from mapt.policies import PolicyConfig, Rollout
from mapt.policies.learner import untrained_policy
from mapt.policies.slots import RemoteSlots, SlotCollector
from mapt.tasks import Task, TaskStep, WrappedTask, make_task
from support.waiting import until

CONFIG = PolicyConfig(n_envs=4, collectors=2, rollout_steps=30, minibatches=1, epochs=1, hidden=(8,), seed=4)


def slot_task() -> Task:
    return make_task("Reacher-2x1", CONFIG.envs_per_collector, n_threads=1)


class DeadlyTask(WrappedTask):
    """A task whose second rollout kills the process, once."""

    def __init__(self, task: Task, killed: Path) -> None:
        super().__init__(task)
        self._killed, self._steps = killed, 0

    def step(self, actions: NDArray[np.floating]) -> TaskStep:
        self._steps += 1
        if self._steps == CONFIG.rollout_steps + 5 and not self._killed.exists():
            self._killed.touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return super().step(actions)


def deadly_task(killed: Path) -> Task:
    return DeadlyTask(slot_task(), killed)


def collector(make: Any = None) -> SlotCollector:
    task = slot_task()
    remote = None if make is None else RemoteSlots(make, partial(untrained_policy, task.spec, CONFIG), 1)
    return SlotCollector(task, 2, 7, remote)


def collect(slots: SlotCollector, seed: int) -> Rollout:
    policy = untrained_policy(slot_task().spec, CONFIG)
    return slots.collect(policy, CONFIG.rollout_steps, torch.Generator().manual_seed(seed))


def assert_equal(one: Rollout, other: Rollout) -> None:
    for field in fields(Rollout):
        np.testing.assert_array_equal(getattr(one, field.name), getattr(other, field.name), err_msg=field.name)


def test_rollouts_of_actors_have_the_bits_of_those_in_process_although_one_dies(cluster: Any, tmp_path: Path) -> None:
    here = collector()
    expected = [collect(here, seed) for seed in range(4)]
    node = cluster.add_node(**NODE | {"num_cpus": 2})
    connect(cluster.address, {"CPU": 1})
    killed = tmp_path / "killed"
    slots = collector(partial(deadly_task, killed))
    until(lambda: slots.n_ready == 2, "two actors")
    assert_equal(collect(slots, 0), expected[0])
    assert not killed.exists()
    assert_equal(collect(slots, 1), expected[1])
    assert killed.exists()
    assert_equal(collect(slots, 2), expected[2])
    until(lambda: slots.n_ready == 2, "a new actor")
    assert_equal(collect(slots, 3), expected[3])
    cluster.remove_node(node)


def test_without_room_for_actors_slots_are_collected_in_process(cluster: Any) -> None:
    connect(cluster.address, {"CPU": 1})
    slots = collector(slot_task)
    assert_equal(collect(slots, 5), collect(collector(), 5))
    assert slots.n_ready == 0
