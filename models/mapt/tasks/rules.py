"""What makes a scene a task: starts, rewards, ends, and what can be seen, each for a batch of environments."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from mapt.tasks.layout import Column, Layout, Shapes

Float64s = NDArray[np.float64]
#: Every feature by name, each (E, ...): qpos, qvel, the fields that the rules name, and what they compute.
Frame = Mapping[str, Float64s]


def no_features(_frame: Frame) -> None:
    """Nothing is computed beyond positions, velocities and fields."""


def never_terminated(frame: Frame) -> NDArray[np.bool_]:
    """(E,) bool: no state is without a future."""
    return np.zeros(len(frame["qpos"]), dtype=bool)


@dataclass(frozen=True, slots=True)
class MujocoRules:
    """The rules of a task on MuJoCo."""

    #: Physics steps per step of the task.
    frame_skip: int
    #: (generator, n) -> qpos (n, nq), qvel (n, nv) of n fresh episodes.
    draw_start: Callable[[np.random.Generator, int], tuple[Float64s, Float64s]]
    #: (frame before, frame after, controls (E, nu)) -> reward (E,). The frame before holds `before` alone.
    reward: Callable[[Frame, Frame, Float64s], Float64s]
    #: What the state is made of.
    state: tuple[Column, ...]
    #: frame after -> terminated (E,) bool.
    terminated: Callable[[Frame], NDArray[np.bool_]] = never_terminated
    #: Features that the reward reads from the frame before the step.
    before: tuple[str, ...] = ("qpos",)
    #: Fields of MjData that are read, with their shapes. As after `mj_step`, they describe the last stage of the
    #: integrator, not the state that it reached.
    fields: Shapes = field(default_factory=dict)
    #: Shapes of what `compute` writes.
    features: Shapes = field(default_factory=dict)
    #: Writes every one of `features` into the frame, in place.
    compute: Callable[[Frame], None] = no_features

    def layout(self, nq: int, nv: int) -> Layout:
        return Layout({"qpos": (nq,), "qvel": (nv,), **self.fields, **self.features})


def uniform_about(
    qpos: Float64s, n_velocities: int, scale: float, *, normal_velocities: bool = False
) -> Callable[[np.random.Generator, int], tuple[Float64s, Float64s]]:
    """Starts about a pose at rest: uniform noise within plus and minus `scale` on each position.

    Velocities are as wide, or normal with this deviation.
    """

    def draw(rng: np.random.Generator, n: int) -> tuple[Float64s, Float64s]:
        positions = qpos + rng.uniform(-scale, scale, size=(n, qpos.size))
        if normal_velocities:
            return positions, scale * rng.standard_normal((n, n_velocities))
        return positions, rng.uniform(-scale, scale, size=(n, n_velocities))

    return draw


def squared(numbers: Float64s) -> Float64s:
    """Sum of squares of each environment, (E,)."""
    flat = numbers.reshape(len(numbers), -1)
    return np.vecdot(flat, flat)
