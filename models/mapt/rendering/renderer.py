"""Simulator states to frames, with one OpenGL context for all clips of a task.

`MUJOCO_GL` is read when mujoco is first imported: see `mapt.rendering.environment`.
"""

# mujoco is compiled and ships no stubs.
# pyright: reportAttributeAccessIssue=false

from collections.abc import Iterator, Sequence
from types import TracebackType
from typing import Self

import mujoco
import numpy as np
from numpy.typing import NDArray

from mapt.rendering.camera import SMOOTHING_SECONDS, View, camera_path
from mapt.rendering.decor import BACKDROP_METRES, add_backdrop, add_marks, add_shadows
from mapt.rendering.scene import VIEW_ANGLE_DEGREES, moving_geoms, painted
from mapt.rendering.settings import RenderSettings

#: width of the view in lengths of the body
VIEW_BODY_LENGTHS = 1.75
#: how far the camera looks down, degrees: enough to see the floor's squares
LOOK_DOWN_DEGREES = 9.0
#: part of the view's height that is below the floor's line
FLOOR_SHARE = 0.2
#: how far behind the body the floor begins to fade into the backdrop
FADING_METRES = 0.5


class ClipRenderer:
    """Draws clips of one model. Not thread-safe: an OpenGL context belongs to one thread."""

    def __init__(self, model: mujoco.MjModel, agent_geoms: Sequence[Sequence[int]], settings: RenderSettings) -> None:
        """Open the OpenGL context (0.8 to 1.7 s in a process's first).

        Args:
            model: the task's model; left as it is.
            agent_geoms: ids of the geoms that each of the N agents moves.
            settings: size and quality.

        Raises:
            ValueError: if a geom is not of the model.
        """
        self._settings = settings
        self._model = painted(model, agent_geoms, settings)
        self._data = mujoco.MjData(self._model)
        self._body = moving_geoms(self._model)
        self._view = self._framing()
        self._camera = self._side_view()
        # Fog is a setting of the OpenGL context: it must be known before the renderer opens one.
        self._model.vis.map.fogstart = (self._camera.distance + FADING_METRES) / self._model.stat.extent
        self._model.vis.map.fogend = (self._camera.distance + BACKDROP_METRES) / self._model.stat.extent
        self._renderer = mujoco.Renderer(self._model, settings.height, settings.width)
        flags = self._renderer.scene.flags
        flags[mujoco.mjtRndFlag.mjRND_FOG] = True
        flags[mujoco.mjtRndFlag.mjRND_SHADOW] = settings.quality == "pretty"
        for dear in ("SKYBOX", "REFLECTION", "HAZE"):
            flags[getattr(mujoco.mjtRndFlag, f"mjRND_{dear}")] = False

    def frames(self, qpos: NDArray[np.float64], qvel: NDArray[np.float64]) -> Iterator[NDArray[np.uint8]]:
        """Draw one frame a state.

        Args:
            qpos, qvel: simulator states, float64 (T,nq) and (T,nv).

        Yields:
            uint8 (H,W,3), RGB, top row first. Each is a fresh array.

        Raises:
            ValueError: if the states are not of this model, none, or not finite.
        """
        self._check(qpos, qvel)
        lowest, highest = self._extents(qpos)
        start = float(lowest[0, 0] + highest[0, 0]) / 2
        window = round(SMOOTHING_SECONDS * self._settings.frame_rate_hz)
        for state, (along, up) in zip(qpos, camera_path(lowest, highest, self._view, window), strict=True):
            self._place(state)
            self._camera.lookat[:] = along, 0.0, up
            self._renderer.update_scene(self._data, self._camera)
            add_backdrop(self._renderer.scene, along)
            add_shadows(self._renderer.scene, *self._boxes())
            add_marks(self._renderer.scene, along, self._view.half_width, start)
            yield self._renderer.render()

    def close(self) -> None:
        """Free the OpenGL context."""
        self._renderer.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _check(self, qpos: NDArray[np.float64], qvel: NDArray[np.float64]) -> None:
        steps = len(qpos)
        if qpos.shape != (steps, self._model.nq) or qvel.shape != (steps, self._model.nv):
            raise ValueError(
                f"States of shapes {qpos.shape} and {qvel.shape} are not of this model: "
                f"(T,{self._model.nq}) and (T,{self._model.nv}) are."
            )
        if steps == 0:
            raise ValueError("A clip needs at least one state.")
        if not np.isfinite(qpos).all():
            raise ValueError("The states hold NaN or infinite positions: the simulation diverged.")

    def _place(self, qpos: NDArray[np.float64]) -> None:
        # Positions and lights are all that is drawn: no dynamics, so no velocities.
        self._data.qpos[:] = qpos
        mujoco.mj_kinematics(self._model, self._data)
        mujoco.mj_camlight(self._model, self._data)

    def _boxes(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Centres and half sizes of the world-aligned boxes around the body's geoms, metres (geoms,3)."""
        turn = self._data.geom_xmat[self._body].reshape(-1, 3, 3)
        centre, half = np.split(self._model.geom_aabb[self._body], 2, axis=1)
        centre = self._data.geom_xpos[self._body] + np.einsum("gij,gj->gi", turn, centre)
        return centre, np.einsum("gij,gj->gi", np.abs(turn), half)

    def _extents(self, qpos: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Lowest and highest corners of the body, along and up, metres: two of (T,2)."""
        corners = np.empty((2, len(qpos), 2))
        for step, state in enumerate(qpos):
            self._place(state)
            centre, half = self._boxes()
            corners[0, step] = (centre - half).min(axis=0)[[0, 2]]
            corners[1, step] = (centre + half).max(axis=0)[[0, 2]]
        return corners[0], corners[1]

    def _side_view(self) -> mujoco.MjvCamera:
        camera = mujoco.MjvCamera()
        camera.type = mujoco.mjtCamera.mjCAMERA_FREE
        camera.azimuth, camera.elevation = 90, -LOOK_DOWN_DEGREES
        camera.distance = self._view.half_height / np.tan(np.radians(VIEW_ANGLE_DEGREES / 2))
        return camera

    def _framing(self) -> View:
        """What to see of this body: found from its length when it stands."""
        lowest, highest = self._extents(self._model.qpos0[None])
        half_width = float(np.ptp([lowest[0, 0], highest[0, 0]])) * VIEW_BODY_LENGTHS / 2
        half_height = half_width * self._settings.height / self._settings.width
        return View(half_width, half_height, half_height * (1 - 2 * FLOOR_SHARE))
