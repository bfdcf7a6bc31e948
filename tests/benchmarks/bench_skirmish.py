"""Environment steps per CPU-second of the skirmish maps, and how often random, scripted and trained teams win them.

One process, one thread. The targets are the rates of jaxmarl's SMAX on a CPU with the same number of environments. The
time includes observations, states, masks and the states for drawing, which the collector reads in each step. Nearest
attacks the nearest enemy that it can, focus the one with the least health and shield; both walk east where there is
none, and heal the agent with the least health. Trained teams play with mean actions.

    python tests/benchmarks/bench_skirmish.py [MAP=RUN ...]

RUN is the folder of a run of `mapt train`, or a checkpoint.
"""

import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mapt.policies.episodes import play_with
from mapt.tasks import make_task, task_spec
from mapt.tasks.skirmish.features import EAST, FIRST_TARGET, STOP
from mapt.tasks.skirmish.maps import MAPS
from mapt.tasks.skirmish.task import Skirmish
from mapt.training.run_folder import load_policy

N_ENVS = 64
#: rounds of the measurement, and steps of every environment in each
ROUNDS, STEPS = 5, 150
EPISODES = 256
#: steps per CPU-second of SMAX, which has no MMM2
TARGETS = {"3m": 26_313, "3s5z": 7_605, "6h_vs_8z": 8_372}

#: (task, observations (E, N, C), available actions (E, N, A)) -> actions (E, N)
Team = Callable[[Skirmish, NDArray, NDArray], NDArray]


def random_team(seed: int) -> Team:
    rng = np.random.default_rng(seed)
    return lambda _task, _observations, available: (available * rng.random(available.shape)).argmax(axis=2)


def scripted_team(name: str, *, focus: bool) -> Team:
    """Agents attack the nearest enemy, or the weakest."""
    units = next(battle_map for battle_map in MAPS if battle_map.name == name).units
    n = task_spec(name).n_agents
    healers = [agent for agent in range(n) if units[agent].heals]
    health = np.array([unit.health for unit in units])

    def choose(task: Skirmish, _observations: NDArray, available: NDArray) -> NDArray:
        state = task.simulator_state()[0].reshape(task.n_envs, len(units), 5)
        x, y = state[..., 0], state[..., 1]
        apart = np.hypot(x[:, :n, None] - x[:, None, n:], y[:, :n, None] - y[:, None, n:])
        strength = np.broadcast_to(state[:, None, n:, 2:4].sum(axis=3), apart.shape)
        targets = available[..., FIRST_TARGET : FIRST_TARGET + len(units) - n]
        ranked = np.where(targets, strength if focus else apart, np.inf)
        actions = np.where(targets.any(axis=2), FIRST_TARGET + ranked.argmin(axis=2), EAST)
        for healer in healers:
            friends = available[:, healer, FIRST_TARGET : FIRST_TARGET + n]
            hurt = np.where(friends, state[:, :n, 2] / health[:n], np.inf)
            behind = x[:, healer] < x[:, :n].max(axis=1) - 2
            alone = np.where(behind, EAST, STOP)
            actions[:, healer] = np.where(hurt.min(axis=1) < 1, FIRST_TARGET + hurt.argmin(axis=1), alone)
        # At the east end of the map, and for the dead, the first action that is available.
        possible = np.take_along_axis(available, actions[..., None], 2)[..., 0]
        return np.where(possible, actions, available.argmax(axis=2))

    return choose


def trained_team(run: Path) -> Team:
    policy = load_policy(run, "cpu").policy
    return lambda _task, observations, available: policy.act(observations, None, available).argmax(axis=2)


def one_hot(task: Skirmish, actions: NDArray) -> NDArray:
    return np.eye(task.spec.action_dim, dtype=np.float32)[actions]


def steps_per_second(name: str) -> float:
    """Median over rounds, with random actions; choosing them does not count."""
    task, team = make(name), random_team(0)
    observations, _ = task.reset(0)
    rates = []
    for _ in range(ROUNDS):
        seconds = 0.0
        for _ in range(STEPS):
            actions = one_hot(task, team(task, observations, task.available_actions()))
            start = time.process_time()
            task.available_actions()
            task.simulator_state()
            observations = task.step(actions).observations
            seconds += time.process_time() - start
        rates.append(N_ENVS * STEPS / seconds)
    return statistics.median(rates)


def play(name: str, team: Team) -> tuple[float, float, float]:
    """Share of won episodes, mean return and mean length, over equally many episodes of each environment."""
    task = make(name)

    def act(observations: NDArray) -> NDArray:
        return one_hot(task, team(task, observations, task.available_actions()))

    played = play_with(act, task, EPISODES, seed=12345)
    assert played.successes is not None
    return float(played.successes.mean()), float(played.returns.mean()), float(played.lengths.mean())


def make(name: str) -> Skirmish:
    task = make_task(name, N_ENVS)
    assert isinstance(task, Skirmish)
    return task


def main() -> int:
    runs = dict(argument.split("=", 1) for argument in sys.argv[1:])
    print(f"steps per CPU-second with {N_ENVS} environments, medians of {ROUNDS} rounds")
    for battle_map in MAPS:
        rate, target = steps_per_second(battle_map.name), TARGETS.get(battle_map.name)
        reached = "" if target is None else f"  SMAX {target:,}: {'reached' if rate >= target else 'MISSED'}"
        print(f"{battle_map.name:<10}{rate:>8,.0f}{reached}", flush=True)
    print(f"\n{EPISODES} episodes: won, mean return, mean steps")
    for name in [battle_map.name for battle_map in MAPS]:
        teams = {
            "random": random_team(1),
            "nearest": scripted_team(name, focus=False),
            "focus": scripted_team(name, focus=True),
        }
        if name in runs:
            teams["trained"] = trained_team(Path(runs[name]))
        for label, team in teams.items():
            won, mean_return, steps = play(name, team)
            print(f"{name:<10}{label:<10}{won:>5.0%}{mean_return:>8.1f}{steps:>7.1f}", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
