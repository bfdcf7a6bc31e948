"""Scripted teachers by name: a rule plus B-Pref's models of human error (Lee et al. 2021)."""

import math
from dataclasses import asdict, dataclass, fields, replace
from typing import TYPE_CHECKING, Any, Literal, Protocol, TypeVar, get_args, get_origin, get_type_hints

import numpy as np
from numpy.typing import NDArray

from mapt.errors import InvalidTeacher, ShapeError, UnknownTeacher
from mapt.preferences.dataset import NO_AGENT
from mapt.preferences.teachers.attacking import Attacking
from mapt.preferences.teachers.carrying import Carrying
from mapt.preferences.teachers.rules import (
    BestWindow,
    EffortBalance,
    FinalWindow,
    LowEffort,
    MinimumEffort,
    NeverExceeds,
    Phase,
    PhaseImprovement,
    Return,
    RewardRule,
    Rule,
    Smoothness,
    WorstWindow,
)
from mapt.preferences.teachers.view import Float64s, TeacherView

if TYPE_CHECKING:  # mujoco takes longer to import than `accord teach` to start
    from mapt.tasks import TaskSpec


class Teacher(Protocol):
    """Labels pairs of segments."""

    def judge(self, first: TeacherView, second: TeacherView) -> NDArray[np.float32]:
        """Label B pairs.

        Args:
            first, second: segment 0 and segment 1 of each pair; T may differ between the two.

        Returns:
            P(segment 0 preferred), float32 (B,): 1, 0 or 0.5, and 0.75 or 0.25 for slight preferences; NaN for pairs
            that the teacher skips.

        Raises:
            ShapeError: if the two views hold different numbers of segments.
            MissingArray: if they lack an array that the teacher needs.
        """
        ...

    def parameters(self) -> dict[str, Any]:
        """Name and parameters as JSON, stored with each label."""
        ...


#: Number of pairs in the running statistics.
WINDOW_PAIRS = 500


