"""How a body is framed: from which side the camera looks, how much it sees, and whether it goes along.

Found from the joints and the reach of the model, so that a task of one's own is framed too, and all clips of a task
alike.
"""

# mujoco is compiled and ships no stubs.
# pyright: reportAttributeAccessIssue=false

from dataclasses import dataclass, replace
from typing import Literal

import mujoco
import numpy as np
from numpy.typing import NDArray

from mapt.rendering.appearance import VIEW_ANGLE_DEGREES, moving_geoms

Float64s = NDArray[np.float64]
#: `side` suits what moves in an upright plane, `above` what moves in a level one, `slanted` the rest
Kind = Literal["side", "above", "slanted"]

#: how far the camera looks down, degrees; from the side, enough to see the floor's squares
LOOK_DOWN_DEGREES: dict[Kind, float] = {"side": 9.0, "slanted": 28.0, "above": 65.0}
#: the view is so many times as large as the body ever gets
ROOM: dict[Kind, float] = {"side": 1.2, "slanted": 1.3, "above": 1.2}
#: of what stays in its place, the view is so many times as large as where nearly all of its poses are
ROOM_ABOUT_A_PLACE, NEARLY_ALL = 1.1, 0.95
#: from the side, part of the view's height that is below the floor's line
FLOOR_SHARE = 0.2
#: a body this thin, against its length or height, hides nothing of itself from the side
THIN = 0.3
#: sides of the floor's squares, metres; the view is about five of them wide
SQUARES_METRES = (0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0)
SQUARES_IN_VIEW = 5.0


#: poses that are tried to find how far a body reaches
TRIED_POSES = 200


class Body:
    """The geoms of a model that are not fixed to the world, G of them."""

    def __init__(self, model: mujoco.MjModel) -> None:
        self.model = model
        self.data = mujoco.MjData(model)
        self._geoms = moving_geoms(model)

    def place(self, qpos: Float64s) -> None:
        self.data.qpos[:] = qpos
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_camlight(self.model, self.data)

    def boxes(self, axes: Float64s) -> tuple[Float64s, Float64s]:
        """Centres and half sizes (G,3), metres, of the boxes around the geoms as they are placed.

        Args:
            axes: (3,3), rows are the directions along which boxes lie and are measured.
        """
        turn = axes @ self.data.geom_xmat[self._geoms].reshape(-1, 3, 3)
        centre, half = np.split(self.model.geom_aabb[self._geoms], 2, axis=1)
        centre = self.data.geom_xpos[self._geoms] @ axes.T + np.einsum("gij,gj->gi", turn, centre)
        return centre, np.einsum("gij,gj->gi", np.abs(turn), half)

    def extents(self, qpos: Float64s, axes: Float64s) -> tuple[Float64s, Float64s]:
        """Lowest and highest corners (T,3), metres, of the box around all geoms in each pose (T,nq)."""
        corners = np.empty((2, len(qpos), 3))
        for step, state in enumerate(qpos):
            self.place(state)
            centre, half = self.boxes(axes)
            corners[0, step] = (centre - half).min(axis=0)
            corners[1, step] = (centre + half).max(axis=0)
        return corners[0], corners[1]

    def poses(self) -> Float64s:
        """(P,nq): the model's own pose, and others with every driven hinge anywhere in its range. Always the same."""
        model, rng = self.model, np.random.default_rng(0)
        poses = np.tile(model.qpos0, (1 + TRIED_POSES, 1))
        joints = model.actuator_trnid[model.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT, 0]
        for joint in joints[model.jnt_type[joints] == mujoco.mjtJoint.mjJNT_HINGE]:
            low, high = model.jnt_range[joint] if model.jnt_limited[joint] else (-np.pi, np.pi)
            poses[1:, model.jnt_qposadr[joint]] = rng.uniform(low, high, TRIED_POSES)
        return poses


#: half of the window over which the body's path is smoothed
SMOOTHING_SECONDS = 0.4
#: part of the view's half that the body may fill
SAFE_SHARE = 0.94


