"""Ants that carry a board, one agent per ant: Porters-2x8 and Porters-4x8.

A task of our own, for preferences: whether the board stays level and the ants walk in step is easy to see and hard to
write as a reward. The true reward pays for carrying the board to the right, and for nothing else. The ants are those of
gymnasium's ant.xml with a saddle on the back and a servo in each joint. Rims under the board keep it on the saddles.
"""

# mujoco is compiled and ships no stubs.
# pyright: reportAttributeAccessIssue=false

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import mujoco
import numpy as np
from numpy.typing import NDArray

from mapt.tasks.mujoco_definition import (
    Features,
    FloatArray,
    MujocoMdp,
    Robot,
    StartSampler,
    gymnasium_asset,
    sum_of_squares,
)
from mapt.tasks.mujoco_task import MujocoDefinition
from mapt.tasks.partition import FeatureColumn, Joint, Partition, columns
from mapt.tasks.robots import ant

#: of one ant: a free joint and eight hinges
ANT_NQ, ANT_NV, N_MOTORS = 15, 14, 8
#: of the board, a free joint after those of the ants
BOARD_NQ, BOARD_NV = 7, 6
#: gymnasium's standing pose: height of the torso, then its orientation and joints
STANDING_METRES = 0.55
STANDING = (1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, -1.0, 0.0, -1.0, 0.0, 1.0)
#: Half sizes in metres of the saddle on a torso, of the board's thickness, and of the rims that keep it on the saddles.
SADDLE, HALF_THICKNESS, RIM = (0.2, 0.3, 0.02), 0.02, 0.06
SADDLE_METRES = 0.26
#: An action moves the servo's target this far from the standing pose. With torques as actions, as in gymnasium, the
#: noise of exploration throws the board off within seconds, and teams learn to stand still.
REACH_RADIANS = 0.5
#: Of the servos, in Nm/rad and Nm s/rad.
STIFFNESS, DAMPING = 120.0, 10.0
#: Speed is worth more: a team that stands still gets a fifth of one that walks at 0.8 m/s.
CARRIED_REWARD = 0.2
CONTROL_COST_WEIGHT = 0.02
#: The rims leave a saddle this much room, and the board ends this far from the last ant.
ROOM_METRES, OVERHANG_METRES = 0.08, 0.4
#: The board is translucent, so that labellers see the ants behind it.
BOARD_DENSITY, BOARD_COLOUR = 4.0, (0.72, 0.5, 0.28, 0.4)
#: An episode ends when the board's centre is lower, or the board is tilted more than this.
LOWEST_METRES, STEEPEST_RADIANS = 0.45, 0.6
START_NOISE = 0.05
HORIZON_STEPS = 300
INSTRUCTIONS = (
    "The ants should carry the board to the right without dropping it. "
    "The board should stay level, and the ants should walk in step."
)


@dataclass(frozen=True, slots=True)
class Team:
    """Where the ants stand under the board: x and y of each in metres."""

    places: tuple[tuple[float, float], ...]

    @property
    def n_ants(self) -> int:
        return len(self.places)

    @property
    def half_length(self) -> float:
        return max(x for x, _ in self.places) + OVERHANG_METRES

    @property
    def half_width(self) -> float:
        return max(y for _, y in self.places) + SADDLE[1] + ROOM_METRES

    @property
    def nq(self) -> int:
        return self.n_ants * ANT_NQ + BOARD_NQ

    @property
    def nv(self) -> int:
        return self.n_ants * ANT_NV + BOARD_NV

    @property
    def relative_width(self) -> int:
        """Numbers in the vectors from an ant to the board and to every other ant."""
        return 3 * self.n_ants

    def pose(self) -> FloatArray:
        """qpos of the ants standing with the board on their saddles."""
        board_metres = STANDING_METRES + SADDLE_METRES + SADDLE[2] + HALF_THICKNESS
        ants = [number for x, y in self.places for number in (x, y, STANDING_METRES, *STANDING)]
        return np.array([*ants, 0.0, 0.0, board_metres, 1.0, 0.0, 0.0, 0.0])


