"""Rollouts by actors of a Ray cluster on this machine beside those of one process, and where a cluster begins to pay.

For each number of slots: environment steps per second of whole iterations with the true reward, CPU seconds of all
processes per million steps, megabytes that cross between processes per iteration, and whether the rollouts have the
bits of the same slots in one process. Without Ray installed, only one process is measured.

The forecast needs no cluster: from the measured times of collecting and updating, and the measured bytes, it computes
iterations with a network of the given latency and bandwidth between the run and its actors, which have a core each.

    python tests/benchmarks/bench_collectors.py [--task HalfCheetah-6x1] [--algorithm mappo] [--slots 1 2 4]
        [--iterations 4] [--n-envs 64] [--latency-ms 0.5] [--megabytes-per-second 100]
"""

import argparse
import time
from dataclasses import dataclass, fields
from functools import partial
from importlib.util import find_spec

import numpy as np
import psutil

from mapt.cluster import load_ray
from mapt.policies import Learner, PolicyConfig, Rollout
from mapt.policies.slots import SlotCollector
from mapt.tasks import make_task

_FORECAST_SLOTS = (1, 2, 4, 8, 16, 32, 64)


@dataclass(frozen=True, slots=True)
class Measured:
    """An iteration: seconds of collecting and updating, CPU seconds of all processes, megabytes, and its rollout."""

    collect: float
    update: float
    cpu: float
    megabytes: float
    rollout: Rollout


def main() -> None:
    arguments = _arguments()
    config = partial(PolicyConfig.named, arguments.algorithm, n_envs=arguments.n_envs, device="cpu")
    steps = config().steps_per_rollout
    print(f"{arguments.task}, {arguments.algorithm}, {arguments.n_envs} environments, {steps:,} steps an iteration")
    print(f"{'':<22}{'steps/s':>9}{'collecting':>12}{'updating':>10}{'CPU s per million steps':>25}{'MB':>8}  equal")
    plain = _measure(arguments.task, config(), arguments.iterations)
    _print("one stream", plain, steps)
    inside = {
        slots: _measure(arguments.task, config(collectors=slots), arguments.iterations) for slots in arguments.slots
    }
    for slots, measured in inside.items():
        _print(f"{slots} slots, one process", measured, steps)
    if find_spec("ray") is not None:
        # One core for each actor, whether the machine has them or not.
        load_ray().init(num_cpus=max(arguments.slots), include_dashboard=False, log_to_driver=False)
        for slots, expected in inside.items():
            measured = _measure(arguments.task, config(collectors=slots), arguments.iterations, actors=True)
            _print(f"{slots} slots, {slots} actors", measured, steps, _equal(measured.rollout, expected.rollout))
    print()
    _forecast(plain, arguments.latency_ms / 1000, arguments.megabytes_per_second, steps)


def _measure(task: str, config: PolicyConfig, iterations: int, *, actors: bool = False) -> Measured:
    """The median iteration after a first one, and the last rollout."""
    make = partial(make_task, task, config.envs_per_collector, n_threads=1)
    learner = Learner(make(), config, make if actors else None)
    slots = learner._collector
    while actors and isinstance(slots, SlotCollector) and slots.n_ready < config.collectors:
        time.sleep(0.1)
    collecting: list[float] = []
    updating: list[float] = []
    for iteration in range(iterations + 1):
        if iteration == 1:
            cpu = _cpu_seconds()
        started = time.perf_counter()
        rollout = learner.collect()
        collected = time.perf_counter()
        learner.update(rollout, rollout.rewards)
        collecting.append(collected - started)
        updating.append(time.perf_counter() - collected)
    used = (_cpu_seconds() - cpu) / iterations
    sent = sum(tensor.nbytes for tensor in learner.policy.state_dict().values()) * max(1, config.collectors)
    megabytes = (_bytes_of(rollout) + sent) / 1e6
    return Measured(float(np.median(collecting[1:])), float(np.median(updating[1:])), used, megabytes, rollout)


def _cpu_seconds() -> float:
    """CPU seconds of this process and those that it started: a local cluster is among them."""
    here = psutil.Process()
    found = 0.0
    for process in (here, *here.children(recursive=True)):
        times = process.cpu_times()
        found += times.user + times.system
    return found


def _bytes_of(rollout: Rollout) -> int:
    arrays = (getattr(rollout, field.name) for field in fields(Rollout))
    return sum(array.nbytes for array in arrays if array is not None)


def _equal(one: Rollout, other: Rollout) -> bool:
    return all(np.array_equal(getattr(one, each.name), getattr(other, each.name)) for each in fields(Rollout))


def _print(name: str, measured: Measured, steps: int, equal: bool | None = None) -> None:
    rate = steps / (measured.collect + measured.update)
    million = measured.cpu / steps * 1e6
    said = "" if equal is None else "yes" if equal else "NO"
    print(
        f"{name:<22}{rate:>9,.0f}{measured.collect:>11.2f}s{measured.update:>9.2f}s{million:>25,.0f}"
        f"{measured.megabytes:>8.1f}  {said}"
    )


def _forecast(plain: Measured, latency: float, megabytes_per_second: float, steps: int) -> None:
    print(f"forecast with a core for each slot, {1000 * latency:g} ms and {megabytes_per_second:g} MB/s:")
    print(f"{'collecting costs':>18}" + "".join(f"{slots:>9}" for slots in _FORECAST_SLOTS) + "  slots")
    for factor in (1, 4, 16, 64):
        collect = factor * plain.collect
        alone = collect + plain.update
        # Every slot's part of the rollout comes through the one network connection of the run.
        moved = 2 * latency + plain.megabytes / megabytes_per_second
        gains = [alone / (collect / slots + moved + plain.update) for slots in _FORECAST_SLOTS]
        rate = f"{1e6 * collect / steps:,.0f} us/step"
        print(f"{rate:>18}" + "".join(f"{gain:>8.2f}x" for gain in gains))


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", default="HalfCheetah-6x1")
    parser.add_argument("--algorithm", default="mappo")
    parser.add_argument("--slots", type=int, nargs="+", default=(1, 2, 4))
    parser.add_argument("--iterations", type=int, default=4)
    parser.add_argument("--n-envs", type=int, default=64)
    parser.add_argument("--latency-ms", type=float, default=0.5)
    parser.add_argument("--megabytes-per-second", type=float, default=100.0)
    return parser.parse_args()


if __name__ == "__main__":
    main()
