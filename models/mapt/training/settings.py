"""What makes a run: equal settings, equal run."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Self, get_args

from mapt.errors import InvalidConfig
from mapt.policies import PolicyConfig
from mapt.rewards.model import PolicyReward
from mapt.rewards.relabelling import Credit
from mapt.tasks.registry import DEFAULT_AGENT_OBSK

#: how the true reward is written
TRUE = "true"


@dataclass(frozen=True, slots=True)
class LearnedRewardSettings:
    """A reward model, and what the policy is given of it.

    Raises:
        InvalidConfig: if a value is out of its range.
    """

    #: folder of reward.safetensors and reward.json, or a .safetensors file with its .json beside it
    path: str
    #: T: steps of the segments that the model was trained on
    segment_steps: int
    #: see `RewardModel.policy_rewards`
    kind: PolicyReward = "value"
    #: see `RolloutRelabeller`
    credit: Credit = "shared"

    def __post_init__(self) -> None:
        if self.segment_steps < 1:
            raise InvalidConfig(f"segment_steps is {self.segment_steps}; it must be 1 or more")
        for name, value, known in (
            ("policy_reward", self.kind, get_args(PolicyReward)),
            ("credit", self.credit, get_args(Credit)),
        ):
            if value not in known:
                raise InvalidConfig(f"{name} is {value!r}; known: {', '.join(known)}")


@dataclass(frozen=True, slots=True)
class PreferenceRewardSettings:
    """A reward model that is trained on preference labels while the policy learns from it."""

    #: a name of `mapt.rewards.config.MODEL_NAMES`
    model: str
    #: labels in all
    labels: int
    #: labels before the first version
    initial_labels: int
    #: new labels for each further version
    labels_per_version: int
    #: who labels, such as `oracle` or `mistake (mistake=0.05)`
    teacher: str


@dataclass(frozen=True, slots=True)
class RunSettings:
    """One policy's training.

    Raises:
        InvalidConfig: if a value is out of its range.
    """

    task: str
    #: with the seed and the algorithm
    policy: PolicyConfig
    #: environment steps to train for, rounded up to whole rollouts
    steps: int
    #: None for the task's own reward
    reward: LearnedRewardSettings | PreferenceRewardSettings | None = None
    #: how many joints away an agent sees
    agent_obsk: int = DEFAULT_AGENT_OBSK
    #: environment steps between evaluations; 0 for one at the end alone
    evaluate_every_steps: int = 0

    def __post_init__(self) -> None:
        if self.steps < 1:
            raise InvalidConfig(f"steps is {self.steps}; it must be 1 or more")
        if self.evaluate_every_steps < 0:
            raise InvalidConfig(f"evaluate_every_steps is {self.evaluate_every_steps}; it must be 0 or more")

    def to_dict(self) -> dict[str, object]:
        """What `from_dict` reads, ready for JSON."""
        return {
            "task": self.task,
            "policy": self.policy.to_dict(),
            "steps": self.steps,
            "reward": asdict(self.reward) if self.reward else None,
            "agent_obsk": self.agent_obsk,
            "evaluate_every_steps": self.evaluate_every_steps,
        }

    @classmethod
    def from_dict(cls, settings: Mapping[str, object]) -> Self:
        """Settings from parsed JSON.

        Raises:
            InvalidConfig: if a key is unknown or missing, or a value out of its range.
        """
        values = dict(settings)
        try:
            policy, reward = values.pop("policy"), values.pop("reward")
            if not isinstance(policy, Mapping) or not isinstance(reward, Mapping | None):
                raise InvalidConfig("policy and reward of a run must be settings by name")
            return cls(policy=PolicyConfig.from_dict(policy), reward=_reward_of(reward), **values)  # pyright: ignore[reportArgumentType]
        except (KeyError, TypeError) as error:
            raise InvalidConfig(f"These are not the settings of a run: {error}") from error

    def flat(self) -> dict[str, object]:
        """Every setting by name, those within others as `outer.inner`."""
        return _flat(self.to_dict())

    def differences(self, other: "RunSettings") -> list[str]:
        """How `other` differs, as `name: own value, not its`; steps do not count, since a run may be made longer."""
        own, its = self.flat(), other.flat()
        names = [name for name in own | its if name != "steps" and own.get(name) != its.get(name)]
        return [f"{name}: {own.get(name)}, not {its.get(name)}" for name in names]


def _reward_of(settings: Mapping[str, object] | None) -> LearnedRewardSettings | PreferenceRewardSettings | None:
    """Raises InvalidConfig, TypeError."""
    if settings is None:
        return None
    kind = PreferenceRewardSettings if "model" in settings else LearnedRewardSettings
    return kind(**settings)  # pyright: ignore[reportArgumentType]


def _flat(settings: Mapping[str, object]) -> dict[str, object]:
    """Inner settings as `outer.inner`."""
    flat: dict[str, object] = {}
    for name, value in settings.items():
        flat |= (
            {f"{name}.{key}": inner for key, inner in value.items()} if isinstance(value, Mapping) else {name: value}
        )
    return flat
