"""Gradient steps per second of the algorithms that learn from stored behaviour, and OMAR beside a loop over agents.

OMAR's step evaluates both critics of every agent in one batched product per layer, a part of the batch at a time. The
loop trains the same networks in the same run, one agent after the other, as a team of single agents. Both are measured
with parts of the batch and with the whole batch at once. Figures are medians over rounds that alternate.

    python tests/benchmarks/bench_imitation.py [--task HalfCheetah-6x1] [--rounds 10] [--threads 1]
"""

import argparse
import os
import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch
from interleaved_timing import median_seconds

from mapt.imitation import omar
from mapt.imitation.cloning import CloningTrainer
from mapt.imitation.config import CloningConfig, MagailConfig, OMaplConfig, OmarConfig
from mapt.imitation.demonstrations import Demonstrations
from mapt.imitation.magail import DiscriminatorReward
from mapt.imitation.omapl import OMaplTrainer
from mapt.imitation.omar import PART_STEPS, OmarTrainer, make_omar
from mapt.policies import Learner, PolicyConfig
from mapt.preferences.dataset import PreferenceDataset, SegmentArrays
from mapt.tasks import TaskSpec, make_task

N_STEPS = 50


def in_parts(n_steps: int, trainers: list[OmarTrainer]) -> Callable[[], None]:
    """A gradient step of each trainer, with this number of steps in one pass."""

    def step() -> None:
        omar.PART_STEPS = n_steps
        for trainer in trainers:
            trainer.step()

    return step


def single_agents(learner: Learner, data: Demonstrations, config: OmarConfig) -> list[OmarTrainer]:
    """One trainer per agent, each with its own actor and critics."""
    spec, trainers = learner.task.spec, []
    for agent in range(spec.n_agents):
        dims = {"n_agents": 1, "agent_names": spec.agent_names[:1], "agent_action_dims": ()}
        own_spec: TaskSpec = replace(spec, **dims)
        own_policy = Learner(learner.task, learner.config).policy
        own_policy.spec = own_spec
        own_policy.actor = own_policy.get_submodule("actor").of_agent(agent)  # pyright: ignore[reportAttributeAccessIssue, reportCallIssue]
        own_policy.actor.normaliser = type(own_policy.actor.normaliser)(1, 1, spec.observation_dim, samples_dim=1)  # pyright: ignore[reportAttributeAccessIssue, reportCallIssue]
        own_data = replace(
            data, observations=data.observations[agent : agent + 1], actions=data.actions[agent : agent + 1]
        )
        trainers.append(make_omar(own_policy, own_data, config, seed=0))
    return trainers


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", default="HalfCheetah-6x1")
    parser.add_argument("--rounds", type=int, default=10)
    parser.add_argument("--threads", type=int, default=1)
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    load = "" if not hasattr(os, "getloadavg") else f", load average {os.getloadavg()[0]:.1f}"
    task = make_task(arguments.task, 32, n_threads=1)
    learner = Learner(task, PolicyConfig(device="cpu"))
    rollout = learner.collect()
    data = Demonstrations.from_rollout(rollout)
    print(f"{arguments.task}, torch {arguments.threads} thread(s){load}; gradient steps per CPU second")

    config = OmarConfig()
    batched, loop = make_omar(learner.policy, data, config, seed=0), single_agents(learner, data, config)
    ways = {
        f"{name}, {parts} steps at a time": in_parts(parts, trainers)
        for name, trainers in (("OMAR", [batched]), ("OMAR in a loop over agents", loop))
        for parts in (PART_STEPS, config.batch)
    }
    for name, seconds in zip(ways, median_seconds(time.process_time, arguments.rounds, *ways.values()), strict=True):
        print(f"{name}, batch {config.batch}: {1 / seconds:.1f}")

    whole = SegmentArrays(
        *(np.ascontiguousarray(each[:N_STEPS].swapaxes(0, 1)) for each in (rollout.observations, rollout.actions)),
        np.ones((32, N_STEPS), bool),
    )
    pairs = PreferenceDataset(whole, np.arange(32).reshape(-1, 2), np.ones(16, np.float32))
    source = DiscriminatorReward(data, task.spec, MagailConfig(), seed=0)
    calls = {
        f"cloning, batch {CloningConfig().batch}": CloningTrainer(learner.policy, data, CloningConfig(), seed=0).step,
        f"MAGAIL's discriminators, batch {MagailConfig().batch}": lambda: source.step(data),
        f"O-MAPL, {OMaplConfig().batch} pairs": OMaplTrainer(learner.policy, pairs, OMaplConfig(), seed=0).step,
    }
    for name, seconds in zip(calls, median_seconds(time.process_time, arguments.rounds, *calls.values()), strict=True):
        print(f"{name}: {1 / seconds:.1f}")
    task.close()


if __name__ == "__main__":
    main()
