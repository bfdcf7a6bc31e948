"""Rules about how a segment went: none but the return is a sum over its steps of something that a step alone shows."""

from abc import abstractmethod
from dataclasses import dataclass
from typing import Literal

import numpy as np

from mapt.preferences.teachers.evidence import Evidence, Float64s
from mapt.preferences.teachers.rule import RewardRule, Rule
from mapt.preferences.teachers.windows import check_window, last_means, real_means, window_means

#: a second of MaMuJoCo's HalfCheetah, 0.05 s a step
SECOND_STEPS = 20


@dataclass(frozen=True, slots=True)
class Return(RewardRule):
    """The larger sum of true rewards is better: B-Pref's oracle, and the paper's teacher.

    The paper writes label = argmin_j sum_t r_t^j, the number of the worse segment. So 1 says that segment 0 is better,
    as everywhere here.
    """

    @property
    def is_return(self) -> bool:
        return True

    def scores(self, evidence: Evidence) -> Float64s:
        """See `Rule.scores`."""
        return np.where(evidence.mask, evidence.rewards, 0.0).sum(axis=1)


@dataclass(frozen=True, slots=True)
class SecondRule(RewardRule):
    """A rule about one window of the segment, measured by the mean of the whole."""

    window_steps: int = SECOND_STEPS
    #: how much of the segment's own mean is taken off: at 1 the window that stands out most, at 0 the best
    above_mean: float = 1.0

    def __post_init__(self) -> None:
        check_window(self.window_steps)

    @abstractmethod
    def window(self, evidence: Evidence) -> Float64s:
        """Mean reward of the window that counts, float64 (B,)."""

    def scores(self, evidence: Evidence) -> Float64s:
        """See `Rule.scores`."""
        return self.window(evidence) - self.above_mean * real_means(evidence.rewards, evidence.mask)


class BestSecond(SecondRule):
    """The segment whose best second is better: the largest mean reward of any window, whatever the rest was like."""

    __slots__ = ()

    def window(self, evidence: Evidence) -> Float64s:
        """See `SecondRule.window`."""
        means, starts = window_means(evidence.rewards, evidence.mask, self.window_steps)
        return np.where(starts, means, -np.inf).max(axis=1)


class WorstSecond(SecondRule):
    """The segment whose worst second is better: the smallest mean reward of any window, whatever the rest was like.

    With `above_mean` 1 that is the steadiest segment.
    """

    __slots__ = ()

    def window(self, evidence: Evidence) -> Float64s:
        """See `SecondRule.window`."""
        means, starts = window_means(evidence.rewards, evidence.mask, self.window_steps)
        return np.where(starts, means, np.inf).min(axis=1)


class Recency(SecondRule):
    """The segment that ends better: its last second counts, the rest serves as the measure of it.

    With `above_mean` 1 that is the segment that improves most.
    """

    __slots__ = ()

    def window(self, evidence: Evidence) -> Float64s:
        """See `SecondRule.window`."""
        return last_means(evidence.rewards, evidence.mask, self.window_steps)


@dataclass(frozen=True, slots=True)
class Smoothness(Rule):
    """The segment with fewer jerks for the same amount of movement.

    The squared change from step to step, over the squared deviation from the segment's mean (von Neumann's ratio):
    standing nearly still is no merit. A torque acts on acceleration, so its change is the jerk.
    """

    #: columns of the observation whose course should be smooth; none for the actions
    columns: tuple[int, ...] = ()

    @property
    def reads(self) -> tuple[str, ...]:
        return ("observations",) if self.columns else ("actions",)

    def scores(self, evidence: Evidence) -> Float64s:
        """See `Rule.scores`."""
        mask = evidence.mask[:, :, None, None]
        course = evidence.columns(self.columns) if self.columns else evidence.seen("actions").astype(np.float64)
        course = np.where(mask, course, 0.0)
        changes = np.where(mask[:, 1:], np.diff(course, axis=1), 0.0)
        deviations = np.where(mask, course - real_means(course, evidence.mask)[:, None], 0.0)
        change, deviation = (np.square(x).sum(axis=(1, 2, 3)) for x in (changes, deviations))
        return -np.divide(change, deviation, out=np.zeros_like(change), where=deviation > 0)


@dataclass(frozen=True, slots=True)
class Never(Rule):
    """The segment in which nobody does a thing that must not happen; else the one in which it happens later.

    Between two that did it at the same step, the one that did it in fewer steps, then the one that went less far;
    between two that never did, the one that stayed further from it.
    """

    @property
    def reads(self) -> tuple[str, ...]:
        return ("observations",)

    #: column of the observation; of several agents the one that comes closest counts
    column: int
    limit: float
    #: what must not happen: a value above the limit, below it, or an amount beyond it in either direction
    side: Literal["above", "below", "beyond"]

    def scores(self, evidence: Evidence) -> Float64s:
        """See `Rule.scores`."""
        values = evidence.columns((self.column,))[..., 0]
        excess = {"above": values, "below": -values, "beyond": np.abs(values)}[self.side]
        excess = (excess - (-self.limit if self.side == "below" else self.limit)).max(axis=2)
        excess = np.where(evidence.mask, excess, -np.inf)
        broken, lengths, worst = excess > 0, evidence.lengths, excess.max(axis=1)
        kept = np.where(broken.any(axis=1), broken.argmax(axis=1), lengths)
        # In (0, 1): how far the worst step lies from the limit, on whichever side.
        distance = np.abs(worst) / (1 + np.abs(worst))
        # In (-1, 1), so that half of it decides between equal numbers of kept steps alone.
        among_equals = np.where(worst > 0, (1 - broken.sum(axis=1) - distance) / (lengths + 1), distance)
        return (kept + among_equals / 2) / lengths
