"""Robots that carry a board, one agent per robot: Porters-2x8, Porters-4x8 and Porters-2x17.

Tasks of our own, for preferences: whether the board stays level and the porters walk in step is easy to see and hard to
write as a reward. The true reward pays for carrying the board to the right, and for nothing else. `porter_models.py`
has the robots and the board.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from mapt.tasks.mujoco_definition import Features, FloatArray, MujocoMdp, Robot, StartSampler, sum_of_squares
from mapt.tasks.mujoco_task import MujocoDefinition
from mapt.tasks.partition import FeatureColumn, Joint, Partition, columns
from mapt.tasks.robots import ant
from mapt.tasks.robots.porter_models import (
    ANT,
    BOARD_NQ,
    BOARD_NV,
    FREE_NQ,
    FREE_NV,
    HUMANOID,
    Place,
    Porter,
    make_spec,
)

#: simulated time of an environment step, of every team
STEP_SECONDS = 0.05
#: Speed is worth more: a team that stands still gets a fifth of one that walks at 0.8 m/s.
CARRIED_REWARD = 0.2
CONTROL_COST_WEIGHT = 0.02
#: An episode ends when the board is tilted more than this.
STEEPEST_RADIANS = 0.6
START_NOISE = 0.05
HORIZON_STEPS = 300
#: With the default rate of 2e-3, policies hardly learn to walk.
POLICY_SETTINGS: Mapping[str, object] = {"learning_rate": 5e-4}
INSTRUCTIONS = (
    "The {name}s should carry the board to the right without dropping it. "
    "The board should stay level, and the {name}s should walk in step."
)


@dataclass(frozen=True, slots=True)
class Team:
    """Robots of one kind under or around a board."""

    porter: Porter
    places: tuple[Place, ...]
    #: range of the height of a torso, in metres; an episode ends outside
    healthy_metres: tuple[float, float]
    #: An episode ends when the board's centre is lower.
    lowest_board_metres: float

    @property
    def size(self) -> int:
        return len(self.places)

    @property
    def nq(self) -> int:
        return self.size * self.porter.nq + BOARD_NQ

    @property
    def nv(self) -> int:
        return self.size * self.porter.nv + BOARD_NV

    @property
    def relative_width(self) -> int:
        """Numbers in the vectors from a porter to the board and to every other porter."""
        return 3 * self.size


def start_sampler(team: Team) -> StartSampler:
    """The standing pose with noise in the joints and in all velocities, so that the board stays where it is."""
    pose = team.porter.pose(team.places)
    hinges = np.zeros(team.nq, dtype=bool)
    for index in range(team.size):
        hinges[index * team.porter.nq + FREE_NQ : (index + 1) * team.porter.nq] = True

    def sample(rng: np.random.Generator, n: int) -> tuple[FloatArray, FloatArray]:
        positions = pose + hinges * rng.uniform(-START_NOISE, START_NOISE, (n, team.nq))
        return positions, START_NOISE * rng.standard_normal((n, team.nv))

    return sample


def compute(team: Team, features: Features) -> None:
    """Write `relative` (E, N, 3 N): from each torso to the board, then to the other torsos, the next one first."""
    qpos, relative = features["qpos"], features["relative"]
    torsos = qpos[:, :-BOARD_NQ].reshape(len(qpos), team.size, team.porter.nq)[:, :, :3]
    relative[:, :, :3] = board_position(qpos)[:, None] - torsos
    for other in range(1, team.size):
        relative[:, :, 3 * other : 3 * other + 3] = np.roll(torsos, -other, axis=1) - torsos


def board_position(qpos: FloatArray) -> FloatArray:
    """x, y and z of the board's centre in metres, (..., 3)."""
    return qpos[..., -BOARD_NQ:-4]


def board_up(qpos: FloatArray) -> FloatArray:
    """The vertical part of the board's normal, (...): the cosine of its tilt."""
    return 1.0 - 2.0 * (np.square(qpos[..., -3]) + np.square(qpos[..., -2]))


def reward(team: Team, before: Features, after: Features, controls: FloatArray) -> FloatArray:
    """Speed of the board along x in m/s, plus 0.2 per step, minus the porters' mean control cost."""
    speed = (board_position(after["qpos"])[:, 0] - board_position(before["qpos"])[:, 0]) / STEP_SECONDS
    return speed + CARRIED_REWARD - CONTROL_COST_WEIGHT * sum_of_squares(controls) / team.size