def make_spec(team: Team) -> mujoco.MjSpec:
    """The ants, whose parts are prefixed ant1_, ant2_, ..., and the board."""
    spec = _read_ant()
    spec.modelname = "porters"
    for motor in tuple(spec.actuators):
        spec.delete(motor)
    spec.delete(spec.body("torso"))
    for name, (x, y) in zip(_names(team), team.places, strict=True):
        torso = _read_ant().body("torso")
        torso.pos = [0.0, 0.0, STANDING_METRES]
        torso.add_geom(
            name="saddle", type=mujoco.mjtGeom.mjGEOM_BOX, size=SADDLE, pos=[0, 0, SADDLE_METRES], density=5.0
        )
        spec.worldbody.add_frame(pos=[x, y, 0.0]).attach_body(torso, f"{name}_", "")
    for motor in spec.actuators:
        _make_servo(motor)
    _add_board(spec, team)
    return spec


def _read_ant() -> mujoco.MjSpec:
    spec = gymnasium_asset("ant.xml")()
    # Four times as fast as the file's RK4.
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    return spec


def _make_servo(motor: mujoco.MjsActuator) -> None:
    """Turn a motor of an ant into a servo, whose controls from -1 to 1 move the target around the standing pose."""
    joint = motor.target.split("_", 1)[1]
    standing = STANDING[4 + [each.name for each in ant.JOINTS].index(joint)]
    motor.gear[0] = 1.0
    motor.biastype = mujoco.mjtBias.mjBIAS_AFFINE
    motor.gainprm[0] = STIFFNESS * REACH_RADIANS
    motor.biasprm[:3] = STIFFNESS * standing, -STIFFNESS, -DAMPING


def _add_board(spec: mujoco.MjSpec, team: Team) -> None:
    """A plate with rims under it: along both sides, and across it before and behind each saddle."""
    board = spec.worldbody.add_body(name="board", pos=team.pose()[-BOARD_NQ:-4])
    board.add_freejoint(name="board")
    length, width = team.half_length, team.half_width

    def add(half: Sequence[float], place: Sequence[float]) -> None:
        board.add_geom(
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=half,
            pos=place,
            density=BOARD_DENSITY,
            # Ants do not collide with each other, but with the board.
            contype=1,
            conaffinity=1,
            condim=3,
            friction=[1.0, 0.5, 0.5],
            margin=0.01,
            rgba=BOARD_COLOUR,
        )

    add((length, width, HALF_THICKNESS), (0.0, 0.0, 0.0))
    below = -HALF_THICKNESS - RIM
    for side in (-width, width):
        add((length, 0.02, RIM), (0.0, side, below))
    reach = SADDLE[0] + ROOM_METRES
    for middle in sorted({x for x, _ in team.places}):
        for across in (middle - reach, middle + reach):
            add((0.02, width, RIM), (across, 0.0, below))


def start_sampler(team: Team) -> StartSampler:
    """The standing pose with noise in the joints and in all velocities, so that the board stays on the saddles."""
    pose = team.pose()
    hinges = np.zeros(team.nq, dtype=bool)
    for index in range(team.n_ants):
        hinges[index * ANT_NQ + 7 : (index + 1) * ANT_NQ] = True

    def sample(rng: np.random.Generator, n: int) -> tuple[FloatArray, FloatArray]:
        positions = pose + hinges * rng.uniform(-START_NOISE, START_NOISE, (n, team.nq))
        return positions, START_NOISE * rng.standard_normal((n, team.nv))

    return sample


def compute(team: Team, features: Features) -> None:
    """Write `relative` (E, N, 3 N): from each ant's torso to the board, then to the other ants, the next one first."""
    qpos, relative = features["qpos"], features["relative"]
    torsos = qpos[:, : team.n_ants * ANT_NQ].reshape(len(qpos), team.n_ants, ANT_NQ)[:, :, :3]
    relative[:, :, :3] = board_position(qpos)[:, None] - torsos
    for other in range(1, team.n_ants):
        relative[:, :, 3 * other : 3 * other + 3] = np.roll(torsos, -other, axis=1) - torsos


def board_position(qpos: FloatArray) -> FloatArray:
    """x, y and z of the board's centre in metres, (..., 3)."""
    return qpos[..., -BOARD_NQ:-4]


def board_up(qpos: FloatArray) -> FloatArray:
    """The vertical part of the board's normal, (...): the cosine of its tilt."""
    return 1.0 - 2.0 * (np.square(qpos[..., -3]) + np.square(qpos[..., -2]))


