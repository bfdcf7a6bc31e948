"""The camera: its direction and distance for each task, and its path for each clip.

The framing is computed from the model's joints and reach, so that it also suits tasks that users register. It is the
same in all clips of a task, so that the two clips of a pair never differ in scale. A labeller judges a gait by the
body's motion within the frame, and speed by the floor's motion. The camera therefore keeps its height, distance and
direction, and follows the body's smoothed path. It deviates from that path, smoothly, only where the body would leave
the view.
"""

# mujoco is compiled and ships no stubs.
# pyright: reportAttributeAccessIssue=false

from dataclasses import dataclass, replace
from typing import Literal

import mujoco
import numpy as np
from numpy.typing import NDArray

from mapt.rendering.appearance import VIEW_ANGLE_DEGREES, moving_geoms
from mapt.rendering.settings import Camera
from mapt.tasks import find_drawing, load_model, task_spec

FloatArray = NDArray[np.float64]
#: `side` for bodies that move in a vertical plane, `above` for a horizontal plane, `slanted` for others
ViewKind = Literal["side", "above", "slanted"]

#: angle below the horizon in degrees; from the side, enough to see the floor's squares
LOOK_DOWN_DEGREES: dict[ViewKind, float] = {"side": 9.0, "slanted": 28.0, "above": 65.0}
#: that angle of the camera `top`; at 90 degrees, lights and limbs would show no depth
TOP_LOOK_DOWN_DEGREES = 84.0
#: where the model chooses the view, the camera `side` looks from this much further round
CHOSEN_SIDE_TURN_DEGREES = 50.0
#: size of the view over the largest size of a body that travels
MARGIN: dict[ViewKind, float] = {"side": 1.2, "slanted": 1.3, "above": 1.2}
#: size of the view over the region that a stationary body reaches in this share of its poses
STATIONARY_MARGIN, REACH_QUANTILE = 1.1, 0.95
#: from the side, share of the view's height below the floor's line
FLOOR_SHARE = 0.2
#: largest width over length or height at which a body is shown from the side, where it hides no part of itself
MAX_SIDE_VIEW_WIDTH = 0.3
#: possible sides of the floor's squares in metres; the view is about five squares wide
SQUARES_METRES = (0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0)
SQUARES_IN_VIEW = 5.0


#: random poses from which the reach of a body is estimated
SAMPLED_POSES = 200
ORIENTATIONS_PER_POSE = 3


