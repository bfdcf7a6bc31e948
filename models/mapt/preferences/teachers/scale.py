"""How large a difference between segments is, as far as a teacher has seen."""

import numpy as np
from numpy.typing import NDArray

from mapt.preferences.teachers.evidence import Float64s

#: Pairs that a running mean reaches back over.
WINDOW_PAIRS = 500


class RunningScale:
    """Running mean, spread and length of the segments of the last `WINDOW_PAIRS` pairs.

    Pair i is measured by the pairs up to and including itself, so that labels do not depend on how pairs come in
    batches.
    """

    def __init__(self) -> None:
        #: of the pairs in reach: sum of both scores, of their squares, and of both lengths; (pairs, 3)
        self._recent: Float64s = np.zeros((0, 3))

    def see(self, scores: Float64s, lengths: NDArray[np.int64]) -> tuple[Float64s, Float64s, Float64s]:
        """Take in B more pairs.

        Args:
            scores, lengths: of both segments, (B, 2).

        Returns:
            (B,) each: mean score, standard deviation of scores, and mean length, in steps.
        """
        n_new = len(scores)
        new = np.stack((scores.sum(1), np.square(scores).sum(1), lengths.sum(1)), axis=1)
        known = np.concatenate((self._recent, new))
        sums = np.concatenate((np.zeros((1, 3)), known.cumsum(axis=0)))
        ends = np.arange(len(known) - n_new, len(known)) + 1
        firsts = np.maximum(ends - WINDOW_PAIRS, 0)
        mean, square, length = ((sums[ends] - sums[firsts]) / (2 * (ends - firsts))[:, None]).T
        self._recent = known[len(known) - min(len(known), WINDOW_PAIRS - 1) :]
        return mean, np.sqrt(np.maximum(square - np.square(mean), 0.0)), length
