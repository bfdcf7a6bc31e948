"""Simulator states to frames, with one OpenGL context for all clips of a task.

`MUJOCO_GL` is read when mujoco is first imported: see `mapt.rendering.offscreen`.
"""

# mujoco is compiled and ships no stubs.
# pyright: reportAttributeAccessIssue=false

from collections.abc import Iterator, Sequence
from types import TracebackType
from typing import Self

import mujoco
import numpy as np
from numpy.typing import NDArray

from mapt.rendering import appearance as decor
from mapt.rendering.appearance import has_squares, painted
from mapt.rendering.camera import LOOK_DOWN_DEGREES, SMOOTHING_SECONDS, Body, Framing, camera_path, frame
from mapt.rendering.settings import RenderSettings

Float64s = NDArray[np.float64]
#: how far behind the body the floor begins to fade into the backdrop, in squares of it
FADING = 1.0
#: where it begins to fade and is gone, in distances of the camera, when seen from higher up
FADING_FAR, FADED_FAR = 1.25, 2.2
#: how far the ground is below the lowest part or floor, in squares
GROUND_DEPTH = 0.05
#: posts, lines and grid go on beyond the view's edge by this
BEYOND = 1.5
_ROUND = (mujoco.mjtGeom.mjGEOM_CAPSULE, mujoco.mjtGeom.mjGEOM_CYLINDER)


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
        self._framing: Framing = frame(Body(model), settings.width / settings.height)
        self._model = painted(model, agent_geoms, settings, self._framing.square_metres)
        self._body = Body(self._model)
        self._shared = _shared(self._model, agent_geoms)
        self._squares = has_squares(self._model)
        self._ground = self._lowest() - GROUND_DEPTH * self._framing.square_metres
        self._camera = self._looking()
        self._fade()
        self._renderer = mujoco.Renderer(self._model, settings.height, settings.width)
        flags = self._renderer.scene.flags
        flags[mujoco.mjtRndFlag.mjRND_FOG] = self._framing.kind != "above"
        flags[mujoco.mjtRndFlag.mjRND_SHADOW] = settings.quality == "pretty"
        for dear in ("SKYBOX", "REFLECTION", "HAZE"):
            flags[getattr(mujoco.mjtRndFlag, f"mjRND_{dear}")] = False

    def frames(self, qpos: Float64s, qvel: Float64s) -> Iterator[NDArray[np.uint8]]:
        """Draw one frame a state.

        Args:
            qpos, qvel: simulator states, float64 (T,nq) and (T,nv).

        Yields:
            uint8 (H,W,3), RGB, top row first. Each is a fresh array.

        Raises:
            ValueError: if the states are not of this model, none, or not finite.
        """
        self._check(qpos, qvel)
        lowest, highest = self._body.extents(qpos, self._framing.axes)
        start = (lowest[0] + highest[0]) / 2 @ self._framing.axes
        framing, targets = self._targets(lowest, highest)
        self._camera.distance = framing.distance
        for state, target in zip(qpos, targets, strict=True):
            self._body.place(state)
            self._camera.lookat[:] = target
            self._renderer.update_scene(self._body.data, self._camera)
            self._decorate(framing, target, start)
            yield self._renderer.render()

    def _targets(self, lowest: Float64s, highest: Float64s) -> tuple[Framing, Float64s]:
        """The framing for these corners (T,3), along its axes, and what the camera looks at (T,3), in the world."""
        window = round(SMOOTHING_SECONDS * self._settings.frame_rate_hz)
        targets = self._framing.wished(lowest, highest, window)
        framing = self._framing.fitting(*self._framing.in_perspective(lowest, highest, targets))
        lowest, highest = framing.in_perspective(lowest, highest, targets)
        targets[:, :2] = camera_path(lowest, highest, targets[:, :2], framing.view, window)
        return framing, targets @ framing.axes

    def _decorate(self, framing: Framing, target: Float64s, start: Float64s) -> None:
        scene, square, floor = self._renderer.scene, framing.square_metres, framing.floor
        reach = framing.view.half_width * BEYOND
        if framing.kind == "side":
            decor.add_backdrop(scene, target, square)
            decor.add_posts(scene, target, reach, floor, square)
        else:
            decor.add_ground(scene, target, self._ground, square)
        if framing.follows and not self._squares:
            decor.add_grid(scene, target, reach, floor, square)
        if framing.kind != "above":
            decor.add_shadows(scene, self._body.boxes(np.eye(3)), floor, square)
        if framing.follows and abs(start[0] - target[0]) < reach:
            decor.add_start(scene, start, floor, square)
        decor.add_bands(scene, self._body.data, self._shared)

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

    def _looking(self) -> mujoco.MjvCamera:
        camera = mujoco.MjvCamera()
        camera.type = mujoco.mjtCamera.mjCAMERA_FREE
        camera.azimuth, camera.elevation = 90, -LOOK_DOWN_DEGREES[self._framing.kind]
        camera.distance = self._framing.distance
        return camera

    def _fade(self) -> None:
        # Fog is a setting of the OpenGL context: it must be known before the renderer opens one.
        square, distance = self._framing.square_metres, self._framing.distance
        near, far = FADING_FAR * distance, FADED_FAR * distance
        if self._framing.kind == "side":
            near, far = distance + FADING * square, distance + decor.BACKDROP * square
        extent, fog = self._model.stat.extent, self._model.vis.map
        fog.fogstart, fog.fogend = near / extent, far / extent

    def _lowest(self) -> float:
        """Height of the lowest part as the model is placed, or of the floor if that is lower."""
        lowest, _ = self._body.extents(self._model.qpos0[None], np.eye(3))
        return min(self._framing.floor, float(lowest[0, 2]))


def _shared(model: mujoco.MjModel, agent_geoms: Sequence[Sequence[int]]) -> dict[int, tuple[int, ...]]:
    """Agents by geom, of the limbs that several agents move."""
    movers = {
        geom: tuple(agent for agent, geoms in enumerate(agent_geoms) if geom in geoms)
        for geom in np.flatnonzero(np.isin(model.geom_type, _ROUND)).tolist()
    }
    return {geom: agents for geom, agents in movers.items() if len(agents) > 1}