class RunningStatistics:
    """Running mean and standard deviation of scores, and mean length, over the last `WINDOW_PAIRS` pairs.

    The statistics of pair i include the pairs up to i, so that labels do not depend on the batch size.
    """

    def __init__(self) -> None:
        #: per pair in the window: sum of the two scores, of their squares, and of the two lengths; (pairs, 3)
        self._recent: Float64s = np.zeros((0, 3))

    def update(self, scores: Float64s, lengths: NDArray[np.int64]) -> tuple[Float64s, Float64s, Float64s]:
        """Add B pairs.

        Args:
            scores, lengths: of the two segments of each pair, (B, 2).

        Returns:
            Mean score, standard deviation of scores, and mean length in steps at each pair, (B,) each.
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
    """Parameters of B-Pref's simulated human teachers. The default is an oracle.

    Raises:
        InvalidTeacher: if a value is out of its range.
    """

    #: rationality: P(segment 0 preferred) = sigmoid(beta x score difference); None always prefers the higher score.
    #: Returns are used as they are, scores of other rules in units of their running standard deviation.
    beta: float | None = None
    #: myopia: discount per step of older rewards; below 1 only for rules that read rewards
    gamma: float = 1.0
    #: fraction of labels that are flipped
    mistake: float = 0.0
    #: eps of the skip threshold: a pair is skipped if both scores are below it; 0 never skips
    skip: float = 0.0
    #: eps of the equality threshold: a pair is labelled 0.5 if its scores differ by less
    equal: float = 0.0
    #: eps of the threshold of slight preferences: a preference is labelled 0.75 or 0.25 if the scores differ by less
    slight: float = 0.0
    #: fraction of pairs that are labelled without looking: 1 or 0 with equal probability
    guess: float = 0.0
    #: fraction of pairs for which the segment on the left is preferred without looking
    left: float = 0.0

    def __post_init__(self) -> None:
        if self.beta is not None and not 0 < self.beta < np.inf:
            raise InvalidTeacher(f"beta is {self.beta}; it must be above 0 and finite, or None for no noise.")
        for name in ("gamma", "mistake", "guess", "left"):
            if not 0 <= getattr(self, name) <= 1:
                raise InvalidTeacher(f"{name} is {getattr(self, name)}; it must lie in [0, 1].")
        for name, value in (("skip", self.skip), ("equal", self.equal), ("slight", self.slight)):
            if not 0 <= value < np.inf:
                raise InvalidTeacher(f"{name} is {value}; it must be 0 or more and finite.")


class ScriptedTeacher:
    """Labels pairs by a rule and `BPrefParameters`, in B-Pref's order, but for steps 5 and 7, which B-Pref lacks.

    1. Skip the pair if both scores are below the skip threshold.
    2. Myopia: discount rewards by gamma per step of age, and score the segments again.
    3. Prefer the higher score, or sample from the Boltzmann model with beta. Equal scores give 0.5.
    4. Flip the label with probability `mistake`.
    5. Make the preference slight, 0.75 or 0.25, if the scores differ by less than the threshold of slight preferences.
    6. Replace the label by 0.5 if the scores differ by less than the equality threshold.
    7. Replace the label by a guess, or by the left segment, for the fractions `guess` and `left` of the pairs, as
       inattentive people do.

    Steps 1, 5 and 6 compare scores of undiscounted rewards, as B-Pref's code does.

    A threshold is eps x mean episode return x T / episode length, where T is the length of the longer segment. Without
    `set_episode_return`, the mean reward of the segments so far stands in for that of episodes. B-Pref's code
    multiplies by eps again after the first session; this does not.

    If the mean return is not positive, or scores are not returns, such a threshold is meaningless: with negative
    returns, every pair would be skipped. The thresholds are then relative to the running mean m and standard deviation
    s of the scores: equal or slight if the scores differ by less than eps x s; skip if both are below
    m - (1 - eps) x s.
    """

    def __init__(
        self, rule: Rule, bpref: BPrefParameters, rng: np.random.Generator, record: dict[str, Any] | None = None
    ) -> None:
        """Make a teacher from a rule; `make_teacher` makes one by name.

        Args:
            record: further entries of `parameters`, such as name and seed.

        Raises:
            InvalidTeacher: if gamma is below 1 and the rule does not read rewards.
        """
        if bpref.gamma < 1 and "rewards" not in rule.reads:
            raise InvalidTeacher(f"gamma discounts rewards, but {type(rule).__name__} reads {', '.join(rule.reads)}.")
        self.rule = rule
        self.bpref = bpref
        self._rng = rng
        # A generator of its own, so that the draws of the other errors stay what they were.
        self._inattention = rng.spawn(1)[0]
        self._record = record or {}
        self._statistics = RunningStatistics()
        self._episode_reward: float | None = None

    @property
    def name(self) -> str:
        """Its name, or that of the rule's class if it was not made by name."""
        return self._record.get("name", type(self.rule).__name__)

    def check_task(self, task_name: str, *, discrete_actions: bool) -> None:
        """Check that the rule can judge a task.

        Raises:
            InvalidTeacher: if the rule is about other tasks, or about the joints of robots, but agents choose among
                actions.
        """
        if _judges(self.rule, task_name, discrete_actions):
            return
        suited = [*PRESETS, *(name for name, rule in RULES.items() if _judges(rule, task_name, discrete_actions))]
        suited.remove("return")
        prefix = self.rule.task_prefix
        reason = (
            f"judges how the joints of a robot move, but the agents of {task_name} have none"
            if prefix is None
            else f"judges tasks whose names begin with {prefix}, not {task_name}"
        )
        raise InvalidTeacher(f"{self.name} {reason}. Teachers for it: {', '.join(suited)}.")

    def check_spec(self, spec: "TaskSpec") -> None:
        """Check that the rule can judge a task and finds what it reads, by scoring segments of zeros.

        Raises:
            InvalidTeacher: as `check_task`.
            MissingArray: if the task lacks an array, an agent or a column that the rule reads.
        """
        self.check_task(spec.name, discrete_actions=spec.discrete_actions)

        def zeros(*size: int) -> NDArray[np.float64]:
            return np.zeros((1, 2, *size))

        view = TeacherView(
            zeros(),
            observations=zeros(spec.n_agents, spec.observation_dim),
            actions=zeros(spec.n_agents, spec.action_dim),
            qpos=zeros(spec.nq),
            qvel=zeros(spec.nv),
        )
        self.rule.scores(view)

    def judge(
        self, first: TeacherView, second: TeacherView, left_segments: NDArray[np.integer] | None = None
    ) -> NDArray[np.float32]:
        """See `Teacher.judge`.

        Args:
            left_segments: the segment of each pair, 0 or 1, that is shown on the left, (B,); segment 0 by default.
        """
        if len(first) != len(second):
            raise ShapeError("second", (len(second),), f"as many segments as in first, {len(first)}")
        scores = np.stack((self.rule.scores(first), self.rule.scores(second)), axis=1)
        discounted = scores if self.bpref.gamma == 1 else np.stack((self.scores(first), self.scores(second)), axis=1)
        thresholds = self._thresholds(scores, np.stack((first.lengths, second.lengths), axis=1))
        difference = discounted[:, 0] - discounted[:, 1]
        # Always two draws per pair, so that labels depend neither on the parameters nor on the batch size.
        preference_draw, mistake_draw = self._rng.random((len(scores), 2)).T
        label = self._prefer(difference, thresholds.unit, preference_draw)
        label = np.where(mistake_draw < self.bpref.mistake, 1.0 - label, label)
        distance = np.abs(scores[:, 0] - scores[:, 1])
        if self.bpref.slight:
            label = np.where(distance < thresholds.slight, 0.25 + label / 2, label)
        if self.bpref.equal:
            label[distance < thresholds.equal] = 0.5
        if self.bpref.skip:
            label[scores.max(axis=1) <= thresholds.skip] = np.nan
        guess_draw, side_draw, left_draw = self._inattention.random((len(scores), 3)).T
        label = np.where(guess_draw < self.bpref.guess, side_draw < 0.5, label)
        label = np.where(left_draw < self.bpref.left, left_segments != 1 if left_segments is not None else 1.0, label)
        return label.astype(np.float32)

    def decisive_agents(
        self, first: TeacherView, second: TeacherView, labels: NDArray[np.floating]
    ) -> NDArray[np.int64]:
        """The agent that decided each of these labels (B,): that with the largest part in the score difference.

        Parts count in the direction of the label, also of a mistaken one. Makes no random draws.

        Returns:
            int64 (B,); `NO_AGENT` where neither segment is preferred, or if the rule is not a sum over agents.

        Raises:
            MissingArray: if they lack an array that the rule reads.
        """
        parts = self.rule.agent_scores(first), self.rule.agent_scores(second)
        sides = np.sign(np.nan_to_num(labels, nan=0.5) - 0.5)
        if parts[0] is None or parts[1] is None:
            return np.full(len(labels), NO_AGENT)
        decisive = (sides[:, None] * (parts[0] - parts[1])).argmax(axis=1)
        return np.where(sides != 0, decisive, NO_AGENT)

    def scores(self, view: TeacherView) -> Float64s:
        """Score of each segment with discounted rewards, float64 (B,).

        Raises:
            MissingArray: if the view lacks an array that the rule reads.
        """
        if self.bpref.gamma == 1:
            return self.rule.scores(view)
        age = view.lengths[:, None] - 1 - np.arange(view.mask.shape[1])
        return self.rule.scores(view.with_rewards(view.rewards * self.bpref.gamma ** np.maximum(age, 0)))

    @property
    def uses_episode_return(self) -> bool:
        """Whether `set_episode_return` affects the labels."""
        return self.rule.is_return and (self.bpref.skip > 0 or self.bpref.equal > 0 or self.bpref.slight > 0)

    def set_episode_return(self, mean_return: float, length_steps: float) -> None:
        """Set the mean return and length of episodes, from which the thresholds are computed.

        Raises:
            InvalidTeacher: if the return is not finite, or the length is not positive and finite.
        """
        if not np.isfinite(mean_return) or not 0 < length_steps < np.inf:
            raise InvalidTeacher(f"An episode cannot have return {mean_return} and {length_steps} steps.")
        self._episode_reward = mean_return / length_steps

    def parameters(self) -> dict[str, Any]:
        """See `Teacher.parameters`."""
        errors = _fields(self.bpref)
        # Fields that were added later are left out at 0, so that stored results of earlier teachers keep their keys.
        errors = {name: value for name, value in errors.items() if value or name not in ("slight", "guess", "left")}
        return {**self._record, **errors, **_fields(self.rule)}

    def _prefer(self, difference: Float64s, unit: Float64s, draw: Float64s) -> Float64s:
        if self.bpref.beta is None:
            return 0.5 + 0.5 * np.sign(difference)
        logit = self.bpref.beta * np.divide(difference, unit, out=np.zeros_like(difference), where=unit > 0)
        # sigmoid(logit) without overflow
        return (draw < 0.5 + 0.5 * np.tanh(logit / 2)).astype(np.float64)

    def _thresholds(self, scores: Float64s, lengths: NDArray[np.int64]) -> "_Thresholds":
        mean, deviation, length = self._statistics.update(scores, lengths)
        skip = mean - (1 - self.bpref.skip) * deviation
        equal, slight = self.bpref.equal * deviation, self.bpref.slight * deviation
        if not self.rule.is_return:
            return _Thresholds(skip, equal, slight, deviation)
        expected = mean / length if self._episode_reward is None else np.full_like(mean, self._episode_reward)
        expected = expected * lengths.max(axis=1)
        return _Thresholds(
            np.where(expected > 0, self.bpref.skip * expected, skip),
            np.where(expected > 0, self.bpref.equal * expected, equal),
            np.where(expected > 0, self.bpref.slight * expected, slight),
            np.ones_like(mean),
        )


