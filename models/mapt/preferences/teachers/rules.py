"""By what a teacher judges."""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Literal

import numpy as np

from mapt.errors import InvalidTeacher, MissingView
from mapt.preferences.teachers.view import BoolArray, Float64s, TeacherView


@dataclass(frozen=True, slots=True)
class Rule(ABC):
    """What makes one segment better than another. The fields of a rule are its parameters."""

    @property
    @abstractmethod
    def reads(self) -> tuple[str, ...]:
        """Fields of TeacherView that it judges by."""

    @property
    def is_return(self) -> bool:
        """True where scores are true returns, so that 0 means that nothing was achieved."""
        return False

    @abstractmethod
    def scores(self, evidence: TeacherView) -> Float64s:
        """Score of each segment, float64 (B,): the larger, the better. Padding does not change it.

        Raises:
            MissingView: if the evidence lacks what the rule reads.
        """


class RewardRule(Rule):
    """A rule about the course of the true reward."""

    __slots__ = ()

    @property
    def reads(self) -> tuple[str, ...]:
        return ("rewards",)


def check_window(window_steps: int) -> None:
    """Raises InvalidTeacher unless a window can have so many steps."""
    if window_steps < 1:
        raise InvalidTeacher(f"a window has 1 step or more, not {window_steps}")


def window_means(values: Float64s, mask: BoolArray, window_steps: int) -> tuple[Float64s, BoolArray]:
    """Means over every run of `window_steps` successive real steps; a shorter segment is one window.

    Args:
        values: (B, T) or (B, T, N).
        mask: (B, T), real steps first.

    Returns:
        means, shaped like `values`: at step t that of the window that starts there; and bool (B, T), true where one
        does.
    """
    n_steps = values.shape[1]
    extra = (1,) * (values.ndim - 2)
    real = np.where(mask.reshape(*mask.shape, *extra), values, 0.0)
    before = np.concatenate((np.zeros_like(real[:, :1]), real.cumsum(axis=1)), axis=1)
    lengths = mask.sum(axis=1)
    widths = np.minimum(window_steps, lengths)
    starts = np.arange(n_steps)
    ends = np.minimum(starts + widths[:, None], n_steps)
    sums = np.take_along_axis(before, ends.reshape(*ends.shape, *extra), axis=1) - before[:, :-1]
    return sums / widths.reshape(-1, 1, *extra), starts <= (lengths - widths)[:, None]


def last_means(values: Float64s, mask: BoolArray, window_steps: int) -> Float64s:
    """Mean of values (B, T) over the last `window_steps` real steps, or all where there are fewer: (B,)."""
    means, starts = window_means(values, mask, window_steps)
    return means[np.arange(len(means)), starts.sum(axis=1) - 1]


def real_means(values: Float64s, mask: BoolArray) -> Float64s:
    """Mean of values (B, T, ...) over real steps, (B, ...)."""
    extra = (1,) * (values.ndim - 2)
    sums = np.where(mask.reshape(*mask.shape, *extra), values, 0.0).sum(axis=1)
    return sums / mask.sum(axis=1).reshape(-1, *extra)


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

    def scores(self, evidence: TeacherView) -> Float64s:
        """See `Rule.scores`."""
        return np.where(evidence.mask, evidence.rewards, 0.0).sum(axis=1)


@dataclass(frozen=True, slots=True)
class WindowRule(RewardRule):
    """A rule about one window of the segment, measured by the mean of the whole."""

    window_steps: int = SECOND_STEPS
    #: how much of the segment's own mean is taken off: at 1 the window that stands out most, at 0 the best
    above_mean: float = 1.0

    def __post_init__(self) -> None:
        check_window(self.window_steps)

    @abstractmethod
    def window(self, evidence: TeacherView) -> Float64s:
        """Mean reward of the window that counts, float64 (B,)."""

    def scores(self, evidence: TeacherView) -> Float64s:
        """See `Rule.scores`."""
        return self.window(evidence) - self.above_mean * real_means(evidence.rewards, evidence.mask)


class BestWindow(WindowRule):
    """The segment whose best second is better: the largest mean reward of any window, whatever the rest was like."""

    __slots__ = ()

    def window(self, evidence: TeacherView) -> Float64s:
        """See `WindowRule.window`."""
        means, starts = window_means(evidence.rewards, evidence.mask, self.window_steps)
        return np.where(starts, means, -np.inf).max(axis=1)


class WorstWindow(WindowRule):
    """The segment whose worst second is better: the smallest mean reward of any window, whatever the rest was like.

    With `above_mean` 1 that is the steadiest segment.
    """

    __slots__ = ()

    def window(self, evidence: TeacherView) -> Float64s:
        """See `WindowRule.window`."""
        means, starts = window_means(evidence.rewards, evidence.mask, self.window_steps)
        return np.where(starts, means, np.inf).min(axis=1)


class FinalWindow(WindowRule):
    """The segment that ends better: its last second counts, the rest serves as the measure of it.

    With `above_mean` 1 that is the segment that improves most.
    """

    __slots__ = ()

    def window(self, evidence: TeacherView) -> Float64s:
        """See `WindowRule.window`."""
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

    def scores(self, evidence: TeacherView) -> Float64s:
        """See `Rule.scores`."""
        mask = evidence.mask[:, :, None, None]
        course = evidence.columns(self.columns) if self.columns else evidence.seen("actions").astype(np.float64)
        course = np.where(mask, course, 0.0)
        changes = np.where(mask[:, 1:], np.diff(course, axis=1), 0.0)
        deviations = np.where(mask, course - real_means(course, evidence.mask)[:, None], 0.0)
        change, deviation = (np.square(x).sum(axis=(1, 2, 3)) for x in (changes, deviations))
        return -np.divide(change, deviation, out=np.zeros_like(change), where=deviation > 0)


