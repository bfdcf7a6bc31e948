"""Environment steps per second of whole policy runs, and the time of each part.

Each algorithm alternates between the true reward and MAPT's reward, iteration by iteration, so that other load on the
machine affects both alike. Figures are medians over iterations, in microseconds per environment step:

    physics     steps of the task, including observations and resets
    inference   the rest of `Learner.collect`: sampling and recording actions
    reward      relabelling the rollout with a new MAPT `small`
    update      `Learner.update`

Upper bounds are measured in the same run: the task stepped alone with as many threads, and the matrix products of one
pass of an update alone, with the same shapes and layouts, as a fraction of the pass. GFLOP/s are those of the pass, of
its products alone, and of one product of 1,024 x 1,024 matrices. CPU seconds count every thread.

    python tests/benchmarks/bench_policies.py [--tasks HalfCheetah-6x1] [--algorithms mappo happo mat mat_dec]
        [--iterations 5] [--threads 1] [--physics-threads 2]
"""

import argparse
import os
import statistics
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Any, get_args

import numpy as np
import torch
from attention_model import model_with_active_attention
from interleaved_timing import median_seconds
from torch import Tensor
from torch.nn.attention import SDPBackend, sdpa_kernel
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils.flop_counter import FlopCounterMode

from mapt.policies import Algorithm, Learner, PolicyConfig, Rollout
from mapt.policies.ppo import make_batch, team_rewards
from mapt.rewards.config import RewardConfig
from mapt.rewards.relabelling import RolloutRelabeller
from mapt.tasks import Task, TaskStep, WrappedTask, make_task

SEGMENT_STEPS = 50
PARTS = ("physics", "inference", "reward", "update")
PRODUCTS = {torch.ops.aten.mm, torch.ops.aten.addmm, torch.ops.aten.bmm, torch.ops.aten.baddbmm}


@dataclass(slots=True)
class Clock:
    """Wall and CPU seconds of the parts of an iteration."""

    wall: dict[str, float] = field(default_factory=lambda: dict.fromkeys(PARTS, 0.0))
    cpu: dict[str, float] = field(default_factory=lambda: dict.fromkeys(PARTS, 0.0))

    @contextmanager
    def part(self, name: str) -> Iterator[None]:
        wall, cpu = time.perf_counter(), time.process_time()
        yield
        self.wall[name] += time.perf_counter() - wall
        self.cpu[name] += time.process_time() - cpu


class TimedTask(WrappedTask):
    """A task whose steps are timed as physics."""

    def __init__(self, task: Task) -> None:
        super().__init__(task)
        self.clock = Clock()

    def step(self, actions: np.ndarray) -> TaskStep:
        with self.clock.part("physics"):
            return super().step(actions)


class Run:
    """A learner and its reward."""

    def __init__(self, task_name: str, config: PolicyConfig, reward: str, physics_threads: int) -> None:
        self.name = reward
        self._task = TimedTask(make_task(task_name, config.n_envs, n_threads=physics_threads))
        self.learner = Learner(self._task, config)
        self._reward = (lambda rollout: rollout.rewards) if reward == "true" else self._mapt()
        self.clocks: list[Clock] = []

    def iterate(self) -> None:
        clock = self._task.clock = Clock()
        with clock.part("inference"):
            rollout = self.learner.collect()
        for times in (clock.wall, clock.cpu):
            times["inference"] -= times["physics"]
        with clock.part("reward"):
            rewards = self._reward(rollout)
        with clock.part("update"):
            self.learner.update(rollout, rewards)
        self.clocks.append(clock)

    def _mapt(self) -> Callable[[Rollout], np.ndarray]:
        spec, config = self._task.spec, self.learner.config
        sizes = {"observation_dim": spec.observation_dim, "action_dim": spec.action_dim, "n_agents": spec.n_agents}
        torch.manual_seed(0)
        model = model_with_active_attention(RewardConfig.preset("small", **sizes, segment_steps=SEGMENT_STEPS))
        relabeller = RolloutRelabeller(model, SEGMENT_STEPS, config.n_envs)
        return lambda rollout: relabeller.relabel(rollout.observations, rollout.actions, rollout.episode_start)


def main() -> None:
    arguments = _arguments()
    torch.set_num_threads(arguments.threads)
    load = "" if not hasattr(os, "getloadavg") else f", load average {os.getloadavg()[0]:.1f}"
    print(f"torch {arguments.threads} thread(s), physics {arguments.physics_threads}{load}")
    for task_name in arguments.tasks:
        steps, cpu = _physics_alone(task_name, arguments.physics_threads)
        print(f"\n{task_name}: physics alone {steps:,.0f} steps/s, {cpu * 1e6:.0f} CPU us a step")
        print(f"{'algorithm':<9}{'reward':<7}{'steps/s':>9}{'per CPU s':>11}", end="")
        print("".join(f"{part:>11}" for part in PARTS), " (wall us a step; CPU us below)")
        for algorithm in arguments.algorithms:
            _compare_rewards(task_name, algorithm, arguments)


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tasks", nargs="+", default=["HalfCheetah-6x1"])
    parser.add_argument("--algorithms", nargs="+", choices=get_args(Algorithm), default=list(get_args(Algorithm)))
    parser.add_argument("--iterations", type=int, default=5)
    parser.add_argument("--threads", type=int, default=1, help="of torch")
    parser.add_argument("--physics-threads", type=int, default=os.cpu_count() or 1)
    return parser.parse_args()


