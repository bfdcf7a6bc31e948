"""Environment steps a second: a task beside the bare physics and beside gymnasium-robotics.

`bare physics` is mujoco.batch with the same model, threads and substeps, given controls and nothing else;
`MaMuJoCo` is one environment of gymnasium-robotics with the same partition. All take turns in short rounds, so that a
busy machine slows them alike; rates and shares are medians over rounds.

    python tests/benchmarks/bench_tasks.py [rounds] [task ...]
"""

import os
import statistics
import sys
import time
from collections.abc import Callable

import numpy as np
from gymnasium_robotics import mamujoco_v1
from mujoco.batch import Batch

from mapt.tasks import load_model, make_task, task_spec

TASKS = ("HalfCheetah-6x1", "Ant-4x2", "Humanoid-9|8")
N_ENVS = (16, 64)
#: Environment steps of one figure in one round: 50 to 400 ms.
STEPS_PER_ROUND = 3_200
MAMUJOCO_STEPS_PER_ROUND = 200
AIM_OF_PHYSICS, AIM_OVER_MAMUJOCO = 0.8, 4.0


def bare_physics(task_name: str, n_envs: int, n_threads: int) -> Callable[[], int]:
    """A round of nothing but controls and physics."""
    model = load_model(task_name)
    batch = Batch(model, n_envs, nthread=n_threads)
    controls = batch.bind("ctrl")
    limit = model.actuator_ctrlrange[0, 1]
    frame_skip = round(task_spec(task_name).step_seconds / model.opt.timestep)
    draws = np.random.default_rng(0).uniform(-limit, limit, (STEPS_PER_ROUND // n_envs, n_envs, model.nu))

    def play() -> int:
        for draw in draws:
            controls[:] = draw
            batch.step(nstep=frame_skip)
        # Bodies that have fallen collide more than those of a task, which begin anew.
        batch.reset()
        return STEPS_PER_ROUND

    return play


def whole_task(task_name: str, n_envs: int, n_threads: int) -> Callable[[], int]:
    """A round of steps with observations, rewards, ends and resets."""
    task = make_task(task_name, n_envs, n_threads=n_threads)
    task.reset(0)
    limit = task.spec.action_limit
    shape = (STEPS_PER_ROUND // n_envs, n_envs, task.spec.n_agents, task.spec.action_dim)
    draws = np.random.default_rng(0).uniform(-limit, limit, shape).astype(np.float32)

    def play() -> int:
        task.reset(0)
        for draw in draws:
            task.step(draw)
        return STEPS_PER_ROUND

    return play


def mamujoco(task_name: str) -> Callable[[], int]:
    """A round of one environment of gymnasium-robotics, with its resets."""
    env = mamujoco_v1.parallel_env(*task_name.split("-"), agent_obsk=1)
    env.reset(seed=0)
    actions = {agent: env.action_space(agent).sample() for agent in env.possible_agents}

    def play() -> int:
        for _ in range(MAMUJOCO_STEPS_PER_ROUND):
            env.step(actions)
            if not env.agents:
                env.reset()
        return MAMUJOCO_STEPS_PER_ROUND

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


def share(ours: list[float], theirs: list[float]) -> float:
    return statistics.median(one / other for one, other in zip(ours, theirs, strict=True))


def compare(names: tuple[str, ...], rounds: int, n_threads: int) -> bool:
    """Print the table of tasks; true if every one reaches the aims."""
    print(f"{'task':<18}{'E':>5}{'bare physics':>15}{'MaMuJoCo':>10}{'task':>10}{'share':>8}{'times':>8}")
    reached = True
    for name in names:
        for n_envs in N_ENVS:
            contestants = bare_physics(name, n_envs, n_threads), mamujoco(name), whole_task(name, n_envs, n_threads)
            bare, theirs, task = rates(rounds, *contestants)
            of_physics, over_mamujoco = share(task, bare), share(task, theirs)
            reached &= of_physics >= AIM_OF_PHYSICS and over_mamujoco >= AIM_OVER_MAMUJOCO
            medians = "".join(f"{statistics.median(seen):>{width},.0f}" for seen, width in ((bare, 15), (theirs, 10)))
            print(
                f"{name:<18}{n_envs:>5}{medians}{statistics.median(task):>10,.0f}{of_physics:>8.0%}{over_mamujoco:>8.1f}"
            )
    return reached


def main() -> int:
    rounds = int(sys.argv[1]) if len(sys.argv) > 1 else 21
    names = tuple(sys.argv[2:]) or TASKS
    n_threads = os.cpu_count() or 1
    print(f"environment steps a second, {n_threads} threads, median of {rounds} rounds")
    reached = compare(names, rounds, n_threads)
    aims = f"{AIM_OF_PHYSICS:.0%} of the bare physics and {AIM_OVER_MAMUJOCO:.0f} times MaMuJoCo"
    print(f"aims: {aims}: {'reached' if reached else 'MISSED'}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
