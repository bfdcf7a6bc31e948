"""Environment steps per second of a task, compared with its physics alone and with gymnasium-robotics.

`bare physics` is mujoco.batch with the same model, without sensors, and the same threads. It replays a recorded round
of the task with equal initial states, controls and resets, and its final states must equal the task's bit for bit.
`MaMuJoCo` is one environment of gymnasium-robotics with the same partition and the first environments' actions, on one
thread; it has neither hands nor porters. All alternate in short rounds, so that other load slows them equally. Rates
and shares are medians over rounds. `share` is the task's rate over that of the bare physics by wall time, `CPU` the
same by CPU time, which other load disturbs less, and `times` is the task's rate over MaMuJoCo's.

    python tests/benchmarks/bench_tasks.py [rounds] [task ...]
"""

# mujoco is compiled and ships no stubs.
# pyright: reportAttributeAccessIssue=false

import os
import statistics
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass

import mujoco
import numpy as np
from gymnasium_robotics import mamujoco_v1
from mujoco.batch import Batch

from mapt.tasks import load_model, make_task
from mapt.tasks.mujoco_task import AgentIndices, MujocoDefinition
from mapt.tasks.registry import find_definition

ROBOTS = ("HalfCheetah-6x1", "Ant-4x2", "Humanoid-9|8")
HANDS = ("CatchOver2Underarm", "DoorOpenInward", "DoorOpenOutward", "DoorCloseOutward")
PORTERS = ("Porters-2x8", "Porters-4x8", "Porters-2x17")
TASKS = (*ROBOTS, *HANDS, *PORTERS)
N_ENVS = (16, 64)
AGENT_OBSK = 1
#: Environment steps per round, which take 50 to 400 ms.
STEPS_PER_ROUND = 3_200
MAMUJOCO_STEPS_PER_ROUND = 200
TARGET_OF_PHYSICS, TARGET_OVER_MAMUJOCO = 0.8, 4.0


@dataclass(frozen=True, slots=True)
class Start:
    """Episodes that start at one step: environments and initial states."""

    envs: np.ndarray
    qpos: np.ndarray
    qvel: np.ndarray


@dataclass(frozen=True, slots=True)
class Round:
    """A recording of L steps of E environments of a task."""

    #: actions (L, E, N, A) and the controls (L, E, nu) that follow from them.
    actions: np.ndarray
    controls: np.ndarray
    #: The episodes that start before each step, and after the last.
    starts: tuple[Start | None, ...]
    #: (E, nq): the final positions.
    qpos: np.ndarray