def _physics_alone(task_name: str, n_threads: int) -> tuple[float, float]:
    """Steps per second, and CPU seconds per step, of the task with random actions."""
    config = PolicyConfig()
    task = make_task(task_name, config.n_envs, n_threads=n_threads)
    task.reset(0)
    shape = (config.rollout_steps, config.n_envs, task.spec.n_agents, task.spec.action_dim)
    draws = np.random.default_rng(0).uniform(-1.0, 1.0, shape).astype(np.float32) * task.spec.action_limit
    wall: list[float] = []
    cpu: list[float] = []
    for _ in range(6):
        started, cpu_started = time.perf_counter(), time.process_time()
        for draw in draws:
            task.step(draw)
        wall.append(time.perf_counter() - started)
        cpu.append(time.process_time() - cpu_started)
    n_steps = config.steps_per_rollout
    return n_steps / statistics.median(wall[1:]), statistics.median(cpu[1:]) / n_steps


def _compare_rewards(task_name: str, algorithm: str, arguments: argparse.Namespace) -> None:
    config = PolicyConfig.named(algorithm, n_threads=arguments.threads, device="cpu")
    runs = [Run(task_name, config, reward, arguments.physics_threads) for reward in ("true", "MAPT")]
    for _ in range(arguments.iterations + 1):
        for run in runs:
            run.iterate()
    for run in runs:
        _print_run(algorithm, run, config.steps_per_rollout)
    print(f"{'':<9}{_one_pass(task_name, config)}", flush=True)


def _print_run(algorithm: str, run: Run, n_steps: int) -> None:
    clocks = run.clocks[1:]
    wall, cpu = (
        {part: statistics.median(times[part] for times in each) / n_steps for part in PARTS}
        for each in ([clock.wall for clock in clocks], [clock.cpu for clock in clocks])
    )
    rates = f"{1 / sum(wall.values()):>9,.0f}{1 / sum(cpu.values()):>11,.0f}"
    print(f"{algorithm:<9}{run.name:<7}{rates}" + "".join(f"{wall[part] * 1e6:>11.1f}" for part in PARTS))
    print(f"{'':<36}" + "".join(f"{cpu[part] * 1e6:>11.1f}" for part in PARTS))


class Products(TorchDispatchMode):
    """Records the matrix products that are computed, to repeat them alone."""

    def __init__(self) -> None:
        super().__init__()
        self.calls: list[tuple[Any, tuple[Any, ...], dict[str, Any]]] = []

    def __torch_dispatch__(self, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: Any = None) -> Any:
        if func.overloadpacket in PRODUCTS:
            self.calls.append((func, tuple(_like(argument) for argument in args), kwargs or {}))
        return func(*args, **(kwargs or {}))

    def run(self) -> None:
        for func, args, kwargs in self.calls:
            func(*args, **kwargs)


def _like(argument: object) -> object:
    """Random numbers of the same shape and layout."""
    if not isinstance(argument, Tensor):
        return argument
    return torch.empty_strided(argument.shape, argument.stride()).normal_()


def _one_pass(task_name: str, config: PolicyConfig) -> str:
    """CPU time of one pass over a rollout, of its matrix products alone, and of one large product."""
    learner = Learner(make_task(task_name, config.n_envs), replace(config, epochs=1))
    rollout = learner.collect()
    batch, _ = make_batch(learner.policy, rollout, team_rewards(rollout.rewards, rollout), config, config.gamma)

    def one_pass() -> None:
        learner._update.run(batch, torch.Generator().manual_seed(0))

    one_pass()
    # Neither counter sees inside fused attention; unfused attention is computed by matrix products.
    with sdpa_kernel(SDPBackend.MATH), FlopCounterMode(display=False) as counter:
        one_pass()
    with sdpa_kernel(SDPBackend.MATH), Products() as products:
        one_pass()
    square = torch.randn(1024, 1024)
    whole, alone, peak = median_seconds(time.process_time, 5, one_pass, products.run, lambda: square @ square)
    flops = counter.get_total_flops()
    return (
        f"products {alone / whole:.0%} of the update's CPU time; {flops / whole / 1e9:.0f} GFLOP/s, the products alone"
        f" {flops / alone / 1e9:.0f}, a large one {2 * 1024**3 / peak / 1e9:.0f}"
    )


if __name__ == "__main__":
    main()
