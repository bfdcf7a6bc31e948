"""Rules that score segments for scripted teachers: return, windows of the reward, smoothness, limits, teamwork."""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Literal

import numpy as np

from mapt.errors import InvalidTeacher, MissingArray
from mapt.preferences.dataset import BoolArray
from mapt.preferences.teachers.view import Float64s, TeacherView


@dataclass(frozen=True, slots=True)
class Rule(ABC):
    """Scores segments; the higher score is preferred. The fields of a rule are its parameters."""

    @property
    @abstractmethod
    def reads(self) -> tuple[str, ...]:
        """The fields of `TeacherView` that the rule reads."""

    @property
    def is_return(self) -> bool:
        """Whether scores are true returns, so that B-Pref's thresholds apply."""
        return False

    @property
    def task_prefix(self) -> str | None:
        """What the names of the tasks begin with that the rule is about; None if it is not about some tasks alone."""
        return None

    @abstractmethod
    def scores(self, view: TeacherView) -> Float64s:
        """Score of each segment, float64 (B,). Independent of padding.

        Raises:
            MissingArray: if the view lacks an array that the rule reads.
        """

    def agent_scores(self, view: TeacherView) -> Float64s | None:
        """The part of each agent in the score, float64 (B, N), which sum to it; None if it is not a sum over agents.

        Raises:
            MissingArray: if the view lacks an array that the rule reads.
        """
        return None


class RewardRule(Rule):
    """A rule that reads only the true reward of each step, and so suits every task."""

    __slots__ = ()

    @property
    def reads(self) -> tuple[str, ...]:
        return ("rewards",)


def check_window(window_steps: int) -> None:
    """Raise InvalidTeacher if `window_steps` is below 1."""
    if window_steps < 1:
        raise InvalidTeacher(f"window_steps is {window_steps}; it must be 1 or more.")


