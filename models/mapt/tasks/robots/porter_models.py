"""Models of the robots that carry a board: gymnasium's ants and humanoids with a servo in each joint, and the board.

Ants have a saddle on the back, on which the board lies; rims under it keep it there. Humanoids face each other and hold
the board with their hands.
"""

# mujoco is compiled and ships no stubs.
# pyright: reportAttributeAccessIssue=false

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from mapt.tasks.mujoco_definition import FloatArray, gymnasium_asset
from mapt.tasks.robots import ant

#: of the free joint of a torso or of the board
FREE_NQ, FREE_NV = 7, 6
#: of the board, a free joint after those of the porters
BOARD_NQ, BOARD_NV = FREE_NQ, FREE_NV
#: The board is translucent, so that labellers see the porters behind it.
BOARD_COLOUR = (0.72, 0.5, 0.28, 0.4)
HALF_THICKNESS = 0.02

#: Half sizes in metres of the saddle on an ant's torso and of the rims of the board, and the saddle's height above it.
SADDLE, RIM = (0.2, 0.3, 0.02), 0.06
SADDLE_METRES = 0.26
#: The rims leave a saddle this much room, and the board ends this far from the last ant.
ROOM_METRES, OVERHANG_METRES = 0.08, 0.4
ANT_BOARD_DENSITY = 4.0

#: Place of a humanoid's hands in front of its torso, in metres: forwards, to each side and up.
HANDS = (0.36, 0.17, 0.06)
#: The held board reaches this far beyond the hands.
GRIP_METRES = 0.1
HELD_BOARD_DENSITY = 30.0


@dataclass(frozen=True, slots=True)
class Servo:
    """A joint of a porter and its servo, whose controls from -1 to 1 move the target around the standing pose.

    With torques as actions, as in gymnasium, the noise of exploration throws the board off within seconds, and teams
    learn to stand still.
    """

    joint: str
    #: of the joint's motor among those of the porter
    actuator: int
    standing_radians: float
    #: An action of 1 moves the target this far from the standing pose.
    reach_radians: float
    #: in Nm/rad and Nm s/rad
    stiffness: float
    damping: float


@dataclass(frozen=True, slots=True)
class Place:
    """Where a porter stands, in metres."""

    x: float
    y: float
    #: to the left instead of to the right
    faces_back: bool = False

    @property
    def quaternion(self) -> tuple[float, float, float, float]:
        return (0.0, 0.0, 0.0, 1.0) if self.faces_back else (1.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True)
class Porter:
    """A kind of robot that carries."""

    #: of one porter: with a number, the prefix of its bodies and joints
    name: str
    physics_step_seconds: float
    make_spec: Callable[[], mujoco.MjSpec]
    #: in the order of qpos
    servos: tuple[Servo, ...]
    #: of the torso in the standing pose
    standing_metres: float
    #: Names of joints that other porters observe with `agent_obsk` 1.
    seen: tuple[str, ...]
    #: Pairs of neighbouring joints.
    edges: tuple[tuple[str, str], ...]
    #: height of the board's centre above the torso's
    board_metres: float
    #: Adds what is needed to hold the board, and the board, given the names and places of the porters.
    add_board: Callable[[mujoco.MjSpec, Sequence[str], Sequence[Place]], None]

    @property
    def nq(self) -> int:
        return FREE_NQ + len(self.servos)

    @property
    def nv(self) -> int:
        return FREE_NV + len(self.servos)

    def pose(self, places: Sequence[Place]) -> FloatArray:
        """qpos of the porters that stand with the board."""
        hinges = [servo.standing_radians for servo in self.servos]
        porters = [
            number
            for place in places
            for number in (place.x, place.y, self.standing_metres, *place.quaternion, *hinges)
        ]
        return np.array([*porters, 0.0, 0.0, self.standing_metres + self.board_metres, 1.0, 0.0, 0.0, 0.0])

    def names(self, places: Sequence[Place]) -> tuple[str, ...]:
        """The prefixes of the porters' bodies and joints, without an underscore."""
        return tuple(f"{self.name}{number}" for number in range(1, len(places) + 1))


def make_spec(porter: Porter, places: Sequence[Place]) -> mujoco.MjSpec:
    """The porters, whose parts are prefixed ant1_, ant2_, ... or humanoid1_, ..., and the board."""
    spec = _read(porter)
    spec.modelname = "porters"
    for part in (*spec.actuators, *spec.tendons):
        spec.delete(part)
    spec.delete(spec.body("torso"))
    names = porter.names(places)
    for name, place in zip(names, places, strict=True):
        torso = _read(porter).body("torso")
        torso.pos = [0.0, 0.0, porter.standing_metres]
        frame = spec.worldbody.add_frame(pos=[place.x, place.y, 0.0], quat=place.quaternion)
        frame.attach_body(torso, f"{name}_", "")
    servos = {servo.joint: servo for servo in porter.servos}
    for motor in spec.actuators:
        _make_servo(motor, servos[motor.target.split("_", 1)[1]])
    porter.add_board(spec, names, places)
    return spec


def _read(porter: Porter) -> mujoco.MjSpec:
    """The model of one porter. MuJoCo warns about attached models whose options differ."""
    spec = porter.make_spec()
    spec.option.timestep = porter.physics_step_seconds
    # Four times as fast as the files' RK4.
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    return spec