def terminated(team: Team, features: Features) -> NDArray[np.bool_]:
    """Whether the board lies low or steeply, or a porter has fallen or jumped, (E,)."""
    qpos = features["qpos"]
    finite = np.isfinite(qpos.sum(axis=1) + features["qvel"].sum(axis=1))
    low, high = team.healthy_metres
    heights = qpos[:, 2 : -BOARD_NQ : team.porter.nq]
    healthy = ((low <= heights) & (heights <= high)).all(axis=1)
    carried = (board_position(qpos)[:, 2] >= team.lowest_board_metres) & (board_up(qpos) >= np.cos(STEEPEST_RADIANS))
    return ~(finite & healthy & carried)


def _joints(team: Team, index: int, name: str) -> tuple[Joint, ...]:
    """A porter's joints. The first also stands for its torso and the way to the board and to the other porters."""
    porter = team.porter
    qpos, qvel = index * porter.nq, index * porter.nv
    torso = columns("qpos", qpos + 2, qpos + FREE_NQ) + columns("qvel", qvel, qvel + FREE_NV)
    relative = columns("relative", index * team.relative_width, (index + 1) * team.relative_width)
    joints: list[Joint] = []
    for number, servo in enumerate(porter.servos):
        angle: FeatureColumn = ("qpos", qpos + FREE_NQ + number)
        own = (angle, ("qvel", qvel + FREE_NV + number))
        if number == 0:
            own += torso + relative
        actuator = index * len(porter.servos) + servo.actuator
        joints.append(Joint(f"{name}_{servo.joint}", actuator, own, (angle,)))
    return tuple(joints)


def _partition(team: Team) -> Partition:
    """One agent per porter. `seen` joints are neighbours, so that an agent observes how the others set their legs."""
    names = team.porter.names(team.places)
    joints = [_joints(team, index, name) for index, name in enumerate(names)]
    return Partition(
        joints=tuple(joint for each in joints for joint in each),
        edges=(
            *(tuple(f"{name}_{joint}" for joint in edge) for name in names for edge in team.porter.edges),
            tuple(f"{name}_{joint}" for name in names for joint in team.porter.seen),
        ),
        agents=tuple(tuple(joint.name for joint in each) for each in joints),
        shared=columns("qpos", team.nq - 4, team.nq) + columns("qvel", team.nv - BOARD_NV, team.nv),
    )


def _definition(name: str, team: Team, agent_names: tuple[str, ...]) -> MujocoDefinition:
    porter = team.porter
    heights_and_joints = tuple(
        column
        for index in range(team.size)
        for column in columns("qpos", index * porter.nq + 2, (index + 1) * porter.nq)
    )
    return MujocoDefinition(
        name=name,
        robot=Robot(
            partial(make_spec, porter, team.places),
            team.nq,
            team.nv,
            porter.physics_step_seconds,
            _partition(team),
            agent_roots=tuple(f"{each}_torso" for each in porter.names(team.places)),
        ),
        mdp=MujocoMdp(
            frame_skip=round(STEP_SECONDS / porter.physics_step_seconds),
            sample_start=start_sampler(team),
            reward=partial(reward, team),
            terminated=partial(terminated, team),
            features={"relative": (team.size, team.relative_width)},
            compute=partial(compute, team),
            state=heights_and_joints
            + columns("qvel", 0, team.nv)
            + columns("relative", 0, team.size * team.relative_width)
            + columns("qpos", team.nq - 4, team.nq),
        ),
        agent_names=agent_names,
        instructions=INSTRUCTIONS.format(name=porter.name),
        horizon_steps=HORIZON_STEPS,
        policy_settings=POLICY_SETTINGS,
    )


def _ants(*places: Place) -> Team:
    return Team(ANT, places, ant.HEALTHY_HEIGHT_METRES, lowest_board_metres=0.45)


def _humanoids(*places: Place) -> Team:
    return Team(HUMANOID, places, healthy_metres=(1.0, 1.6), lowest_board_metres=1.05)


TASKS = (
    _definition("Porters-2x8", _ants(Place(-1.1, 0.0), Place(1.1, 0.0)), ("back ant", "front ant")),
    _definition(
        "Porters-4x8",
        _ants(Place(-1.1, -0.9), Place(-1.1, 0.9), Place(1.1, -0.9), Place(1.1, 0.9)),
        ("back right ant", "back left ant", "front right ant", "front left ant"),
    ),
    _definition(
        "Porters-2x17",
        _humanoids(Place(-0.9, 0.0), Place(0.9, 0.0, faces_back=True)),
        ("back humanoid", "front humanoid"),
    ),
)
