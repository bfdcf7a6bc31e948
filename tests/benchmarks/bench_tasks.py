"""Environment steps a second: a task alone beside the bare physics, and a learner's rollouts and updates.

`bare physics` is mujoco.batch with the same model, threads and substeps, given controls and nothing else. All take
turns in short rounds, so that a busy machine slows them alike; rates and shares are medians over rounds.

    python tests/benchmarks/bench_tasks.py [rounds]
"""

import os
import statistics
import sys
import time
from collections.abc import Callable

import numpy as np
from mujoco.batch import Batch

from mapt.policies import Learner, PolicyConfig, true_reward
from mapt.tasks import load_model, make_task, task_names
from mapt.tasks.half_cheetah import FRAME_SKIP

N_ENVS = (16, 32, 64)
#: Environment steps of one figure in one round: some 50 ms.
STEPS_PER_ROUND = 3_200
AIM = 0.8


def bare_physics(task_name: str, n_envs: int, n_threads: int) -> Callable[[], int]:
    """A round of nothing but controls and physics."""
    model = load_model(task_name)
    batch = Batch(model, n_envs, nthread=n_threads)
    controls = batch.bind("ctrl")
    draws = np.random.default_rng(0).uniform(-1, 1, (STEPS_PER_ROUND // n_envs, n_envs, model.nu))

    def play() -> int:
        for draw in draws:
            controls[:] = draw
            batch.step(nstep=FRAME_SKIP)
        return STEPS_PER_ROUND

    return play


def whole_task(task_name: str, n_envs: int, n_threads: int) -> Callable[[], int]:
    """A round of steps with observations, rewards, ends and resets."""
    task = make_task(task_name, n_envs, n_threads=n_threads)
    task.reset(0)
    shape = (STEPS_PER_ROUND // n_envs, n_envs, task.spec.n_agents, task.spec.action_dim)
    draws = np.random.default_rng(0).uniform(-1, 1, shape).astype(np.float32)

    def play() -> int:
        for draw in draws:
            task.step(draw)
        return STEPS_PER_ROUND

    return play


def learner(task_name: str, n_threads: int, update: bool) -> Callable[[], int]:
    """A round of one rollout, with or without the update, under the default configuration."""
    config = PolicyConfig(device="cpu")
    trained = Learner(make_task(task_name, config.n_envs, n_threads=n_threads), config)

    def play() -> int:
        rollout = trained.collect()
        if update:
            trained.update(rollout, true_reward(rollout))
        return config.steps_per_rollout

    return play


def rates(rounds: int, *contestants: Callable[[], int]) -> list[list[float]]:
    """Steps a second of each contestant in each round, after one round to warm up."""
    seen: list[list[float]] = [[] for _ in contestants]
    for turn in range(rounds + 1):
        for play, rounds_seen in zip(contestants, seen, strict=True):
            start = time.perf_counter()
            n_steps = play()
            if turn:
                rounds_seen.append(n_steps / (time.perf_counter() - start))
    return seen


def compare_with_bare_physics(rounds: int, n_threads: int) -> bool:
    """Print the table of tasks; true if every one reaches the aim."""
    print(f"{'task':<18}{'E':>5}{'bare physics':>15}{'task':>10}{'share':>8}")
    shares: list[float] = []
    for name in task_names():
        for n_envs in N_ENVS:
            bare, task = rates(rounds, bare_physics(name, n_envs, n_threads), whole_task(name, n_envs, n_threads))
            shares.append(statistics.median(ours / theirs for ours, theirs in zip(task, bare, strict=True)))
            medians = f"{statistics.median(bare):>15,.0f}{statistics.median(task):>10,.0f}"
            print(f"{name:<18}{n_envs:>5}{medians}{shares[-1]:>8.0%}")
    return min(shares) >= AIM


def main() -> int:
    rounds = int(sys.argv[1]) if len(sys.argv) > 1 else 51
    n_threads = os.cpu_count() or 1
    print(f"environment steps a second, {n_threads} threads, median of {rounds} rounds")
    reached = compare_with_bare_physics(rounds, n_threads)
    print(f"aim: {AIM:.0%} of the bare physics: {'reached' if reached else 'MISSED'}\n")

    print(f"{'task':<18}{'rollout':>15}{'rollout + update':>20}")
    for name in task_names():
        seen = rates(max(1, rounds // 5), *(learner(name, n_threads, update) for update in (False, True)))
        rollout, update = map(statistics.median, seen)
        print(f"{name:<18}{rollout:>15,.0f}{update:>20,.0f}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