def reward(team: Team, before: Features, after: Features, controls: FloatArray) -> FloatArray:
    """Speed of the board along x in m/s, plus 0.2 per step, minus the ants' mean control cost."""
    speed = (board_position(after["qpos"])[:, 0] - board_position(before["qpos"])[:, 0]) / ant.STEP_SECONDS
    return speed + CARRIED_REWARD - CONTROL_COST_WEIGHT * sum_of_squares(controls) / team.n_ants


def terminated(team: Team, features: Features) -> NDArray[np.bool_]:
    """Whether the board lies low or steeply, or an ant has fallen or jumped, (E,)."""
    qpos = features["qpos"]
    finite = np.isfinite(qpos.sum(axis=1) + features["qvel"].sum(axis=1))
    low, high = ant.HEALTHY_HEIGHT_METRES
    heights = qpos[:, 2 : team.n_ants * ANT_NQ : ANT_NQ]
    healthy = ((low <= heights) & (heights <= high)).all(axis=1)
    carried = (board_position(qpos)[:, 2] >= LOWEST_METRES) & (board_up(qpos) >= np.cos(STEEPEST_RADIANS))
    return ~(finite & healthy & carried)


def _names(team: Team) -> tuple[str, ...]:
    return tuple(f"ant{number}" for number in range(1, team.n_ants + 1))


def _joints(team: Team, index: int, name: str) -> tuple[Joint, ...]:
    """An ant's joints. The first also stands for its torso and the way to the board and to the other ants."""
    qpos, qvel = index * ANT_NQ, index * ANT_NV
    torso = columns("qpos", qpos + 2, qpos + 7) + columns("qvel", qvel, qvel + 6)
    relative = columns("relative", index * team.relative_width, (index + 1) * team.relative_width)
    joints: list[Joint] = []
    for number, joint in enumerate(ant.JOINTS):
        angle: FeatureColumn = ("qpos", qpos + 7 + number)
        own = (angle, ("qvel", qvel + 6 + number))
        if number == 0:
            own += torso + relative
        joints.append(Joint(f"{name}_{joint.name}", index * N_MOTORS + joint.actuator, own, (angle,)))
    return tuple(joints)


def _partition(team: Team) -> Partition:
    """One agent per ant. All hips are neighbours, so that an agent observes how the others set their legs."""
    names = _names(team)
    joints = [_joints(team, index, name) for index, name in enumerate(names)]
    hips = tuple(f"{name}_{joint.name}" for name in names for joint in ant.JOINTS if joint.name.startswith("hip"))
    return Partition(
        joints=tuple(joint for each in joints for joint in each),
        edges=(
            *((f"{name}_ankle_{leg}", f"{name}_hip_{leg}") for name in names for leg in ant.LEGS),
            hips,
        ),
        agents=tuple(tuple(joint.name for joint in each) for each in joints),
        shared=columns("qpos", team.nq - 4, team.nq) + columns("qvel", team.nv - BOARD_NV, team.nv),
    )


def _definition(name: str, team: Team, agent_names: tuple[str, ...]) -> MujocoDefinition:
    heights_and_joints = tuple(
        column for index in range(team.n_ants) for column in columns("qpos", index * ANT_NQ + 2, (index + 1) * ANT_NQ)
    )
    n_relative = team.n_ants * team.relative_width
    return MujocoDefinition(
        name=name,
        robot=Robot(
            partial(make_spec, team),
            team.nq,
            team.nv,
            ant.PHYSICS_STEP_SECONDS,
            _partition(team),
            agent_roots=tuple(f"{each}_torso" for each in _names(team)),
        ),
        mdp=MujocoMdp(
            frame_skip=ant.FRAME_SKIP,
            sample_start=start_sampler(team),
            reward=partial(reward, team),
            terminated=partial(terminated, team),
            features={"relative": (team.n_ants, team.relative_width)},
            compute=partial(compute, team),
            state=heights_and_joints
            + columns("qvel", 0, team.nv)
            + columns("relative", 0, n_relative)
            + columns("qpos", team.nq - 4, team.nq),
        ),
        agent_names=agent_names,
        instructions=INSTRUCTIONS,
        horizon_steps=HORIZON_STEPS,
    )


TASKS = (
    _definition("Porters-2x8", Team(((-1.1, 0.0), (1.1, 0.0))), ("back ant", "front ant")),
    _definition(
        "Porters-4x8",
        Team(((-1.1, -0.9), (-1.1, 0.9), (1.1, -0.9), (1.1, 0.9))),
        ("back right ant", "back left ant", "front right ant", "front left ant"),
    ),
)