class BodyKinematics:
    """Positions of the G geoms that are not fixed to the world, without dynamics."""

    def __init__(self, model: mujoco.MjModel) -> None:
        self.model = model
        self.data = mujoco.MjData(model)
        self._geoms = moving_geoms(model)

    def set_pose(self, qpos: FloatArray) -> None:
        self.data.qpos[:] = qpos
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_camlight(self.model, self.data)

    def boxes(self, axes: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Centres and half sizes (G, 3) in metres of the geoms' bounding boxes in the current pose.

        Args:
            axes: (3, 3), rows are the directions of the boxes' edges.
        """
        rotation = axes @ self.data.geom_xmat[self._geoms].reshape(-1, 3, 3)
        centre, half = np.split(self.model.geom_aabb[self._geoms], 2, axis=1)
        centre = self.data.geom_xpos[self._geoms] @ axes.T + np.einsum("gij,gj->gi", rotation, centre)
        return centre, np.einsum("gij,gj->gi", np.abs(rotation), half)

    def geom_extents(self, qpos: FloatArray, axes: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Lowest and highest corners (T, G, 3) in metres of the box around each geom in each pose (T, nq)."""
        corners = np.empty((2, len(qpos), len(self._geoms), 3))
        for step, state in enumerate(qpos):
            self.set_pose(state)
            centre, half = self.boxes(axes)
            corners[0, step] = centre - half
            corners[1, step] = centre + half
        return corners[0], corners[1]

    def extents(self, qpos: FloatArray, axes: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Lowest and highest corners (T, 3) in metres of the box around all geoms in each pose (T, nq)."""
        lowest, highest = self.geom_extents(qpos, axes)
        return lowest.min(axis=1), highest.max(axis=1)

    def sample_poses(self) -> FloatArray:
        """(P, nq): the model's default pose, and random poses of all driven hinges. The same in every call."""
        model, rng = self.model, np.random.default_rng(0)
        poses = np.tile(model.qpos0, (1 + SAMPLED_POSES, 1))
        joints = model.actuator_trnid[model.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT, 0]
        for joint in joints[model.jnt_type[joints] == mujoco.mjtJoint.mjJNT_HINGE]:
            low, high = model.jnt_range[joint] if model.jnt_limited[joint] else (-np.pi, np.pi)
            poses[1:, model.jnt_qposadr[joint]] = rng.uniform(low, high, SAMPLED_POSES)
        return poses

    def sample_orientations(self, poses: FloatArray) -> FloatArray:
        """(R * P, nq): the poses (P, nq), each in R random orientations of the whole body, as when it falls over."""
        model, rng = self.model, np.random.default_rng(1)
        turned = np.repeat(poses, ORIENTATIONS_PER_POSE, axis=0)
        driven = model.actuator_trnid[model.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT, 0]
        for joint in np.setdiff1d(np.arange(model.njnt), driven):
            address = model.jnt_qposadr[joint]
            if model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_FREE:
                quaternions = rng.normal(size=(len(turned), 4))
                turned[:, address + 3 : address + 7] = quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)
            elif model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_HINGE:
                low, high = model.jnt_range[joint] if model.jnt_limited[joint] else (-np.pi, np.pi)
                turned[:, address] = rng.uniform(low, high, len(turned))
        return turned


#: name of a custom number of a model, with which a task chooses the view of its clips: x, y and z of the target and the
#: visible height in metres, the camera's azimuth and its angle below the horizon in degrees
CLIP_VIEW = "clip_view"
#: the azimuth in degrees of a camera with the world's x to its right
DEFAULT_AZIMUTH = 90.0
#: half width of the window that smooths the body's path
SMOOTHING_SECONDS = 0.4
#: share of the view that the body may fill
FILLED_SHARE = 0.94
#: size of a body relative to the view up to which its outermost parts are cut off instead of zooming out
CUT_OFF = 1.1


@dataclass(frozen=True, slots=True)
class View:
    """Half size in metres of the visible region at the distance of the body."""

    half_width: float
    half_height: float


def camera_path(
    lowest: NDArray[np.float64],
    highest: NDArray[np.float64],
    desired: NDArray[np.float64],
    view: View,
    window: int,
) -> NDArray[np.float64]:
    """The points that the camera looks at: near the desired path, and such that the body stays in view.

    Args:
        lowest, highest: corners (T, 2) of the body's bounding box in the image plane in metres: right, up.
        desired: (T, 2), a smooth path, which is taken where the body fits.
        view: size of the visible region.
        window: half width in frames of the smoothing of deviations.

    Returns:
        (T, 2) float64: right, up. The bounding box is within the view in every frame in which it fits.
    """
    half = np.array([view.half_width, view.half_height]) * FILLED_SHARE
    middle = (lowest + highest) / 2
    # The least deviations to either side that keep the body in view, smoothed without becoming smaller.
    ahead = envelope(np.maximum(highest - half - desired, 0.0), window)
    behind = envelope(np.maximum(desired - (lowest + half), 0.0), window)
    path = desired + ahead - behind
    # If deviations to both sides overlap, their sum may be wrong, so clip it. Centre a body larger than the view.
    least, most = highest - half, lowest + half
    return np.where(least > most, middle, np.clip(path, np.minimum(least, most), np.maximum(least, most)))


def smooth(path: NDArray[np.float64], window: int) -> NDArray[np.float64]:
    """Moving average (T,) with ends padded by odd reflection, so that constant velocity is preserved."""
    if len(path) == 1 or window == 0:
        return path.copy()
    padded = np.pad(path, window, mode="reflect", reflect_type="odd")
    kernel = np.full(2 * window + 1, 1 / (2 * window + 1))
    return np.convolve(padded, kernel, mode="valid")


def envelope(need: NDArray[np.float64], window: int) -> NDArray[np.float64]:
    """A smooth curve (T, 2) that is at least `need` everywhere: the moving average of the running maximum."""
    if window == 0 or not need.any():
        return need
    padded = np.pad(need, ((2 * window, 2 * window), (0, 0)), mode="edge")
    raised = np.lib.stride_tricks.sliding_window_view(padded, 2 * window + 1, axis=0).max(axis=-1)
    return np.lib.stride_tricks.sliding_window_view(raised, 2 * window + 1, axis=0).mean(axis=-1)


@dataclass(frozen=True, slots=True)
class Framing:
    """Direction, size and target of the view, for all clips of a task with the same camera."""

    kind: ViewKind
    #: angle of the camera below the horizon
    look_down_degrees: float
    view: View
    #: (3, 3): rows are the directions right, up and away from the camera, in world coordinates
    axes: FloatArray
    #: (3,) metres: the camera's target in the model's default pose
    centre: FloatArray
    #: whether the camera follows the body over the floor
    follows: bool
    #: height of the floor, metres
    floor: float
    #: side of the floor's squares
    square_metres: float
    #: direction of the camera about the vertical axis, as in MuJoCo: at 90, the world's x is to its right
    azimuth_degrees: float = DEFAULT_AZIMUTH
    #: whether the model itself chose the view, which then never moves
    fixed: bool = False

    @property
    def distance(self) -> float:
        """Distance in metres from the camera to its target."""
        return self.view.half_height / float(np.tan(np.radians(VIEW_ANGLE_DEGREES / 2)))

    def excess(self, lowest: FloatArray, highest: FloatArray) -> float:
        """Largest size of the body (corners (T, 2)) in the image, relative to the image's: above 1 it does not fit."""
        size = 2 * np.array([self.view.half_width, self.view.half_height])
        return float(((highest - lowest) / size).max())

    def enlarged(self, factor: float) -> "Framing":
        """This framing from farther away, with a view `factor` times as large."""
        return replace(self, view=View(self.view.half_width * factor, self.view.half_height * factor))

    def zoomed_out_for(self, lowest: FloatArray, highest: FloatArray) -> "Framing":
        """This framing, or one 2, 4, ... times as large if the body (corners (T, 2)) is much larger than the image.

        The framing fits a body in any orientation, so this happens only where parts move away from each other.
        Steps of two are easy to see: nobody mistakes such a clip for one with a smaller or slower body.
        """
        excess = self.excess(lowest, highest) / CUT_OFF
        return self if excess <= 1 else self.enlarged(2.0 ** np.ceil(np.log2(excess)))

    def desired_path(self, lowest: FloatArray, highest: FloatArray, window: int) -> FloatArray:
        """(T, 3) along the axes: the targets of the camera if the body always fits.

        Args:
            lowest, highest: (T, 3), corners of the body's bounding box along the axes.
            window: half width of the smoothing in frames.
        """
        desired = np.tile(self.centre, (len(lowest), 1))
        if self.follows:
            middle = (lowest + highest) / 2 @ self.axes
            for axis in (0, 1):
                desired[:, axis] = smooth(middle[:, axis], window)
        return desired @ self.axes.T

    def in_perspective(
        self, lowest: FloatArray, highest: FloatArray, desired: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Corners (T, 2) of the body projected onto the plane through the camera's target: right, up.

        Each geom is magnified as much as its nearest part, so the result is never too small.

        Args:
            lowest, highest: (T, G, 3), corners of the geoms' boxes along the axes.
            desired: (T, 3), targets of the camera along the axes.
        """
        nearer = np.clip(desired[:, None, 2] - lowest[..., 2], 0.0, self.distance / 2)
        scale = (self.distance / (self.distance - nearer))[..., None]
        around = desired[:, None, :2]
        low, high = around + (lowest[..., :2] - around) * scale, around + (highest[..., :2] - around) * scale
        # Perspective moves parts beyond the target inwards, so take the outer of both positions.
        return np.minimum(low, lowest[..., :2]).min(axis=1), np.maximum(high, highest[..., :2]).max(axis=1)


_CAMERA_KINDS: dict[Camera, ViewKind] = {"side": "side", "top": "above"}


def cameras_of(task_name: str) -> tuple[Camera, ...]:
    """The cameras that show a task from different directions; the first one is the default.

    Raises:
        mapt.tasks.UnknownTask: if no task has this name.
    """
    if (
        task_spec(task_name).renders_itself or find_drawing(task_name) is not None
    ):  # it renders itself, or has a drawing
        return ("follow",)
    body = BodyKinematics(load_model(task_name))
    lowest, highest = body.extents(body.model.qpos0[None], np.eye(3))
    kind = _kind(body, highest[0] - lowest[0])
    return ("follow", *(camera for camera, shown in _CAMERA_KINDS.items() if shown != kind))


def frame_body(body: BodyKinematics, aspect: float, camera: Camera = "follow") -> Framing:
    """Choose the framing of a body.

    Args:
        aspect: width of the image over its height.
        camera: `follow` chooses the direction by the body, or takes the model's `CLIP_VIEW`.
    """
    chosen = mujoco.mj_name2id(body.model, mujoco.mjtObj.mjOBJ_NUMERIC, CLIP_VIEW)
    if chosen >= 0:
        return _chosen_view(body, aspect, camera, chosen)
    model, poses = body.model, body.sample_poses()
    world = body.extents(poses, np.eye(3))
    body.set_pose(model.qpos0)
    kind = _CAMERA_KINDS.get(camera) or _kind(body, world[1][0] - world[0][0])
    follows, floor = _travels(model), _floor(body, world[0])
    look_down = TOP_LOOK_DOWN_DEGREES if camera == "top" else LOOK_DOWN_DEGREES[kind]
    axes = camera_axes(look_down)
    lowest, highest = body.extents(poses, axes)
    if follows:
        width, height, _ = (highest - lowest).max(axis=0) * MARGIN[kind]
        centre = (world[0][0] + world[1][0]) / 2
    else:
        least, most = np.quantile(lowest, 1 - REACH_QUANTILE, axis=0), np.quantile(highest, REACH_QUANTILE, axis=0)
        width, height, _ = (most - least) * STATIONARY_MARGIN
        centre = (least + most) / 2 @ axes
    half_width = float(max(width, height * aspect) / 2)
    view = View(half_width, half_width / aspect)
    framing = Framing(kind, look_down, view, axes, centre, follows, floor, _square(2 * half_width))
    if follows:
        framing = framing.enlarged(max(1.0, _excess_in_any_orientation(body, framing, poses)))
    if kind == "side":
        centre[2] = floor + max(framing.view.half_height * (1 - 2 * FLOOR_SHARE), centre[2] - floor)
    elif kind == "slanted" and follows:
        centre[2] = floor + (world[1] - world[0])[:, 2].max() / 2
    return replace(framing, centre=centre)


def _chosen_view(body: BodyKinematics, aspect: float, camera: Camera, numeric: int) -> Framing:
    """The framing that a model chooses by `CLIP_VIEW`. Other cameras look at the same place from other angles."""
    model = body.model
    first = model.numeric_adr[numeric]
    x, y, z, height, azimuth, look_down = model.numeric_data[first : first + 6].tolist()
    look_down = TOP_LOOK_DOWN_DEGREES if camera == "top" else look_down
    azimuth += CHOSEN_SIDE_TURN_DEGREES if camera == "side" else 0.0
    view = View(height / 2 * aspect, height / 2)
    return Framing(
        kind="above" if camera == "top" else "slanted",
        look_down_degrees=look_down,
        view=view,
        axes=camera_axes(look_down, azimuth),
        centre=np.array([x, y, z]),
        follows=False,
        floor=_floor(body, body.extents(model.qpos0[None], np.eye(3))[0]),
        square_metres=_square(2 * view.half_width),
        azimuth_degrees=azimuth,
        fixed=True,
    )


def _excess_in_any_orientation(body: BodyKinematics, framing: Framing, poses: FloatArray) -> float:
    """`Framing.excess` over poses (P, nq) in random orientations, with the camera aimed at the body's middle."""
    lowest, highest = body.geom_extents(body.sample_orientations(poses), framing.axes)
    middle = (lowest.min(axis=1) + highest.max(axis=1)) / 2
    return framing.excess(*framing.in_perspective(lowest, highest, middle))


def camera_axes(look_down_degrees: float, azimuth_degrees: float = DEFAULT_AZIMUTH) -> FloatArray:
    """(3, 3): the directions right, up and away of a camera, in world coordinates."""
    down, turn = np.radians(look_down_degrees), np.radians(azimuth_degrees - DEFAULT_AZIMUTH)
    right, ahead, up = np.array([[np.cos(turn), np.sin(turn), 0], [-np.sin(turn), np.cos(turn), 0], [0, 0, 1]])
    return np.array([right, np.sin(down) * ahead + np.cos(down) * up, np.cos(down) * ahead - np.sin(down) * up])


def _kind(body: BodyKinematics, size: FloatArray) -> ViewKind:
    model = body.model
    hinges = model.jnt_type == mujoco.mjtJoint.mjJNT_HINGE
    slides = model.jnt_type == mujoco.mjtJoint.mjJNT_SLIDE
    if not (hinges | slides).all():
        return "slanted"

    def in_plane(normal: int) -> bool:
        along = np.abs(body.data.xaxis[:, normal])
        return bool((along[hinges] > 0.99).all() and (along[slides] < 0.01).all())

    if in_plane(1) and size[1] < MAX_SIDE_VIEW_WIDTH * max(size[0], size[2]):
        return "side"
    return "above" if in_plane(2) else "slanted"


def _travels(model: mujoco.MjModel) -> bool:
    """Whether the body has a free joint or an unlimited slide."""
    free = model.jnt_type == mujoco.mjtJoint.mjJNT_FREE
    endless = (model.jnt_type == mujoco.mjtJoint.mjJNT_SLIDE) & (model.jnt_limited == 0)
    return bool((free | endless).any())


def _floor(body: BodyKinematics, lowest: FloatArray) -> float:
    """Height of the highest plane; without a plane, of the body's lowest point."""
    planes = np.flatnonzero(body.model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE)
    return float(body.data.geom_xpos[planes, 2].max() if planes.size else lowest[0, 2])


def _square(view_width: float) -> float:
    return min(SQUARES_METRES, key=lambda side: abs(np.log(view_width / SQUARES_IN_VIEW / side)))