def _judges(rule: Rule, task_name: str, discrete_actions: bool) -> bool:
    """Whether a rule can judge a task; one about joints cannot where agents choose among actions."""
    if rule.task_prefix is not None:
        return task_name.startswith(rule.task_prefix)
    return not discrete_actions or isinstance(rule, RewardRule)


@dataclass(frozen=True, slots=True)
class _Thresholds:
    """Thresholds of B pairs, (B,) each."""

    skip: Float64s
    equal: Float64s
    slight: Float64s
    #: score differences are divided by this before beta is applied
    unit: Float64s


class OracleTeacher(ScriptedTeacher):
    """Prefers the segment with the higher true return; equal returns give 0.5."""

    def __init__(self) -> None:
        super().__init__(Return(), BPrefParameters(), np.random.default_rng(0), {"name": "oracle", "rule": "return"})


def _fields(settings: Any) -> dict[str, Any]:
    """The fields of a dataclass, ready for JSON."""
    return {name: list(value) if isinstance(value, tuple) else value for name, value in asdict(settings).items()}


Settings = TypeVar("Settings", BPrefParameters, Rule)

#: B-Pref's teachers (Lee et al. 2021, table 1), one that also prefers slightly, and three people whose labels a quality
#: check should find.
PRESETS = {
    "oracle": BPrefParameters(),
    "stochastic": BPrefParameters(beta=1.0),
    "mistake": BPrefParameters(mistake=0.1),
    "skip": BPrefParameters(skip=0.1),
    "myopic": BPrefParameters(gamma=0.9),
    "equal": BPrefParameters(equal=0.1),
    "slight": BPrefParameters(slight=0.3),
    "careless": BPrefParameters(guess=0.8),
    "left": BPrefParameters(left=0.5),
    "opposite": BPrefParameters(mistake=1.0),
}