def _make_servo(motor: mujoco.MjsActuator, servo: Servo) -> None:
    motor.gear[0] = 1.0
    motor.ctrlrange[:] = -1.0, 1.0
    motor.biastype = mujoco.mjtBias.mjBIAS_AFFINE
    motor.gainprm[0] = servo.stiffness * servo.reach_radians
    motor.biasprm[:3] = servo.stiffness * servo.standing_radians, -servo.stiffness, -servo.damping


def _read_ant() -> mujoco.MjSpec:
    """An ant with a saddle."""
    spec = gymnasium_asset("ant.xml")()
    spec.body("torso").add_geom(
        name="saddle", type=mujoco.mjtGeom.mjGEOM_BOX, size=SADDLE, pos=[0, 0, SADDLE_METRES], density=5.0
    )
    return spec


def _add_free_body(spec: mujoco.MjSpec, height: float) -> mujoco.MjsBody:
    board = spec.worldbody.add_body(name="board", pos=[0.0, 0.0, height])
    board.add_freejoint(name="board")
    return board


def _add_board_on_saddles(spec: mujoco.MjSpec, _names: Sequence[str], places: Sequence[Place]) -> None:
    """A plate with rims under it: along both sides, and across it before and behind each saddle."""
    board = _add_free_body(spec, ANT.standing_metres + ANT.board_metres)
    length = max(place.x for place in places) + OVERHANG_METRES
    width = max(place.y for place in places) + SADDLE[1] + ROOM_METRES

    def add(half: Sequence[float], position: Sequence[float]) -> None:
        board.add_geom(
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=half,
            pos=position,
            density=ANT_BOARD_DENSITY,
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
    for middle in sorted({place.x for place in places}):
        for across in (middle - reach, middle + reach):
            add((0.02, width, RIM), (across, 0.0, below))


def _add_held_board(spec: mujoco.MjSpec, names: Sequence[str], places: Sequence[Place]) -> None:
    """A plate that both forearms of each humanoid are welded to, since hands that are spheres cannot grip.

    The firm grip lets two humanoids stand on their four round feet; with joints in the hands they would fall together.
    """
    board = _add_free_body(spec, HUMANOID.standing_metres + HUMANOID.board_metres)
    length = max(place.x for place in places) - HANDS[0] + GRIP_METRES
    board.add_geom(
        type=mujoco.mjtGeom.mjGEOM_BOX,
        size=(length, HANDS[1] + GRIP_METRES, HALF_THICKNESS),
        density=HELD_BOARD_DENSITY,
        contype=0,
        conaffinity=0,
        # The humanoid's default material is white.
        material="",
        rgba=BOARD_COLOUR,
    )
    for name in names:
        for side in ("right", "left"):
            # The compiler takes the relative pose from the model's initial pose.
            spec.add_equality(
                type=mujoco.mjtEq.mjEQ_WELD,
                objtype=mujoco.mjtObj.mjOBJ_BODY,
                name1=f"{name}_{side}_lower_arm",
                name2="board",
            )


#: gymnasium's standing pose
_ANT_STANDING = (0.0, 1.0, 0.0, -1.0, 0.0, -1.0, 0.0, 1.0)
ANT = Porter(
    name="ant",
    physics_step_seconds=ant.PHYSICS_STEP_SECONDS,
    make_spec=_read_ant,
    servos=tuple(
        Servo(joint.name, joint.actuator, standing, reach_radians=0.5, stiffness=120.0, damping=10.0)
        for joint, standing in zip(ant.JOINTS, _ANT_STANDING, strict=True)
    ),
    standing_metres=0.55,
    seen=tuple(joint.name for joint in ant.JOINTS if joint.name.startswith("hip")),
    edges=tuple((f"ankle_{leg}", f"hip_{leg}") for leg in ant.LEGS),
    board_metres=SADDLE_METRES + SADDLE[2] + HALF_THICKNESS,
    add_board=_add_board_on_saddles,
)


def _humanoid_servo(actuator: int, joint: str) -> Servo:
    """A servo of a humanoid. In the standing pose, the knees are bent a little and the feet apart."""
    stiffness, reach = (150.0, 0.2) if "shoulder" in joint or "elbow" in joint else (800.0, 0.2)
    standing = 0.0
    if joint.endswith("knee"):
        standing, reach, stiffness = -0.25, 0.5, 600.0
    elif joint.endswith("hip_y"):
        standing, reach = -0.13, 0.35
    elif joint.endswith("hip_x"):
        standing = -0.15
    return Servo(joint, actuator, standing, reach, stiffness, damping=0.05 * stiffness)


#: The humanoid's joints in the order of qpos; its motors have the same order but for the first two.
HUMANOID_JOINTS = (
    *("abdomen_z", "abdomen_y", "abdomen_x"),
    *(f"{side}_{joint}" for side in ("right", "left") for joint in ("hip_x", "hip_z", "hip_y", "knee")),
    *(f"{side}_{joint}" for side in ("right", "left") for joint in ("shoulder1", "shoulder2", "elbow")),
)
HUMANOID = Porter(
    name="humanoid",
    physics_step_seconds=0.005,
    make_spec=gymnasium_asset("humanoid.xml"),
    servos=tuple(
        _humanoid_servo(actuator, joint)
        for actuator, joint in zip((1, 0, *range(2, len(HUMANOID_JOINTS))), HUMANOID_JOINTS, strict=True)
    ),
    standing_metres=1.278,
    seen=tuple(f"{side}_{joint}" for side in ("right", "left") for joint in ("hip_y", "knee")),
    edges=tuple((f"{side}_knee", f"{side}_hip_y") for side in ("right", "left")),
    board_metres=HANDS[2],
    add_board=_add_held_board,
)
