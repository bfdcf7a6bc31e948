"""A scripted teacher: a rule, and the habits with which people depart from their rules (B-Pref, Lee et al. 2021)."""

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapt.errors import InvalidTeacher, ShapeError
from mapt.preferences.teachers.evidence import Evidence, Float64s
from mapt.preferences.teachers.history import Return
from mapt.preferences.teachers.rule import Rule
from mapt.preferences.teachers.scale import RunningScale


@dataclass(frozen=True, slots=True)
class Habits:
    """How a teacher departs from its rule. The default does not.

    Raises:
        InvalidTeacher: if a number is out of its range.
    """

    #: P(segment 0 preferred) = sigmoid(beta x difference of scores); None prefers the larger score without fail.
    #: Scores are true returns as they are, or those of another rule in units of their running spread.
    beta: float | None = None
    #: what a reward one step older weighs, relative to the next; below 1 for rules that read rewards alone
    gamma: float = 1.0
    #: share of labels turned round
    mistake: float = 0.0
    #: eps of the threshold below which neither segment shows anything; 0 never skips
    skip: float = 0.0
    #: eps of the threshold below which a difference is none; 0 calls equal scores alone equal
    equal: float = 0.0

    def __post_init__(self) -> None:
        if self.beta is not None and not 0 < self.beta < np.inf:
            raise InvalidTeacher(f"beta must be above 0 and finite, or none for no noise; got {self.beta}")
        for name, value, highest in (("gamma", self.gamma, 1.0), ("mistake", self.mistake, 1.0)):
            if not 0 <= value <= highest:
                raise InvalidTeacher(f"{name} must lie in [0, 1], got {value}")
        for name, value in (("skip", self.skip), ("equal", self.equal)):
            if not 0 <= value < np.inf:
                raise InvalidTeacher(f"{name} must be 0 or more and finite, got {value}")


