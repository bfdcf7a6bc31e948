"""Throughput of policy runs on two cores, for several ways to use them.

Environment steps per second with the true reward, collecting and updating:

    a thread each       one thread of torch, one of physics
    physics on two      two threads of physics, as `mapt train` runs one seed
    torch on two too    two threads of physics and two of torch
    runs at once        two runs with one thread of each at the same time, as `mapt train` runs several seeds

and microseconds per step of collecting alone: as `physics on two` does it, and with the environments split into two
halves, each in a Python thread of its own, so that the physics of one can overlap with the inference of the other.

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
class Way:
    """Settings of a learner to time."""

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
    print(f"{arguments.task}, environment steps per second; in brackets relative to one thread each")
    print(f"{'':<9}{'a thread each':>15}{'physics on two':>18}{'torch on two too':>18}{'runs at once':>18}", end="")
    print(f"{'collecting, us':>18}{'in halves':>12}")
    for algorithm in arguments.algorithms:
        way = Way(arguments.task, algorithm, arguments.iterations)
        one, physics, both = _rates(
            way,
            Way(way.task, algorithm, way.iterations, physics_threads=N_CORES),
            Way(way.task, algorithm, way.iterations, torch_threads=N_CORES, physics_threads=N_CORES),
        )
        at_once = sum(done.result or 0.0 for done in run_jobs(rate_of, [way] * N_CORES, N_CORES))
        print(f"{algorithm:<9}{one:>15,.0f}", end="")
        print("".join(f"{f'{rate:,.0f} ({rate / one:.2f})':>18}" for rate in (physics, both, at_once)), end="")
        whole, halves = _collecting(way)
        print(f"{whole:>18.1f}{halves:>12.1f}", flush=True)


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", default="HalfCheetah-6x1")
    parser.add_argument("--algorithms", nargs="+", choices=get_args(Algorithm), default=list(get_args(Algorithm)))
    parser.add_argument("--iterations", type=int, default=3)
    return parser.parse_args()


def rate_of(way: Way, parent: ParentConnection) -> float:
    """Steps per second of one run; runs in a worker process."""
    return _rates(way)[0]


def _rates(*ways: Way) -> list[float]:
    """Steps per second of each, alternating; medians over iterations after the first."""
    learners = [way.learner() for way in ways]

    def iterate(learner: Learner) -> None:
        rollout = learner.collect()
        learner.update(rollout, rollout.rewards)

    seconds = median_seconds(
        time.perf_counter, ways[0].iterations, *(lambda learner=learner: iterate(learner) for learner in learners)
    )
    return [learner.config.steps_per_rollout / each for learner, each in zip(learners, seconds, strict=True)]


def _collecting(way: Way) -> tuple[float, float]:
    """Microseconds per step: all environments together, and two halves in a thread each."""
    whole = Way(way.task, way.algorithm, way.iterations, physics_threads=N_CORES).learner()
    halves = [Way(way.task, way.algorithm, way.iterations, n_envs=way.n_envs // 2).learner() for _ in range(2)]
    # torch's number of threads is set per Python thread.
    with ThreadPoolExecutor(2, initializer=lambda: torch.set_num_threads(1)) as pool:
        seconds = median_seconds(
            time.perf_counter, 3 * way.iterations, whole.collect, lambda: list(pool.map(Learner.collect, halves))
        )
    together, apart = (1e6 * each / whole.config.steps_per_rollout for each in seconds)
    return together, apart


if __name__ == "__main__":
    main()
