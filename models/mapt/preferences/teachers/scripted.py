"""The seam between teachers and everyone who asks them."""

import math
from dataclasses import asdict, dataclass, fields, replace
from typing import Any, Literal, Protocol, TypeVar, get_args, get_origin, get_type_hints

import numpy as np
from numpy.typing import NDArray

from mapt.errors import InvalidTeacher, ShapeError, UnknownTeacher
from mapt.preferences.teachers.rules import (
    BestWindow,
    EffortBalance,
    FinalWindow,
    MinimumEffort,
    NeverExceeds,
    Phase,
    PhaseImprovement,
    Return,
    Rule,
    Smoothness,
    WorstWindow,
)
from mapt.preferences.teachers.view import Float64s, TeacherView


class Teacher(Protocol):
    """Judges pairs of segments."""

    def judge(self, first: TeacherView, second: TeacherView) -> NDArray[np.float32]:
        """Label B pairs.

        Args:
            first, second: segments 0 and segments 1, B each; the two sides may differ in T.

        Returns:
            float32 (B,): P(segment 0 preferred); NaN where the teacher skips the pair.

        Raises:
            ShapeError: if the sides hold different numbers of segments.
            MissingView: if they lack what this teacher judges by.
        """
        ...

    def parameters(self) -> dict[str, Any]:
        """Its name and every parameter, fit for JSON: what a label's record says of its teacher."""
        ...


#: Pairs that a running mean reaches back over.
WINDOW_PAIRS = 500


class RunningStatistics:
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


@dataclass(frozen=True, slots=True)
class BPrefParameters:
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

    The thresholds are eps x running mean episode return x T / episode length, T the longer segment's. Without
    `set_episode_return`, the mean reward of the segments seen so far stands for that of whole episodes.
    eps enters once, unlike in B-Pref's code, which multiplies by it again after its first session.

    Where the mean is not positive, or scores are no returns, eps x mean says nothing: a threshold below 0 would switch
    `equal` off and, with negative returns, skip everything. There the running spread (standard deviation) of segment
    scores takes the mean's place, and one spread below their mean the place of 0: equal if they differ by less than
    eps x spread; skip if neither is above mean - (1 - eps) x spread.
    """

    def __init__(
        self, rule: Rule, habits: BPrefParameters, rng: np.random.Generator, record: dict[str, Any] | None = None
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
        self._scale = RunningStatistics()
        self._episode_reward: float | None = None

    def judge(self, first: TeacherView, second: TeacherView) -> NDArray[np.float32]:
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

    def scores(self, evidence: TeacherView) -> Float64s:
        """What it judges segments by, faded, without doubt or mistakes: float64 (B,).

        Raises:
            MissingView: if the evidence lacks what the rule reads.
        """
        if self.habits.gamma == 1:
            return self.rule.scores(evidence)
        age = evidence.lengths[:, None] - 1 - np.arange(evidence.mask.shape[1])
        return self.rule.scores(evidence.with_rewards(evidence.rewards * self.habits.gamma ** np.maximum(age, 0)))

    @property
    def needs_episodes(self) -> bool:
        """Whether its thresholds follow the returns of episodes, if told of them."""
        return self.rule.is_return and (self.habits.skip > 0 or self.habits.equal > 0)

    def set_episode_return(self, mean_return: float, length_steps: float) -> None:
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
        super().__init__(Return(), BPrefParameters(), np.random.default_rng(0), {"name": "oracle", "rule": "return"})


def _fields(of: Any) -> dict[str, Any]:
    return {name: list(value) if isinstance(value, tuple) else value for name, value in asdict(of).items()}


Settings = TypeVar("Settings", BPrefParameters, Rule)

#: B-Pref's teachers (Lee et al. 2021, table 1).
PRESETS = {
    "oracle": BPrefParameters(),
    "stochastic": BPrefParameters(beta=1.0),
    "mistake": BPrefParameters(mistake=0.1),
    "skip": BPrefParameters(skip=0.1),
    "myopic": BPrefParameters(gamma=0.9),
    "equal": BPrefParameters(equal=0.1),
}

#: Rules with the parameters they have when nobody says. Columns are those of HalfCheetah-6x1 with its neighbours in
#: sight: 4 is the height of the torso over its rest, in metres, 5 its pitch, in radians.
RULES: dict[str, Rule] = {
    "return": Return(),
    "best-second": BestWindow(),
    "worst-second": WorstWindow(),
    "recency": FinalWindow(),
    "smoothness": Smoothness(),
    "never-falls": NeverExceeds(column=4, limit=-0.18, side="below"),
    "never-tips": NeverExceeds(column=5, limit=0.3, side="beyond"),
    "phase": Phase(),
    "finds-phase": PhaseImprovement(),
    "shared-load": EffortBalance(),
    "nobody-idle": MinimumEffort(),
}


def teacher_names() -> tuple[str, ...]:
    """Names of the presets, then of the rules. One of each may be joined by a plus: `phase+mistake`."""
    return (*PRESETS, *(name for name in RULES if name != "return"))


def make_teacher(name: str, /, *, seed: int = 0, **parameters: Any) -> ScriptedTeacher:
    """The teacher with this name.

    Args:
        name: a preset, which judges by true return; a rule, which it follows without fail; or `rule+preset`.
        seed: of its chance, also for teachers that leave nothing to chance.
        parameters: fields of `BPrefParameters` and of the rule, in place of the name's own.

    Raises:
        UnknownTeacher: if no teacher has this name.
        InvalidTeacher: if it has no such parameter, or not with this value.
    """
    rule_name, preset_name = _parts(name)
    seed = _typed(name, "seed", int, seed)
    if seed < 0:
        raise InvalidTeacher(f"seed must be 0 or more, got {seed}")
    habits, rule = PRESETS[preset_name], RULES[rule_name]
    of_habits = {field.name for field in fields(BPrefParameters)}
    habits = _changed(habits, {key: value for key, value in parameters.items() if key in of_habits}, name)
    rule = _changed(rule, {key: value for key, value in parameters.items() if key not in of_habits}, name)
    record = {"name": name, "rule": rule_name, "seed": seed}
    return ScriptedTeacher(rule, habits, np.random.default_rng(seed), record)


def _parts(name: str) -> tuple[str, str]:
    """Rule and preset of a teacher's name."""
    first, plus, second = name.partition("+")
    if plus:
        if first in RULES and second in PRESETS:
            return first, second
    elif first in PRESETS:
        return "return", first
    elif first in RULES:
        return first, "oracle"
    raise UnknownTeacher(name, teacher_names())