def record(name: str, n_envs: int) -> Round:
    """Record a round with uniformly random actions."""
    task, definition = make_task(name, n_envs, agent_obsk=AGENT_OBSK), find_definition(name)
    assert isinstance(definition, MujocoDefinition)
    actuators = AgentIndices.of(definition.robot, definition.mdp, AGENT_OBSK).actuators
    limit, lead = task.spec.action_limit, (STEPS_PER_ROUND // n_envs, n_envs)
    shape = (*lead, task.spec.n_agents, task.spec.action_dim)
    actions = np.random.default_rng(0).uniform(-limit, limit, shape).astype(np.float32)
    controls = np.zeros((*lead, load_model(name).nu))
    controls[:, :, actuators[actuators >= 0]] = actions[:, :, actuators >= 0]

    def start_of(envs: np.ndarray) -> Start | None:
        qpos, qvel = task.simulator_state()
        return Start(envs, qpos[envs], qvel[envs]) if envs.size else None

    task.reset(0)
    starts = [start_of(np.arange(n_envs))]
    for action in actions:
        step = task.step(action)
        starts.append(start_of(np.flatnonzero(step.terminated | step.truncated)))
    return Round(actions, controls, tuple(starts), task.simulator_state()[0])


def bare_physics(name: str, played: Round, n_threads: int) -> Callable[[], int]:
    """Replay the round with its controls, physics and initial states only.

    Raises:
        AssertionError: if the final states differ from the task's.
    """
    definition = find_definition(name)
    assert isinstance(definition, MujocoDefinition)
    spec = definition.robot.make_spec()
    for sensor in spec.sensors:
        spec.delete(sensor)
    batch = Batch(definition.robot.compile(spec), played.actions.shape[1], nthread=n_threads)
    controls, qpos, qvel = (batch.bind(field) for field in ("ctrl", "qpos", "qvel"))

    def begin(start: Start | None) -> None:
        if start is not None:
            batch.reset(start.envs, stage=mujoco.mjtStage.mjSTAGE_NONE)
            qpos[start.envs], qvel[start.envs] = start.qpos, start.qvel
            batch.forward(start.envs)

    def play() -> int:
        begin(played.starts[0])
        for given, start in zip(played.controls, played.starts[1:], strict=True):
            controls[:] = given
            batch.step(nstep=definition.mdp.frame_skip)
            begin(start)
        return STEPS_PER_ROUND

    play()
    np.testing.assert_array_equal(qpos, played.qpos)
    return play


def whole_task(name: str, played: Round, n_threads: int) -> Callable[[], int]:
    """Play the round with the complete task."""
    task = make_task(name, played.actions.shape[1], n_threads=n_threads, agent_obsk=AGENT_OBSK)

    def play() -> int:
        task.reset(0)
        for action in played.actions:
            task.step(action)
        return STEPS_PER_ROUND

    play()
    np.testing.assert_array_equal(task.simulator_state()[0], played.qpos)
    return play


def mamujoco(name: str, played: Round) -> Callable[[], int]:
    """Step one environment of gymnasium-robotics, including resets."""
    env = mamujoco_v1.parallel_env(*name.split("-"), agent_obsk=AGENT_OBSK)
    env.reset(seed=0)
    dims = {agent: env.action_space(agent).shape[0] for agent in env.possible_agents}
    steps = played.actions.reshape(-1, *played.actions.shape[2:])[:MAMUJOCO_STEPS_PER_ROUND]
    actions = [
        {agent: own[: dims[agent]] for agent, own in zip(env.possible_agents, step, strict=True)} for step in steps
    ]

    def play() -> int:
        for action in actions:
            env.step(action)
            if not env.agents:
                env.reset()
        return len(actions)

    return play


@dataclass(frozen=True, slots=True)
class Rates:
    """Steps per second by wall time and by CPU time, one item per round."""

    clock: list[float]
    cpu: list[float]


def measure_alternating(rounds: int, *candidates: Callable[[], int]) -> list[Rates]:
    measured = [Rates([], []) for _ in candidates]
    for _ in range(rounds):
        for play, rates in zip(candidates, measured, strict=True):
            start, cpu_start = time.perf_counter(), time.process_time()
            n_steps = play()
            rates.clock.append(n_steps / (time.perf_counter() - start))
            rates.cpu.append(n_steps / (time.process_time() - cpu_start))
    return measured


def share(rates: list[float], reference: list[float]) -> float:
    """Median over rounds of a rate relative to a reference."""
    return statistics.median(one / other for one, other in zip(rates, reference, strict=True))


def compare(names: tuple[str, ...], rounds: int, n_threads: int) -> bool:
    """Print the table of tasks. Return whether all reach the targets."""
    print(
        f"\n{n_threads} thread{'s' * (n_threads > 1)}\n"
        f"{'task':<20}{'E':>5}{'bare physics':>15}{'MaMuJoCo':>10}{'task':>10}{'share':>8}{'CPU':>6}{'times':>8}"
    )
    reached = True
    for name in names:
        for n_envs in N_ENVS:
            played = record(name, n_envs)
            references = [] if name in (*HANDS, *PORTERS) else [mamujoco(name, played)]
            bare, task, *robotics = measure_alternating(
                rounds, bare_physics(name, played, n_threads), whole_task(name, played, n_threads), *references
            )
            of_physics = share(task.clock, bare.clock)
            over_mamujoco = [share(task.clock, other.clock) for other in robotics]
            reached &= of_physics >= TARGET_OF_PHYSICS and all(times >= TARGET_OVER_MAMUJOCO for times in over_mamujoco)
            bare_rate, task_rate, *others = (statistics.median(rates.clock) for rates in (bare, task, *robotics))
            print(
                f"{name:<20}{n_envs:>5}{bare_rate:>15,.0f}"
                + (f"{others[0]:>10,.0f}" if others else f"{'':>10}")
                + f"{task_rate:>10,.0f}{of_physics:>8.0%}{share(task.cpu, bare.cpu):>6.0%}"
                + "".join(f"{times:>8.1f}" for times in over_mamujoco),
                flush=True,
            )
    return reached


def main() -> int:
    rounds = int(sys.argv[1]) if len(sys.argv) > 1 else 21
    names = tuple(sys.argv[2:]) or TASKS
    n_cores = os.cpu_count() or 1
    print(f"environment steps per second, medians of {rounds} rounds")
    reached = [compare(names, rounds, n_threads) for n_threads in sorted({1, n_cores})]
    targets = f"{TARGET_OF_PHYSICS:.0%} of the bare physics and {TARGET_OVER_MAMUJOCO:.0f} times MaMuJoCo"
    print(f"targets: {targets} on {n_cores} threads: {'reached' if reached[-1] else 'MISSED'}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
