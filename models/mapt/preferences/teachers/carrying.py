"""A rule for the tasks Porters-2x8 and Porters-4x8: ants that carry a board should carry it level and walk in step."""

from dataclasses import dataclass

import numpy as np

from mapt.errors import MissingArray
from mapt.preferences.teachers.rules import Rule, masked_means
from mapt.preferences.teachers.view import Float64s, TeacherView

#: the layout of qpos and qvel: per ant a free joint and eight hinges, and at the end the board's free joint
ANT_NQ, ANT_NV, BOARD_NQ, BOARD_NV = 15, 14, 7, 6
TORSO_NV = 6


#: simulated time of one step of these tasks
STEP_SECONDS = 0.05


@dataclass(frozen=True, slots=True)
class Carrying(Rule):
    """Prefers a board that is carried forwards, level, by ants in step.

    Each second of a segment is worth `carried`, plus the board's mean speed along x in m/s, less `level` times its mean
    tilt in radians, plus `step` times the mean correlation of the ants' joint velocities with those of the first ant,
    from -1 to 1. A segment that ends early, because the board or an ant fell, has fewer seconds.
    """

    carried: float = 2.0
    level: float = 5.0
    step: float = 1.0

    @property
    def reads(self) -> tuple[str, ...]:
        return ("qpos", "qvel")

    def scores(self, view: TeacherView) -> Float64s:
        """See `Rule.scores`."""
        qpos, qvel = view.require("qpos").astype(np.float64), view.require("qvel").astype(np.float64)
        n_ants, rest = divmod(qpos.shape[2] - BOARD_NQ, ANT_NQ)
        if n_ants < 2 or rest or qvel.shape[2] != n_ants * ANT_NV + BOARD_NV:
            raise MissingArray("a board and ants that carry it (tasks Porters-2x8 and Porters-4x8)")
        speed = masked_means(qvel[..., -BOARD_NV], view.mask)
        cosine = 1.0 - 2.0 * (np.square(qpos[..., -3]) + np.square(qpos[..., -2]))
        tilt = masked_means(np.arccos(np.clip(cosine, -1.0, 1.0)), view.mask)
        worth = self.carried + speed - self.level * tilt + self.step * self._in_step(view, qvel, n_ants)
        return worth * view.lengths * STEP_SECONDS

    @staticmethod
    def _in_step(view: TeacherView, qvel: Float64s, n_ants: int) -> Float64s:
        """Mean correlation of the ants' joint velocities with those of the first, (B,); 0 for an ant at rest."""
        ants = qvel[..., :-BOARD_NV].reshape(*qvel.shape[:2], n_ants, ANT_NV)[..., TORSO_NV:]
        real = view.mask[:, :, None, None]
        centred = np.where(real, ants - masked_means(ants, view.mask)[:, None], 0.0)
        first, others = centred[:, :, :1], centred[:, :, 1:]
        products = (first * others).sum(axis=(1, 3))
        size = np.sqrt(np.square(first).sum(axis=(1, 3)) * np.square(others).sum(axis=(1, 3)))
        return np.divide(products, size, out=np.zeros_like(products), where=size > 0).mean(axis=1)