def _changed(settings: Settings, changes: dict[str, Any], name: str) -> Settings:
    """These settings with some fields changed, each to a value of its type."""
    hints = get_type_hints(type(settings))
    known = [field.name for field in fields(settings)]
    if unknown := changes.keys() - set(known):
        there = (
            f"beside {', '.join(field.name for field in fields(BPrefParameters))} it has {', '.join(known) or 'none'}"
        )
        raise InvalidTeacher(f"{name} has no parameter {', '.join(sorted(unknown))}; {there}")
    return replace(settings, **{key: _typed(name, key, hints[key], value) for key, value in changes.items()})


def _typed(name: str, key: str, hint: Any, value: Any) -> Any:
    """This value as the type that the field asks for."""
    choices = get_args(hint) if get_origin(hint) is Literal else ()
    number = isinstance(value, int | float | np.integer) and not isinstance(value, bool) and math.isfinite(value)
    if hint == (float | None) and value is None:
        return None
    if hint in (float, float | None) and number:
        return float(value)
    if (hint is int and number and value == int(value)) or value in choices:
        return int(value) if hint is int else value
    if hint == tuple[int, ...] and isinstance(value, list | tuple) and all(isinstance(item, int) for item in value):
        return tuple(value)
    wanted = " or ".join(map(repr, choices)) or {int: "a whole number", tuple[int, ...]: "a list of whole numbers"}.get(
        hint, "a number"
    )
    raise InvalidTeacher(f"{key} of {name} must be {wanted}, got {value!r}")