#: The rules with their default parameters. Observation columns are those of HalfCheetah-6x1 with agent_obsk 1: column 4
#: is the height of the torso relative to its initial height, in metres, column 5 its pitch, in radians.
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
    "low-effort": LowEffort(),
    "shared-load": EffortBalance(),
    "nobody-idle": MinimumEffort(),
    "carry": Carrying(),
    "attack": Attacking(),
}


def teacher_names() -> tuple[str, ...]:
    """Names of the presets, then of the rules. A rule and a preset combine with a plus: `phase+mistake`."""
    return (*PRESETS, *(name for name in RULES if name != "return"))


def make_teacher(name: str, /, *, seed: int = 0, **parameters: Any) -> ScriptedTeacher:
    """Make a teacher by name.

    Args:
        name: a preset, which compares true returns; a rule, which is followed without error; or `rule+preset`.
        seed: of the random number generator.
        parameters: fields of `BPrefParameters` and of the rule, to override the defaults of the name.

    Raises:
        UnknownTeacher: if no teacher has this name.
        InvalidTeacher: if a parameter does not exist, has the wrong type or is out of range.
    """
    rule_name, preset_name = _parts(name)
    seed = _typed(name, "seed", int, seed)
    if seed < 0:
        raise InvalidTeacher(f"seed is {seed}; it must be 0 or more.")
    bpref, rule = PRESETS[preset_name], RULES[rule_name]
    bpref_names = {field.name for field in fields(BPrefParameters)}
    bpref = _changed(bpref, {key: value for key, value in parameters.items() if key in bpref_names}, name)
    rule = _changed(rule, {key: value for key, value in parameters.items() if key not in bpref_names}, name)
    record = {"name": name, "rule": rule_name, "seed": seed}
    return ScriptedTeacher(rule, bpref, np.random.default_rng(seed), record)


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
    """Replace fields after checking their names and types."""
    hints = get_type_hints(type(settings))
    known = [field.name for field in fields(settings)]
    if unknown := changes.keys() - set(known):
        accepted = dict.fromkeys([*(field.name for field in fields(BPrefParameters)), *known])
        raise InvalidTeacher(
            f"{name} has no parameter {', '.join(sorted(unknown))}. Known parameters: {', '.join(accepted)}."
        )
    return replace(settings, **{key: _typed(name, key, hints[key], value) for key, value in changes.items()})


def _typed(name: str, key: str, hint: Any, value: Any) -> Any:
    """Convert a value to the type of its field."""
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
    raise InvalidTeacher(f"{key} of {name} is {value!r}; it must be {wanted}.")