@dataclass(frozen=True, slots=True)
class NeverExceeds(Rule):
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

    def scores(self, evidence: TeacherView) -> Float64s:
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


#: What an agent does in a step: |torque x velocity| of its joints, |torque|, or |velocity|.
Effort = Literal["power", "action", "speed"]


@dataclass(frozen=True, slots=True)
class Phase(Rule):
    """Two agents that swing against each other, or together: the correlation of what they observe over the segment."""

    @property
    def reads(self) -> tuple[str, ...]:
        return ("observations",)

    #: column of the observation; MaMuJoCo's 1 is the velocity of an agent's first joint
    column: int = 1
    #: the first agent; and the second, or -1 for the one half a team further on (HalfCheetah's two thighs)
    first_agent: int = 0
    second_agent: int = -1
    #: which is better: opposite or equal courses
    want: Literal["opposite", "equal"] = "opposite"

    def scores(self, evidence: TeacherView) -> Float64s:
        """See `Rule.scores`; between -1 and 1, and 0 where one of the two does not move."""
        return real_means(self.accord(evidence), evidence.mask)

    def accord(self, evidence: TeacherView) -> Float64s:
        """What each step adds to the correlation, turned so that more is better: float64 (B, T), 0 in padding."""
        half_a_team = self.first_agent + evidence.seen("observations").shape[2] // 2
        second = half_a_team if self.second_agent < 0 else self.second_agent
        courses = evidence.columns((self.column,), (self.first_agent, second))[..., 0]
        courses = np.where(evidence.mask[:, :, None], courses - real_means(courses, evidence.mask)[:, None], 0.0)
        together = courses.prod(axis=2)
        scale = np.sqrt(real_means(np.square(courses), evidence.mask).prod(axis=1))[:, None]
        course = np.divide(together, scale, out=np.zeros_like(together), where=scale > 0)
        return -course if self.want == "opposite" else course


@dataclass(frozen=True, slots=True)
class PhaseImprovement(Phase):
    """Two agents that come to swing as they should: their last second against the whole segment, as by `Phase`.

    Co-operation over time: no step alone tells anything of it, nor does any agent alone.
    """

    window_steps: int = SECOND_STEPS

    def __post_init__(self) -> None:
        check_window(self.window_steps)

    def scores(self, evidence: TeacherView) -> Float64s:
        """See `Rule.scores`; 0 where one of the two does not move."""
        accord = self.accord(evidence)
        return last_means(accord, evidence.mask, self.window_steps) - real_means(accord, evidence.mask)


@dataclass(frozen=True, slots=True)
class EffortBalance(Rule):
    """The segment whose agents did equal shares of the work: least spread of their totals, relative to the mean."""

    effort: Effort = "power"

    @property
    def reads(self) -> tuple[str, ...]:
        return _reads(self.effort)

    def scores(self, evidence: TeacherView) -> Float64s:
        """See `Rule.scores`; 0 where all do the same, or nothing."""
        totals = real_means(_efforts(evidence, self.effort), evidence.mask)
        mean = totals.mean(axis=1)
        return -np.divide(totals.std(axis=1), mean, out=np.zeros_like(mean), where=mean > 0)


@dataclass(frozen=True, slots=True)
class MinimumEffort(Rule):
    """The segment in which at no time one agent rests while the others work.

    The idlest agent's effort in any one window, relative to the mean of all in that window.
    """

    effort: Effort = "power"
    window_steps: int = SECOND_STEPS // 2

    def __post_init__(self) -> None:
        check_window(self.window_steps)

    @property
    def reads(self) -> tuple[str, ...]:
        return _reads(self.effort)

    def scores(self, evidence: TeacherView) -> Float64s:
        """See `Rule.scores`; between 0 and 1, and 1 where all do the same, or nothing."""
        means, starts = window_means(_efforts(evidence, self.effort), evidence.mask, self.window_steps)
        idlest, all_of_them = means.min(axis=2), means.mean(axis=2)
        share = np.divide(idlest, all_of_them, out=np.ones_like(idlest), where=all_of_them > 0)
        return np.where(starts, share, 1.0).min(axis=1)


def _reads(effort: Effort) -> tuple[str, ...]:
    return {"power": ("observations", "actions"), "action": ("actions",), "speed": ("observations",)}[effort]


def _efforts(evidence: TeacherView, effort: Effort) -> Float64s:
    """(B, T, N), 0 in padding.

    An agent with A joints observes position and velocity of one after the other (MaMuJoCo), so that their velocities
    stand in columns 1, 3, ..., 2A - 1.
    """
    actions = evidence.seen("actions").astype(np.float64)
    actions = np.where(evidence.mask[:, :, None, None], actions, 0.0)
    if effort == "action":
        return np.abs(actions).sum(axis=3)
    n_joints = actions.shape[3]
    if evidence.seen("observations").shape[3] < 2 * n_joints:
        raise MissingView(f"the velocities of {n_joints} joints")
    velocities = evidence.columns(range(1, 2 * n_joints, 2))
    return np.abs(velocities if effort == "speed" else actions * velocities).sum(axis=3)
