"""Engine steps per second of the football tasks, beside their engine alone and Google Research Football.

All run in the same number of processes. `engine` replays a recorded round of the task with equal actions and seeds,
without observations, and must end in the same states. `gfootball` is Google Research Football's own environment with
its observation `simple115v2` and the same actions. All alternate in short rounds, so that other load slows them
equally. Rates and shares are medians over rounds; each rate contains the starts of episodes. `share` is the task's rate
over the engine's by wall time, `CPU` the same by the CPU time of all processes, which other load disturbs less: in the
task, all matches wait for the slowest in each step. `times` is the task's rate over gfootball's.

    python tests/benchmarks/bench_football.py [rounds] [processes]
"""

import io
import logging
import statistics
import sys
import time
import warnings
from collections.abc import Callable, Sequence
from contextlib import redirect_stderr
from dataclasses import dataclass
from typing import Any

import numpy as np
import psutil
from numpy.typing import NDArray

from mapt.processes import JobProcess, ParentConnection, end_job_processes
from mapt.tasks import make_task
from mapt.tasks.football.engine import INSTALL, EngineMatch, is_installed
from mapt.tasks.football.scenarios import SCENARIOS, Scenario
from mapt.tasks.football.task import Football

#: of each match in a round
STEPS = 60
TARGET = 0.95
_SEEDS = 2**31


@dataclass(frozen=True, slots=True)
class Round:
    """L steps of E matches."""

    #: int (L, E, N)
    actions: NDArray[np.int64]
    #: of the first matches (E,), and of the next one after each step (L, E)
    first_seeds: NDArray[np.int64]
    seeds: NDArray[np.int64]
    #: bool (L, E): the step was played on the engine, not spent in the last state of a match; it ended the match
    played: NDArray[np.bool_]
    over: NDArray[np.bool_]
    #: (E, nq): the last states of the engine
    states: NDArray[np.float64]


def football(scenario: Scenario, n_envs: int) -> Football:
    task = make_task(scenario.name, n_envs)
    assert isinstance(task, Football)
    return task


def record(scenario: Scenario, n_envs: int) -> Round:
    """Record a round with uniformly random available actions."""
    task, rng = football(scenario, n_envs), np.random.default_rng(1)
    task.reset(0)
    # As `Football` draws them.
    seeds = np.random.default_rng(0)
    first, following = seeds.integers(_SEEDS, size=n_envs), seeds.integers(_SEEDS, size=n_envs)
    actions, given, played, over = [], [], [], []
    for _ in range(STEPS):
        available = task.available_actions()
        actions.append((available * rng.random(available.shape)).argmax(axis=2))
        given.append(following.copy())
        played.append(~task._ended)
        task.step(np.eye(task.spec.action_dim)[actions[-1]])
        over.append(task._ended.copy())
        following[over[-1]] = seeds.integers(_SEEDS, size=over[-1].sum())
    states = np.where(task._ended[:, None], task._next_states, task.simulator_state()[0])
    task.close()
    return Round(np.array(actions), first, np.array(given), np.array(played), np.array(over), states)


class BareEngine:
    """The job function that replays the round of one match, and returns its last state."""

    def __init__(self, scenario: Scenario, played: Round, env: int) -> None:
        self._scenario = scenario
        self._first = int(played.first_seeds[env])
        steps = (each[played.played[:, env], env].tolist() for each in (played.actions, played.seeds, played.over))
        self._steps = list(zip(*steps, strict=True))
        self._match: EngineMatch | None = None

    def __call__(self, _job: int, _parent: ParentConnection) -> NDArray[np.float64]:
        match = self._match = self._match or EngineMatch(self._scenario)
        state = match.start(self._first)
        for actions, seed, over in self._steps:
            for agent, action in enumerate(actions):
                match._game.perform_action(match._actions[action], True, agent)
            match._game.step()
            while not match._read():
                match._game.step()
            if over:
                state = match.start(seed)
        return state if self._steps[-1][2] else match._state()


