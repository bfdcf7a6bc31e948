"""Throughput of policy runs on two cores, for several assignments of threads and processes.

Environment steps per second with the true reward, collecting and updating:

    1 thread         one thread of torch, one of physics
    2 for physics    two threads of physics, as `mapt train` runs one seed
    2 for both       two threads of physics and two of torch
    2 processes      two runs with one thread of each in parallel, as `mapt train` runs several seeds

and microseconds per step of collecting alone: with `2 for physics`, and with the environments split into two halves,
each in a separate Python thread, so that the physics of one can overlap with the inference of the other.

    python tests/benchmarks/bench_overlap.py [--task HalfCheetah-6x1] [--algorithms mappo happo mat mat_dec]
        [--iterations 3]
"""

import argparse
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import get_args

import torch
from interleaved_timing import median_seconds

from mapt.policies import Algorithm, Learner, PolicyConfig
from mapt.processes import ParentConnection, run_jobs
from mapt.tasks import make_task

N_CORES = 2


@dataclass(frozen=True, slots=True)
class Variant:
    """A learner with its numbers of threads."""

    task: str
    algorithm: str
    iterations: int
    torch_threads: int = 1
    physics_threads: int = 1
    n_envs: int = PolicyConfig().n_envs

    def learner(self) -> Learner:
        config = PolicyConfig.named(self.algorithm, n_threads=self.torch_threads, n_envs=self.n_envs, device="cpu")
        return Learner(make_task(self.task, self.n_envs, n_threads=self.physics_threads), config)


def main() -> None:
    arguments = _arguments()
    print(f"{arguments.task}, environment steps per second; in parentheses relative to 1 thread")
    print(f"{'':<9}{'1 thread':>15}{'2 for physics':>18}{'2 for both':>18}{'2 processes':>18}", end="")
    print(f"{'collecting, us':>18}{'in halves':>12}")
    for algorithm in arguments.algorithms:
        variant = Variant(arguments.task, algorithm, arguments.iterations)
        one, physics, both = _rates(
            variant,
            Variant(variant.task, algorithm, variant.iterations, physics_threads=N_CORES),
            Variant(variant.task, algorithm, variant.iterations, torch_threads=N_CORES, physics_threads=N_CORES),
        )
        parallel = sum(done.result or 0.0 for done in run_jobs(rate_of, [variant] * N_CORES, N_CORES))
        print(f"{algorithm:<9}{one:>15,.0f}", end="")
        print("".join(f"{f'{rate:,.0f} ({rate / one:.2f})':>18}" for rate in (physics, both, parallel)), end="")
        whole, halves = _collecting(variant)
        print(f"{whole:>18.1f}{halves:>12.1f}", flush=True)


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", default="HalfCheetah-6x1")
    parser.add_argument("--algorithms", nargs="+", choices=get_args(Algorithm), default=list(get_args(Algorithm)))
    parser.add_argument("--iterations", type=int, default=3)
    return parser.parse_args()


def rate_of(variant: Variant, parent: ParentConnection) -> float:
    """Steps per second of one run; runs in a worker process."""
    return _rates(variant)[0]


def _rates(*variants: Variant) -> list[float]:
    """Steps per second of each, alternating; medians over iterations after the first."""
    learners = [variant.learner() for variant in variants]

    def iterate(learner: Learner) -> None:
        rollout = learner.collect()
        learner.update(rollout, rollout.rewards)

    seconds = median_seconds(
        time.perf_counter, variants[0].iterations, *(lambda learner=learner: iterate(learner) for learner in learners)
    )
    return [learner.config.steps_per_rollout / each for learner, each in zip(learners, seconds, strict=True)]


def _collecting(variant: Variant) -> tuple[float, float]:
    """Microseconds per step: all environments together, and two halves in a thread each."""
    whole = Variant(variant.task, variant.algorithm, variant.iterations, physics_threads=N_CORES).learner()
    halves = [
        Variant(variant.task, variant.algorithm, variant.iterations, n_envs=variant.n_envs // 2).learner()
        for _ in range(2)
    ]
    # torch's number of threads is set per Python thread.
    with ThreadPoolExecutor(2, initializer=lambda: torch.set_num_threads(1)) as pool:
        seconds = median_seconds(
            time.perf_counter, 3 * variant.iterations, whole.collect, lambda: list(pool.map(Learner.collect, halves))
        )
    whole_us, halves_us = (1e6 * each / whole.config.steps_per_rollout for each in seconds)
    return whole_us, halves_us


if __name__ == "__main__":
    main()