class ScriptedTeacher:
    """Judges by a rule, with habits, in B-Pref's order: skip, fade, choose, mistake, equal.

    1. Skip the pair if neither score is above a threshold. Nothing is faded yet.
    2. Myopic: older rewards fade by gamma per step before the rule sees them; the newest weighs 1.
    3. Choose the larger score, or by chance with the Boltzmann probability of beta. Equal scores give 0.5.
    4. Turn the choice round with probability `mistake`.
    5. Say 0.5 whatever was chosen if the scores of step 2 differ by less than a threshold.

    The thresholds are eps x running mean episode return x T / episode length, T the longer segment's. Unless told of
    episodes (`see_episodes`), the teacher takes the mean reward of the segments it has seen for that of whole episodes.
    eps enters once, unlike in B-Pref's code, which multiplies by it again after its first session.

    Where the mean is not positive, or scores are no returns, eps x mean says nothing: a threshold below 0 would switch
    `equal` off and, with negative returns, skip everything. There the running spread (standard deviation) of segment
    scores takes the mean's place, and one spread below their mean the place of 0: equal if they differ by less than
    eps x spread; skip if neither is above mean - (1 - eps) x spread.
    """

    def __init__(
        self, rule: Rule, habits: Habits, rng: np.random.Generator, record: dict[str, Any] | None = None
    ) -> None:
        """
        Args:
            record: what `parameters` says beside rule and habits, such as a name and a seed.

        Raises:
            InvalidTeacher: if rewards should fade for a rule that reads none.
        """
        if habits.gamma < 1 and "rewards" not in rule.reads:
            raise InvalidTeacher(f"gamma fades rewards, and {type(rule).__name__} reads {', '.join(rule.reads)}")
        self.rule = rule
        self.habits = habits
        self._rng = rng
        self._record = record or {}
        self._scale = RunningScale()
        self._episode_reward: float | None = None

    def judge(self, first: Evidence, second: Evidence) -> NDArray[np.float32]:
        """See `Teacher.judge`."""
        if len(first) != len(second):
            raise ShapeError("second", (len(second),), f"as many segments as the first side, {len(first)}")
        whole = np.stack((self.rule.scores(first), self.rule.scores(second)), axis=1)
        faded = whole if self.habits.gamma == 1 else np.stack((self.scores(first), self.scores(second)), axis=1)
        bounds = self._bounds(whole, np.stack((first.lengths, second.lengths), axis=1))
        difference = faded[:, 0] - faded[:, 1]
        # Two draws a pair whatever the habits: the same chance decides in batches of any size.
        choosing, erring = self._rng.random((len(whole), 2)).T
        label = self._choose(difference, bounds.unit, choosing)
        label = np.where(erring < self.habits.mistake, 1.0 - label, label)
        if self.habits.equal:
            label[np.abs(difference) < bounds.equal] = 0.5
        if self.habits.skip:
            label[whole.max(axis=1) <= bounds.skip] = np.nan
        return label.astype(np.float32)

    def scores(self, evidence: Evidence) -> Float64s:
        """What it judges segments by, faded, without doubt or mistakes: float64 (B,).

        Raises:
            MissingEvidence: if the evidence lacks what the rule reads.
        """
        if self.habits.gamma == 1:
            return self.rule.scores(evidence)
        age = evidence.lengths[:, None] - 1 - np.arange(evidence.mask.shape[1])
        return self.rule.scores(evidence.with_rewards(evidence.rewards * self.habits.gamma ** np.maximum(age, 0)))

    @property
    def needs_episodes(self) -> bool:
        """Whether its thresholds follow the returns of episodes, if told of them."""
        return self.rule.is_return and (self.habits.skip > 0 or self.habits.equal > 0)

    def see_episodes(self, mean_return: float, length_steps: float) -> None:
        """From now on, thresholds follow this running mean return of episodes that long.

        Raises:
            InvalidTeacher: if the return is not finite or the length not positive.
        """
        if not np.isfinite(mean_return) or not 0 < length_steps < np.inf:
            raise InvalidTeacher(f"no episode has return {mean_return} and {length_steps} steps")
        self._episode_reward = mean_return / length_steps

    def parameters(self) -> dict[str, Any]:
        """See `Teacher.parameters`."""
        return {**self._record, **_fields(self.habits), **_fields(self.rule)}

    def _choose(self, difference: Float64s, unit: Float64s, choosing: Float64s) -> Float64s:
        if self.habits.beta is None:
            return 0.5 + 0.5 * np.sign(difference)
        logit = self.habits.beta * np.divide(difference, unit, out=np.zeros_like(difference), where=unit > 0)
        # the sigmoid of any logit without overflow
        return (choosing < 0.5 + 0.5 * np.tanh(logit / 2)).astype(np.float64)

    def _bounds(self, scores: Float64s, lengths: NDArray[np.int64]) -> "_Bounds":
        mean, spread, length = self._scale.see(scores, lengths)
        skip, equal = mean - (1 - self.habits.skip) * spread, self.habits.equal * spread
        if not self.rule.is_return:
            return _Bounds(skip, equal, spread)
        expected = mean / length if self._episode_reward is None else np.full_like(mean, self._episode_reward)
        expected = expected * lengths.max(axis=1)
        return _Bounds(
            np.where(expected > 0, self.habits.skip * expected, skip),
            np.where(expected > 0, self.habits.equal * expected, equal),
            np.ones_like(mean),
        )


@dataclass(frozen=True, slots=True)
class _Bounds:
    """Of B pairs, (B,) each."""

    skip: Float64s
    equal: Float64s
    #: what a difference of scores is divided by before beta
    unit: Float64s


class OracleTeacher(ScriptedTeacher):
    """Prefers the segment with the larger true return, without error; equal returns give 0.5."""

    def __init__(self) -> None:
        super().__init__(Return(), Habits(), np.random.default_rng(0), {"name": "oracle", "rule": "return"})


def _fields(of: Any) -> dict[str, Any]:
    return {name: list(value) if isinstance(value, tuple) else value for name, value in asdict(of).items()}
