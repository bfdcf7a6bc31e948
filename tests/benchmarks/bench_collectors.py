"""Rollouts by actors of a Ray cluster on this machine beside those of one process, and where a cluster begins to pay.

For each number of slots: environment steps per second of whole iterations with the true reward, CPU seconds of all
processes per million steps, megabytes that cross between processes per iteration, and whether the rollouts have the
bits of the same slots in one process. Without Ray installed, only one process is measured.

The forecast needs no cluster: from the measured times of collecting and updating, and the measured bytes, it computes
iterations with a network of the given latency and bandwidth between the run and its actors, which have a core each.

With --simulate, the same is run: actors of a Ray cluster collect, but steps and updates sleep instead of computing, so
that a few cores simulate many nodes, and each transfer waits as long as the network would take.

    python tests/benchmarks/bench_collectors.py [--task HalfCheetah-6x1] [--algorithm mappo] [--slots 1 2 4]
        [--iterations 4] [--n-envs 64] [--latency-ms 0.5] [--megabytes-per-second 100] [--simulate]
"""

import argparse
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import psutil
from numpy.typing import NDArray

from mapt.cluster import load_ray
from mapt.policies import Learner, PolicyConfig, Rollout
from mapt.policies import slots as policy_slots
from mapt.policies.networks import Policy
from mapt.policies.slots import SlotCollector, SlotState
from mapt.tasks import Task, TaskStep, WrappedTask, make_task

#: seconds of an update per step of its rollout: MAPPO, HalfCheetah-6x1
_UPDATE_SECONDS = 0.4e-3
#: seconds of a step of one environment
_SIMULATED_STEPS = (0.19e-3, 0.76e-3, 3e-3, 12e-3)
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
    network = Network(arguments.latency_ms / 1000, arguments.megabytes_per_second * 1e6)
    if arguments.simulate:
        _simulate(arguments.task, config, arguments.slots, arguments.iterations, network)
        return
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
    _forecast(plain, network, steps)


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


@dataclass(frozen=True, slots=True)
class Network:
    """Between the run and its actors. All transfers share the one connection of the run."""

    #: seconds
    latency: float
    bytes_per_second: float

    def iteration(self, bytes_moved: float) -> float:
        """Seconds that an iteration waits: for the weights to arrive, and for the rollouts to come back."""
        return 2 * self.latency + bytes_moved / self.bytes_per_second


def _forecast(plain: Measured, network: Network, steps: int) -> None:
    print(f"forecast with a core for each slot, {_name(network)}:")
    print(f"{'collecting costs':>18}" + "".join(f"{slots:>9}" for slots in _FORECAST_SLOTS) + "  slots")
    for factor in (1, 4, 16, 64):
        collect = factor * plain.collect
        moved = network.iteration(plain.megabytes * 1e6)
        gains = [_gain(collect, plain.update, slots, moved) for slots in _FORECAST_SLOTS]
        rate = f"{1e6 * collect / steps:,.0f} us/step"
        print(f"{rate:>18}" + "".join(f"{gain:>8.2f}x" for gain in gains))


def _gain(collect: float, update: float, slots: int, moved: float) -> float:
    """How many times as fast a run is as one without actors, computed."""
    return (collect + update) / (collect / slots + moved + update)


def _name(network: Network) -> str:
    return f"{1000 * network.latency:g} ms and {network.bytes_per_second / 1e6:g} MB/s"


class SleepingTask(WrappedTask):
    """A task that sleeps in each step, and whose observations never change.

    The time that the policy takes between two steps is part of the next one.

    Args:
        step_seconds: a file with the seconds that a step of one environment takes, so that actors need not start again
            for another number.
    """

    def __init__(self, task: Task, step_seconds: Path) -> None:
        super().__init__(task)
        self._step_seconds = step_seconds
        self._last: TaskStep | None = None
        self._ended = 0.0

    def step(self, actions: NDArray[np.floating]) -> TaskStep:
        self._last = self._last or super().step(actions)
        seconds, now = self.n_envs * float(self._step_seconds.read_text()), time.perf_counter()
        # The first step of a rollout comes long after the one before.
        self._ended = max(self._ended, now - seconds) + seconds
        time.sleep(max(0.0, self._ended - now))
        return self._last