@dataclass(frozen=True, slots=True)
class View:
    """What the camera sees at the distance of the body, metres from the middle to an edge."""

    half_width: float
    half_height: float


def camera_path(
    lowest: NDArray[np.float64],
    highest: NDArray[np.float64],
    wished: NDArray[np.float64],
    view: View,
    window: int,
) -> NDArray[np.float64]:
    """The points the camera looks at.

    Args:
        lowest, highest: corners of the body's bounding box in the picture's plane, metres (T,2): right, up.
        wished: (T,2), a smooth path that it takes as long as the body fits.
        view: what is seen.
        window: frames on each side over which giving way is smoothed.

    Returns:
        (T,2) float64: right, up. The bounding box is within the view in every frame, if it fits at all.
    """
    half = np.array([view.half_width, view.half_height]) * SAFE_SHARE
    middle = (lowest + highest) / 2
    # Too far from the wish on one side or the other: how much the camera must give way, made smooth without
    # becoming less than is needed.
    ahead = envelope(np.maximum(highest - half - wished, 0.0), window)
    behind = envelope(np.maximum(wished - (lowest + half), 0.0), window)
    led = wished + ahead - behind
    # Where both gave way at once neither is exact, and a body larger than the view has no room: its middle wins.
    least, most = highest - half, lowest + half
    return np.where(least > most, middle, np.clip(led, np.minimum(least, most), np.maximum(least, most)))


def smooth(path: NDArray[np.float64], window: int) -> NDArray[np.float64]:
    """Moving average (T,) with mirrored ends, so that steady motion stays steady to the last frame."""
    padded = np.pad(path, window, mode="reflect", reflect_type="odd") if len(path) > 1 else path
    if len(path) == 1 or window == 0:
        return path.copy()
    kernel = np.full(2 * window + 1, 1 / (2 * window + 1))
    return np.convolve(padded, kernel, mode="valid")


def envelope(need: NDArray[np.float64], window: int) -> NDArray[np.float64]:
    """A smooth curve (T,2) nowhere below `need`: the running maximum, then the moving average of it."""
    if window == 0 or not need.any():
        return need
    padded = np.pad(need, ((2 * window, 2 * window), (0, 0)), mode="edge")
    raised = np.lib.stride_tricks.sliding_window_view(padded, 2 * window + 1, axis=0).max(axis=-1)
    return np.lib.stride_tricks.sliding_window_view(raised, 2 * window + 1, axis=0).mean(axis=-1)


@dataclass(frozen=True, slots=True)
class Framing:
    """One look at a body, for all its clips."""

    kind: Kind
    view: View
    #: (3,3): rows are the picture's directions to the right, up and away, in the world
    axes: Float64s
    #: (3,) metres: what the camera looks at while the body is where it is placed in the model
    centre: Float64s
    #: whether the camera goes along with the body over the floor
    follows: bool
    #: height of the floor, metres
    floor: float
    #: side of the floor's squares
    square_metres: float

    @property
    def distance(self) -> float:
        """From the camera to what it looks at, metres."""
        return self.view.half_height / float(np.tan(np.radians(VIEW_ANGLE_DEGREES / 2)))

    def fitting(self, lowest: Float64s, highest: Float64s) -> "Framing":
        """This framing, from farther away if the body in some pose (corners (T,2)) is larger than the view."""
        room = 2 * SAFE_SHARE * np.array([self.view.half_width, self.view.half_height])
        too_large = float(((highest - lowest) / room).max())
        if too_large <= 1:
            return self
        return replace(self, view=View(self.view.half_width * too_large, self.view.half_height * too_large))

    def wished(self, lowest: Float64s, highest: Float64s, window: int) -> Float64s:
        """(T,3) along the axes: where the camera would look if the body always fitted.

        Args:
            lowest, highest: (T,3), corners of the body's box along the axes.
            window: frames on each side over which the path is smoothed.
        """
        wished = np.tile(self.centre, (len(lowest), 1))
        if self.follows:
            middle = (lowest + highest) / 2 @ self.axes
            for level in (0, 1):
                wished[:, level] = smooth(middle[:, level], window)
        return wished @ self.axes.T

    def in_perspective(self, lowest: Float64s, highest: Float64s, wished: Float64s) -> tuple[Float64s, Float64s]:
        """Corners (T,2) to the right and up as they look at the distance of what the camera looks at.

        A body's nearest part is magnified most; here all of it is as much, so that what fits surely fits.
        """
        nearer = np.clip(wished[:, 2] - lowest[:, 2], 0.0, self.distance / 2)
        scale = (self.distance / (self.distance - nearer))[:, None]
        around = wished[:, :2]
        low, high = around + (lowest[:, :2] - around) * scale, around + (highest[:, :2] - around) * scale
        # A part on the far side of the middle is drawn towards it, so its true place is the outermost.
        return np.minimum(low, lowest[:, :2]), np.maximum(high, highest[:, :2])


