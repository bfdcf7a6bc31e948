"""A rule for the tasks whose names begin with Porters-: robots that carry a board should do so level and in step."""

from dataclasses import dataclass

import numpy as np

from mapt.errors import MissingArray
from mapt.preferences.teachers.rules import Rule, masked_means
from mapt.preferences.teachers.view import Float64s, TeacherView

#: of the free joint of a torso, and of the board at the end of qpos and qvel
FREE_NQ, FREE_NV = 7, 6
#: simulated time of one step of these tasks
STEP_SECONDS = 0.05


@dataclass(frozen=True, slots=True)
class Legs:
    """The joints of a kind of porter that show whether a team is in step."""

    #: of all hinges of one porter
    n_hinges: int
    #: indices among the hinges: of the first porter, and of the others in the same order
    first: tuple[int, ...]
    others: tuple[int, ...]
    #: 1, or -1 where the others' joints turn the other way in the same movement
    signs: tuple[int, ...]


#: Ants face the same way; all their joints count.
ANT_LEGS = Legs(8, tuple(range(8)), tuple(range(8)), (1,) * 8)
#: Hips and knees, right and left. The other humanoid faces the first one: its left leg is beside the first one's right
#: leg, and swings to the same side when the hip turns the other way.
HUMANOID_LEGS = Legs(17, (5, 6, 9, 10), (9, 10, 5, 6), (-1, 1, -1, 1))


@dataclass(frozen=True, slots=True)
class Carrying(Rule):
    """Prefers a board that is carried forwards, level, by porters in step.

    Each second of a segment is worth `carried`, plus the board's mean speed along x in m/s, less `level` times its mean
    tilt in radians, plus `step` times the mean correlation of the porters' joint velocities with those of the first
    one, from -1 to 1: all joints of ants, hips and knees of humanoids. A segment that ends early, because the board or
    a porter fell, has fewer seconds.
    """

    carried: float = 2.0
    level: float = 5.0
    step: float = 1.0

    @property
    def reads(self) -> tuple[str, ...]:
        return ("qpos", "qvel")

    @property
    def task_prefix(self) -> str:
        return "Porters-"

    def scores(self, view: TeacherView) -> Float64s:
        """See `Rule.scores`."""
        qpos, qvel = view.require("qpos").astype(np.float64), view.require("qvel").astype(np.float64)
        legs = next((legs for legs in (ANT_LEGS, HUMANOID_LEGS) if _fits(legs, qpos.shape[2], qvel.shape[2])), None)
        if legs is None:
            raise MissingArray("a board and robots that carry it (tasks whose names begin with Porters-)")
        speed = masked_means(qvel[..., -FREE_NV], view.mask)
        cosine = 1.0 - 2.0 * (np.square(qpos[..., -3]) + np.square(qpos[..., -2]))
        tilt = masked_means(np.arccos(np.clip(cosine, -1.0, 1.0)), view.mask)
        worth = self.carried + speed - self.level * tilt + self.step * self._in_step(view, qvel, legs)
        return worth * view.lengths * STEP_SECONDS

    @staticmethod
    def _in_step(view: TeacherView, qvel: Float64s, legs: Legs) -> Float64s:
        """Mean correlation of the porters' joint velocities with those of the first, (B,); 0 for a porter at rest."""
        width = FREE_NV + legs.n_hinges
        hinges = qvel[..., :-FREE_NV].reshape(*qvel.shape[:2], -1, width)[..., FREE_NV:]
        first, others = hinges[:, :, :1, list(legs.first)], hinges[:, :, 1:, list(legs.others)] * legs.signs
        first, others = _centred(view, first), _centred(view, others)
        products = (first * others).sum(axis=(1, 3))
        size = np.sqrt(np.square(first).sum(axis=(1, 3)) * np.square(others).sum(axis=(1, 3)))
        return np.divide(products, size, out=np.zeros_like(products), where=size > 0).mean(axis=1)


def _centred(view: TeacherView, velocities: Float64s) -> Float64s:
    """Velocities (B, T, N, J) less their means over the steps of each segment; 0 after its end."""
    real = view.mask[:, :, None, None]
    return np.where(real, velocities - masked_means(velocities, view.mask)[:, None], 0.0)


def _fits(legs: Legs, nq: int, nv: int) -> bool:
    """Whether these are the sizes of qpos and qvel of a board and two or more porters."""
    n_porters, rest = divmod(nq - FREE_NQ, FREE_NQ + legs.n_hinges)
    return n_porters >= 2 and not rest and nv == n_porters * (FREE_NV + legs.n_hinges) + FREE_NV