def window_means(values: Float64s, mask: BoolArray, window_steps: int) -> tuple[Float64s, BoolArray]:
    """Moving averages over `window_steps` steps without padding; a shorter segment is one window.

    Args:
        values: (B, T) or (B, T, N).
        mask: bool (B, T).

    Returns:
        The mean of the window that starts at each step, in the shape of `values`; and bool (B, T), true where a whole
        window starts.
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
    """Mean of values (B, T) over the last `window_steps` steps before the padding, or over all if fewer: (B,)."""
    means, starts = window_means(values, mask, window_steps)
    return means[np.arange(len(means)), starts.sum(axis=1) - 1]


def masked_means(values: Float64s, mask: BoolArray) -> Float64s:
    """Mean of values (B, T, ...) over the steps without padding, (B, ...)."""
    extra = (1,) * (values.ndim - 2)
    sums = np.where(mask.reshape(*mask.shape, *extra), values, 0.0).sum(axis=1)
    return sums / mask.sum(axis=1).reshape(-1, *extra)


#: One second of MaMuJoCo's HalfCheetah, at 0.05 s per step.
SECOND_STEPS = 20


@dataclass(frozen=True, slots=True)
class Return(RewardRule):
    """Sum of true rewards: the score of B-Pref's oracle and of the paper's teacher.

    The paper defines the label as argmin_j sum_t r_t^j, the index of the worse segment: 1 means that segment 0 is
    preferred, as everywhere in this library.
    """

    @property
    def is_return(self) -> bool:
        return True

    def scores(self, view: TeacherView) -> Float64s:
        """See `Rule.scores`."""
        return np.where(view.mask, view.rewards, 0.0).sum(axis=1)


@dataclass(frozen=True, slots=True)
class WindowRule(RewardRule):
    """Mean reward of one window of the segment, relative to the mean of the whole segment."""

    window_steps: int = SECOND_STEPS
    #: fraction of the segment's mean reward that is subtracted, 0 or more
    above_mean: float = 1.0

    def __post_init__(self) -> None:
        check_window(self.window_steps)

    @abstractmethod
    def window(self, view: TeacherView) -> Float64s:
        """Mean reward of the window, float64 (B,)."""

    def scores(self, view: TeacherView) -> Float64s:
        """See `Rule.scores`."""
        return self.window(view) - self.above_mean * masked_means(view.rewards, view.mask)


class BestWindow(WindowRule):
    """The highest mean reward of any window."""

    __slots__ = ()

    def window(self, view: TeacherView) -> Float64s:
        """See `WindowRule.window`."""
        means, starts = window_means(view.rewards, view.mask, self.window_steps)
        return np.where(starts, means, -np.inf).max(axis=1)


class WorstWindow(WindowRule):
    """The lowest mean reward of any window. With `above_mean` 1, the most even segment is preferred."""

    __slots__ = ()

    def window(self, view: TeacherView) -> Float64s:
        """See `WindowRule.window`."""
        means, starts = window_means(view.rewards, view.mask, self.window_steps)
        return np.where(starts, means, np.inf).min(axis=1)


class FinalWindow(WindowRule):
    """The mean reward of the last window. With `above_mean` 1, the segment that improves most is preferred."""

    __slots__ = ()

    def window(self, view: TeacherView) -> Float64s:
        """See `WindowRule.window`."""
        return last_means(view.rewards, view.mask, self.window_steps)


@dataclass(frozen=True, slots=True)
class Smoothness(Rule):
    """Prefers smooth motion: the negative von Neumann ratio of actions or observations.

    The sum of squared changes from step to step, divided by the sum of squared deviations from the segment's mean, so
    that little motion is not rewarded. Torque acts on acceleration: the change of the actions measures jerk.
    """

    #: columns of the observations to measure; empty for the actions
    columns: tuple[int, ...] = ()

    @property
    def reads(self) -> tuple[str, ...]:
        return ("observations",) if self.columns else ("actions",)

    def scores(self, view: TeacherView) -> Float64s:
        """See `Rule.scores`."""
        mask = view.mask[:, :, None, None]
        signal = view.columns(self.columns) if self.columns else view.require("actions").astype(np.float64)
        signal = np.where(mask, signal, 0.0)
        changes = np.where(mask[:, 1:], np.diff(signal, axis=1), 0.0)
        deviations = np.where(mask, signal - masked_means(signal, view.mask)[:, None], 0.0)
        change, deviation = (np.square(x).sum(axis=(1, 2, 3)) for x in (changes, deviations))
        return -np.divide(change, deviation, out=np.zeros_like(change), where=deviation > 0)


@dataclass(frozen=True, slots=True)
class NeverExceeds(Rule):
    """Prefers the segment in which an observation stays within a limit for longer.

    Ties are broken by fewer steps beyond the limit, then by the smaller excess; between two segments that stay within
    it, by the larger distance from it.
    """

    @property
    def reads(self) -> tuple[str, ...]:
        return ("observations",)

    #: column of the observations; the agent closest to the limit counts
    column: int
    limit: float
    #: the forbidden side: values above the limit, below it, or with a magnitude beyond it
    side: Literal["above", "below", "beyond"]

    def scores(self, view: TeacherView) -> Float64s:
        """See `Rule.scores`."""
        values = view.columns((self.column,))[..., 0]
        excess = {"above": values, "below": -values, "beyond": np.abs(values)}[self.side]
        excess = (excess - (-self.limit if self.side == "below" else self.limit)).max(axis=2)
        excess = np.where(view.mask, excess, -np.inf)
        violated, lengths, worst = excess > 0, view.lengths, excess.max(axis=1)
        steps_before = np.where(violated.any(axis=1), violated.argmax(axis=1), lengths)
        # In (0, 1): distance of the worst step from the limit, on either side.
        distance = np.abs(worst) / (1 + np.abs(worst))
        # In (-1, 1): half of it is less than one step, and so only breaks ties.
        tie_break = np.where(worst > 0, (1 - violated.sum(axis=1) - distance) / (lengths + 1), distance)
        return (steps_before + tie_break / 2) / lengths


#: Measure of an agent's effort in a step, summed over its joints: |torque x velocity|, |torque| or |velocity|.
Effort = Literal["power", "action", "speed"]


@dataclass(frozen=True, slots=True)
class Phase(Rule):
    """The correlation over the segment of one observation of two agents: whether they move in phase or in antiphase."""

    @property
    def reads(self) -> tuple[str, ...]:
        return ("observations",)

    #: column of the observations; 1 is the velocity of an agent's first joint in MaMuJoCo
    column: int = 1
    #: the two agents; -1 for the second means half a team after the first (HalfCheetah's two thighs)
    first_agent: int = 0
    second_agent: int = -1
    #: the preferred sign: negative (opposite) or positive (equal) correlation
    want: Literal["opposite", "equal"] = "opposite"

    def scores(self, view: TeacherView) -> Float64s:
        """See `Rule.scores`; in [-1, 1], 0 if one of the agents does not move."""
        return masked_means(self.correlation_terms(view), view.mask)

    def correlation_terms(self, view: TeacherView) -> Float64s:
        """The contribution of each step to the correlation, signed by `want`: float64 (B, T), 0 in the padding."""
        opposite_agent = self.first_agent + view.require("observations").shape[2] // 2
        second = opposite_agent if self.second_agent < 0 else self.second_agent
        signals = view.columns((self.column,), (self.first_agent, second))[..., 0]
        signals = np.where(view.mask[:, :, None], signals - masked_means(signals, view.mask)[:, None], 0.0)
        products = signals.prod(axis=2)
        scale = np.sqrt(masked_means(np.square(signals), view.mask).prod(axis=1))[:, None]
        terms = np.divide(products, scale, out=np.zeros_like(products), where=scale > 0)
        return -terms if self.want == "opposite" else terms


@dataclass(frozen=True, slots=True)
class PhaseImprovement(Phase):
    """How much the correlation of `Phase` in the last window exceeds that of the whole segment.

    Depends on several agents and on time: no sum of rewards per step or per agent expresses it.
    """

    window_steps: int = SECOND_STEPS

    def __post_init__(self) -> None:
        check_window(self.window_steps)

    def scores(self, view: TeacherView) -> Float64s:
        """See `Rule.scores`; 0 if one of the agents does not move."""
        terms = self.correlation_terms(view)
        return last_means(terms, view.mask, self.window_steps) - masked_means(terms, view.mask)


@dataclass(frozen=True, slots=True)
class LowEffort(Rule):
    """Prefers little effort: the negative sum over agents of their mean efforts, as of a control cost.

    Each agent's part depends on its own joints alone, so that the rule knows which agent decided a preference.
    """

    effort: Effort = "power"

    @property
    def reads(self) -> tuple[str, ...]:
        return _reads(self.effort)

    def scores(self, view: TeacherView) -> Float64s:
        """See `Rule.scores`."""
        return self.agent_scores(view).sum(axis=1)

    def agent_scores(self, view: TeacherView) -> Float64s:
        """See `Rule.agent_scores`."""
        return masked_means(self.step_scores(view), view.mask)

    def step_scores(self, view: TeacherView) -> Float64s:
        """The part of each step and agent, float64 (B, T, N): `agent_scores` is its mean over real steps."""
        return -_efforts(view, self.effort)


@dataclass(frozen=True, slots=True)
class EffortBalance(Rule):
    """Prefers equal effort of the agents: the negative coefficient of variation of their mean efforts."""

    effort: Effort = "power"

    @property
    def reads(self) -> tuple[str, ...]:
        return _reads(self.effort)

    def scores(self, view: TeacherView) -> Float64s:
        """See `Rule.scores`; 0 if all efforts are equal."""
        totals = masked_means(_efforts(view, self.effort), view.mask)
        mean = totals.mean(axis=1)
        return -np.divide(totals.std(axis=1), mean, out=np.zeros_like(mean), where=mean > 0)


@dataclass(frozen=True, slots=True)
class MinimumEffort(Rule):
    """Prefers that no agent rests while others work.

    The lowest effort of any agent in any window, relative to the mean of all agents in that window.
    """

    effort: Effort = "power"
    window_steps: int = SECOND_STEPS // 2

    def __post_init__(self) -> None:
        check_window(self.window_steps)

    @property
    def reads(self) -> tuple[str, ...]:
        return _reads(self.effort)

    def scores(self, view: TeacherView) -> Float64s:
        """See `Rule.scores`; in [0, 1], 1 if all efforts are equal."""
        means, starts = window_means(_efforts(view, self.effort), view.mask, self.window_steps)
        lowest, mean = means.min(axis=2), means.mean(axis=2)
        ratio = np.divide(lowest, mean, out=np.ones_like(lowest), where=mean > 0)
        return np.where(starts, ratio, 1.0).min(axis=1)


def _reads(effort: Effort) -> tuple[str, ...]:
    return {"power": ("observations", "actions"), "action": ("actions",), "speed": ("observations",)}[effort]


def _efforts(view: TeacherView, effort: Effort) -> Float64s:
    """Effort of each agent in each step, (B, T, N), 0 in the padding.

    In MaMuJoCo, an agent with A joints observes the position and velocity of each in turn: the velocities are columns
    1, 3, ..., 2A - 1.
    """
    actions = view.require("actions").astype(np.float64)
    actions = np.where(view.mask[:, :, None, None], actions, 0.0)
    if effort == "action":
        return np.abs(actions).sum(axis=3)
    n_joints = actions.shape[3]
    if view.require("observations").shape[3] < 2 * n_joints:
        raise MissingArray(f"the velocities of {n_joints} joints")
    velocities = view.columns(range(1, 2 * n_joints, 2))
    return np.abs(velocities if effort == "speed" else actions * velocities).sum(axis=3)