class GoogleResearchFootball:
    """The job function that plays the actions of one match in Google Research Football's environment."""

    def __init__(self, scenario: Scenario, played: Round, env: int) -> None:
        self._scenario, self._actions = scenario, played.actions[:, env].tolist()
        self._env: Any = None

    def __call__(self, _job: int, _parent: ParentConnection) -> None:
        if self._env is None:
            # Gym says in several ways that it is not maintained, in each process.
            warnings.simplefilter("ignore")
            logging.disable(logging.WARNING)
            with redirect_stderr(io.StringIO()):
                from gfootball.env import create_environment
                from gym import logger
            logger.set_level(logger.ERROR)

            self._env = create_environment(
                env_name=self._scenario.engine_name,
                representation="simple115v2",
                number_of_left_players_agent_controls=self._scenario.n_agents,
            )
        self._env.reset()
        for actions in self._actions:
            if self._env.step(actions)[2]:
                self._env.reset()


def in_processes(jobs: Sequence[Any]) -> tuple[list[JobProcess[int, Any]], Callable[[], list[Any]]]:
    """Start a process for each job function; the result's function has all do their job once."""
    processes = [JobProcess(job) for job in jobs]

    def play() -> list[Any]:
        for process in processes:
            process.send(0)
        done = [process.receive() for process in processes]
        assert all(each.failure is None for each in done), [each.failure for each in done]
        return [each.result for each in done]

    return processes, play


def measure(scenario: Scenario, n_envs: int, rounds: int) -> None:
    played = record(scenario, n_envs)
    engines, bare = in_processes([BareEngine(scenario, played, env) for env in range(n_envs)])
    np.testing.assert_array_equal(bare(), played.states)
    others, gfootball = in_processes([GoogleResearchFootball(scenario, played, env) for env in range(n_envs)])
    task = football(scenario, n_envs)
    one_hot = np.eye(task.spec.action_dim, dtype=np.float32)[played.actions]

    def whole() -> None:
        task.reset(0)
        for actions in one_hot:
            task.available_actions()
            task.simulator_state()
            task.step(actions)

    whole()
    in_play = ~played.over[-1]
    np.testing.assert_array_equal(task.simulator_state()[0][in_play], played.states[in_play])
    gfootball()
    wall: list[list[float]] = [[], [], []]
    cpu: list[list[float]] = [[], [], []]
    # The same engine steps in the task and the engine alone; gfootball plays one for each action.
    n_steps = played.played.sum(), played.played.size, played.played.sum()
    for _ in range(rounds):
        for number, play in enumerate((bare, gfootball, whole)):
            start, cpu_start = time.perf_counter(), cpu_seconds()
            play()
            wall[number].append(n_steps[number] / (time.perf_counter() - start))
            cpu[number].append(n_steps[number] / (cpu_seconds() - cpu_start))
    task.close()
    end_job_processes([*engines, *others])
    by_wall, by_cpu = share(wall[2], wall[0]), share(cpu[2], cpu[0])
    print(
        f"{scenario.name:<28}"
        + "".join(f"{statistics.median(each):>10,.0f}" for each in (*wall, cpu[0], cpu[2]))
        + f"{by_wall:>8.0%}{by_cpu:>6.0%}{share(wall[2], wall[1]):>7.1f}"
        + f"  {'reached' if by_wall >= TARGET else 'reached by CPU time' if by_cpu >= TARGET else 'MISSED'}",
        flush=True,
    )


def share(rates: list[float], reference: list[float]) -> float:
    """Median over rounds of a rate relative to a reference."""
    return statistics.median(one / other for one, other in zip(rates, reference, strict=True))


def cpu_seconds() -> float:
    """CPU time of this process and of those that it started."""
    own = psutil.Process()
    return sum(each.cpu_times().user + each.cpu_times().system for each in (own, *own.children()))


def main() -> int:
    rounds, n_envs = (int(each) for each in (*sys.argv[1:], *("5", "8")[len(sys.argv) - 1 :]))
    if not is_installed():
        print(f"the football engine is not installed: {INSTALL}")
        return 0
    print(
        f"engine steps per second, {n_envs} processes, medians of {rounds} rounds; target: {TARGET:.0%} of the engine"
    )
    print(f"{'':<28}{'wall time':>30}{'CPU time':>20}")
    headings = ("engine", "gfootball", "task", "engine", "task")
    print(f"{'task':<28}" + "".join(f"{each:>10}" for each in headings) + f"{'share':>8}{'CPU':>6}{'times':>7}")
    for scenario in SCENARIOS:
        measure(scenario, n_envs, rounds)
    return 0


if __name__ == "__main__":
    sys.exit(main())