def frame(body: Body, aspect: float) -> Framing:
    """The framing of a body.

    Args:
        aspect: width of the picture over its height.
    """
    model, poses = body.model, body.poses()
    world = body.extents(poses, np.eye(3))
    body.place(model.qpos0)
    kind, follows, floor = _kind(body, world[1][0] - world[0][0]), _travels(model), _floor(body, world[0])
    axes = directions(LOOK_DOWN_DEGREES[kind])
    lowest, highest = body.extents(poses, axes)
    if follows:
        width, height, _ = (highest - lowest).max(axis=0) * ROOM[kind]
        centre = (world[0][0] + world[1][0]) / 2
    else:
        least, most = np.quantile(lowest, 1 - NEARLY_ALL, axis=0), np.quantile(highest, NEARLY_ALL, axis=0)
        width, height, _ = (most - least) * ROOM_ABOUT_A_PLACE
        centre = (least + most) / 2 @ axes
    half_width = float(max(width, height * aspect) / 2)
    view = View(half_width, half_width / aspect)
    if kind == "side":
        centre[2] = floor + max(view.half_height * (1 - 2 * FLOOR_SHARE), centre[2] - floor)
    elif kind == "slanted" and follows:
        centre[2] = floor + (world[1] - world[0])[:, 2].max() / 2
    return Framing(kind, view, axes, centre, follows, floor, _square(2 * half_width))


def directions(look_down_degrees: float) -> Float64s:
    """(3,3): right, up and away, of a camera that has the world's x to its right."""
    down = np.radians(look_down_degrees)
    return np.array([[1, 0, 0], [0, np.sin(down), np.cos(down)], [0, np.cos(down), -np.sin(down)]])


def _kind(body: Body, size: Float64s) -> Kind:
    model = body.model
    hinges = model.jnt_type == mujoco.mjtJoint.mjJNT_HINGE
    slides = model.jnt_type == mujoco.mjtJoint.mjJNT_SLIDE
    if not (hinges | slides).all():
        return "slanted"

    def within(normal: int) -> bool:
        along = np.abs(body.data.xaxis[:, normal])
        return bool((along[hinges] > 0.99).all() and (along[slides] < 0.01).all())

    if within(1) and size[1] < THIN * max(size[0], size[2]):
        return "side"
    return "above" if within(2) else "slanted"


def _travels(model: mujoco.MjModel) -> bool:
    """Whether something can go as far as it likes."""
    free = model.jnt_type == mujoco.mjtJoint.mjJNT_FREE
    endless = (model.jnt_type == mujoco.mjtJoint.mjJNT_SLIDE) & (model.jnt_limited == 0)
    return bool((free | endless).any())


def _floor(body: Body, lowest: Float64s) -> float:
    """Height of the highest plane; of the body's lowest point where there is none."""
    planes = np.flatnonzero(body.model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE)
    return float(body.data.geom_xpos[planes, 2].max() if planes.size else lowest[0, 2])


def _square(view_width: float) -> float:
    return min(SQUARES_METRES, key=lambda side: abs(np.log(view_width / SQUARES_IN_VIEW / side)))