def sleeping_task(name: str, n_envs: int, step_seconds: Path) -> Task:
    return SleepingTask(make_task(name, n_envs, n_threads=1), step_seconds)


class DistantActors(policy_slots._SlotActors):
    """Actors behind a network, which this process waits for."""

    network = Network(0.0, float("inf"))

    def begin(self, policy: Policy, n_steps: int, seeds: Sequence[int], states: Sequence[SlotState]) -> dict[int, Any]:
        weights = sum(tensor.nbytes for tensor in policy.state_dict().values())
        sent = sum(weights + _bytes_of_arrays(state) for state in states)
        time.sleep(self.network.latency + sent / self.network.bytes_per_second)
        return super().begin(policy, n_steps, seeds, states)

    def result(self, slot: int, reference: Any) -> tuple[Rollout, SlotState] | None:
        found = super().result(slot, reference)
        assert found is not None
        rollout, state = found
        # The results of all slots are on their way at once, but follow each other through one connection.
        latency = self.network.latency if slot == 0 else 0.0
        time.sleep(latency + (_bytes_of(rollout) + _bytes_of_arrays(state)) / self.network.bytes_per_second)
        return found


def _bytes_of_arrays(arrays: Mapping[str, NDArray[Any]]) -> int:
    return sum(array.nbytes for array in arrays.values())


def _simulate(task: str, config: Any, slots: Sequence[int], iterations: int, network: Network) -> None:
    """Print how many times as fast runs with actors are as one without, simulated and computed."""
    steps = config().steps_per_rollout
    update = steps * _UPDATE_SECONDS
    policy_slots._SlotActors = DistantActors
    DistantActors.network = network
    load_ray().init("local", num_cpus=max(slots), include_dashboard=False, log_to_driver=False)
    gains: dict[float, list[str]] = {}
    with tempfile.TemporaryDirectory() as folder:
        step_seconds = Path(folder) / "step_seconds"
        step_seconds.write_text("0")
        for number in slots:
            chosen = config(collectors=number)
            make = partial(sleeping_task, task, chosen.envs_per_collector, step_seconds)
            learner = Learner(make(), chosen, make)
            collector = learner._collector
            assert isinstance(collector, SlotCollector)
            while collector.n_ready < number:
                time.sleep(0.1)
            rollout = learner.collect()
            weights = sum(tensor.nbytes for tensor in learner.policy.state_dict().values())
            states = sum(_bytes_of_arrays(state) for state in collector._states)
            moved = network.iteration(_bytes_of(rollout) + number * weights + 2 * states)
            for seconds in _SIMULATED_STEPS:
                step_seconds.write_text(str(seconds))
                taken = []
                for _ in range(iterations):
                    began = time.perf_counter()
                    learner.collect()
                    time.sleep(update)
                    taken.append(time.perf_counter() - began)
                simulated = (steps * seconds + update) / float(np.median(taken))
                computed = _gain(steps * seconds, update, number, moved)
                gains.setdefault(seconds, []).append(f"{simulated:.2f}x / {computed:.2f}x")
            del learner, collector
    print(f"{task}, {steps:,} steps an iteration, {_name(network)}: simulated / computed")
    print(f"{'a step takes':>14}" + "".join(f"{f'{number} slots':>18}" for number in slots))
    for seconds, row in gains.items():
        print(f"{f'{1000 * seconds:g} ms':>14}" + "".join(f"{gain:>18}" for gain in row))


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", default="HalfCheetah-6x1")
    parser.add_argument("--algorithm", default="mappo")
    parser.add_argument("--slots", type=int, nargs="+", default=(1, 2, 4))
    parser.add_argument("--iterations", type=int, default=4)
    parser.add_argument("--n-envs", type=int, default=64)
    parser.add_argument("--latency-ms", type=float, default=0.5)
    parser.add_argument("--megabytes-per-second", type=float, default=100.0)
    parser.add_argument("--simulate", action="store_true")
    return parser.parse_args()


if __name__ == "__main__":
    main()
