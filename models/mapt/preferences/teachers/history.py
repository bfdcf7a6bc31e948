"""Rules about how a segment went: none but the return is a sum over its steps of something that a step alone shows."""

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
class BestSecond(RewardRule):
    """The segment whose best second is better: the largest mean reward of any window, whatever the rest was like."""

    window_steps: int = SECOND_STEPS
    #: how much of the segment's own mean is taken off: at 1 the best second that stands out most, at 0 the best
    above_mean: float = 1.0

    def __post_init__(self) -> None:
        check_window(self.window_steps)

    def scores(self, evidence: Evidence) -> Float64s:
        """See `Rule.scores`."""
        means, starts = window_means(evidence.rewards, evidence.mask, self.window_steps)
        best = np.where(starts, means, -np.inf).max(axis=1)
        return best - self.above_mean * real_means(evidence.rewards, evidence.mask)


@dataclass(frozen=True, slots=True)
class WorstSecond(RewardRule):
    """The segment whose worst second is better: the smallest mean reward of any window, whatever the rest was like."""

    window_steps: int = SECOND_STEPS
    #: as of `BestSecond`: at 1 the steadiest segment, at 0 the one with the better worst second
    above_mean: float = 1.0

    def __post_init__(self) -> None:
        check_window(self.window_steps)

    def scores(self, evidence: Evidence) -> Float64s:
        """See `Rule.scores`."""
        means, starts = window_means(evidence.rewards, evidence.mask, self.window_steps)
        worst = np.where(starts, means, np.inf).min(axis=1)
        return worst - self.above_mean * real_means(evidence.rewards, evidence.mask)


@dataclass(frozen=True, slots=True)
class Recency(RewardRule):
    """The segment that ends better: its last second counts, the rest serves as the measure of it."""

    window_steps: int = SECOND_STEPS
    #: as of `BestSecond`: at 1 the segment that improves most, at 0 the one with the better end
    above_mean: float = 1.0

    def __post_init__(self) -> None:
        check_window(self.window_steps)

    def scores(self, evidence: Evidence) -> Float64s:
        """See `Rule.scores`."""
        last = last_means(evidence.rewards, evidence.mask, self.window_steps)
        return last - self.above_mean * real_means(evidence.rewards, evidence.mask)


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
