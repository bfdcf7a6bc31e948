"""Render the states of tasks that have a drawing of their own. Needs no OpenGL."""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from mapt.rendering.appearance import agent_colour, rgb_bytes
from mapt.rendering.settings import RenderSettings
from mapt.tasks import Drawing, TaskSpec


class DrawnRenderer:
    """Renders clips of one task by its drawing, with the agents' colours. Quality and camera do not matter."""

    def __init__(self, drawing: Drawing, spec: TaskSpec, settings: RenderSettings) -> None:
        self._drawing, self._spec, self._settings = drawing, spec, settings
        self._colours = [rgb_bytes(agent_colour(agent)) for agent in range(spec.n_agents)]

    def frames(self, qpos: NDArray[np.float64], _qvel: NDArray[np.float64]) -> Iterator[NDArray[np.uint8]]:
        """Draw one frame per state.

        Args:
            qpos: drawn states, float64 (T, nq).

        Yields:
            uint8 (H, W, 3), RGB, top row first. Each is a new array.

        Raises:
            ValueError: if there are no states, or they have another size or are not finite.
        """
        if qpos.ndim != 2 or not len(qpos) or qpos.shape[1] != self._spec.nq:
            raise ValueError(f"States must have shape (T, {self._spec.nq}) with T >= 1, got {qpos.shape}.")
        if not np.isfinite(qpos).all():
            raise ValueError("The states hold NaN or infinite numbers.")
        yield from self._drawing.frames(qpos, self._settings.height, self._settings.width, self._colours)

    def close(self) -> None:
        """Does nothing: there is no OpenGL context."""
