"""What a researcher sets when starting an experiment."""

from dataclasses import asdict, dataclass, field
from typing import Literal, get_args

from accord.domain.errors import InvalidExperiment
from accord.domain.schedule import LabelSchedule, LabelScheduleName
from mapt.errors import InvalidConfig
from mapt.policies.config import PolicyConfig

Pacing = Literal["wait", "free"]
RewardSource = Literal["preferences", "true"]
#: the presets of `mapt.rewards`
RewardPreset = Literal["small", "paper"]
#: the models of `mapt.rewards`
RewardModelName = Literal["MAPT", "MAPT-TPA", "MAPT-CPA", "MAPT*", "MAPT*-CPA", "MA-MLP", "MA-LSTM", "MA-Transformer"]
PolicyReward = Literal["value", "attended", "weighted"]
Credit = Literal["shared", "individual"]
#: the selectors of `mapt.preferences.selection`
QuerySelection = Literal["uniform", "disagreement", "entropy", "k_center", "disagreement_k_center", "entropy_k_center"]


@dataclass(frozen=True, slots=True)
class ExperimentConfig:
    """Frozen when the experiment is made: every later row can be traced to it."""

    #: a name of `mapt.tasks`, for example HalfCheetah-6x1
    task: str
    #: environment steps the policy trains for, counted over all environments
    total_steps: int = 1_000_000
    #: T, the steps of a segment; a clip lasts T times the task's step_seconds
    segment_steps: int = 50
    #: labels asked for in all
    label_budget: int = 500
    #: labels before the first reward version
    initial_labels: int = 100
    #: new labels after which the reward worker trains the next version
    labels_per_version: int = 50
    #: queries kept open beyond those due, so that a labeller never waits for a clip
    lookahead_queries: int = 8
    #: how the labels due grow with the policy's steps
    label_schedule: LabelScheduleName = "power"
    #: how pairs are chosen from the second round on; the first round is uniform
    query_selection: QuerySelection = "uniform"
    #: the share of queries that stay uniform whatever `query_selection` is, to measure it by
    control_share: float = 0.2
    #: M, reward models whose disagreement chooses queries; trained where `query_selection` needs them
    ensemble_members: int = 3
    #: `wait`: the policy halts until due labels are in; `free`: it trains on with the newest version
    pacing: Pacing = "wait"
    #: `true` trains the same learner on the task's own reward, as a baseline; it asks for no labels
    reward_source: RewardSource = "preferences"
    #: which reward model learns from the labels
    reward_model: RewardModelName = "MAPT"
    #: size of the reward model and how it is trained
    reward_preset: RewardPreset = "small"
    #: share of the labels that training takes to be mistakes; for people, 0.1 is usual
    label_noise: float = 0.0
    #: what the policy is given of the model's rewards: that of the step, or one that temporal attention has weighed
    policy_reward: PolicyReward = "value"
    #: whether every agent gets the mean reward, or each its own
    credit: Credit = "shared"
    #: whether clips are made for every query; a scripted teacher alone needs none
    render_clips: bool = True
    #: fields of `mapt.policies.PolicyConfig` that differ from its defaults
    policy: dict[str, int | float | bool | str] = field(default_factory=dict[str, "int | float | bool | str"])
    #: auto, cpu or cuda
    device: str = "auto"
    seed: int = 0

    def __post_init__(self) -> None:
        """Checks what can be checked without the task.

        Raises:
            InvalidExperiment: naming the setting, its value and what would do.
        """
        for name, low, high in (
            ("total_steps", 1, 10**12),
            ("segment_steps", 2, 10_000),
            ("label_budget", 0, 10**7),
            ("labels_per_version", 1, 10**6),
            ("lookahead_queries", 1, 1000),
            ("control_share", 0, 1),
            ("label_noise", 0, 0.49),
            ("ensemble_members", 2, 16),
            ("seed", 0, 2**31 - 1),
        ):
            value = getattr(self, name)
            if not low <= value <= high:
                raise InvalidExperiment(f"{name} is {value}; it must be from {low} to {high}.")
        if self.reward_source == "preferences" and not 2 <= self.initial_labels <= self.label_budget:
            raise InvalidExperiment(
                f"initial_labels is {self.initial_labels}; it must be from 2 to label_budget ({self.label_budget})."
            )

    def check_names(self) -> None:
        """Checks the settings that are one of a few words, when an experiment is made.

        Not when one is read: an experiment of another version of Accord, whose words were others, can still be seen.

        Raises:
            InvalidExperiment: naming the setting, its value and the known ones.
        """
        for name, known in _KNOWN.items():
            value = getattr(self, name)
            if value not in known:
                raise InvalidExperiment(f"{name} is {value!r}; it must be one of: {', '.join(known)}.")

    def check_horizon(self, horizon_steps: int) -> None:
        """Raises InvalidExperiment if a segment would not fit into an episode."""
        if self.segment_steps > horizon_steps:
            raise InvalidExperiment(
                f"segment_steps is {self.segment_steps}, but an episode of {self.task} lasts {horizon_steps} steps. "
                f"Choose at most {horizon_steps}."
            )

    @property
    def schedule(self) -> LabelSchedule:
        return LabelSchedule(self.label_budget, self.initial_labels, self.total_steps, name=self.label_schedule)

    def to_dict(self) -> dict[str, object]:
        return asdict(self)


_KNOWN: dict[str, tuple[str, ...]] = {
    "pacing": get_args(Pacing),
    "reward_source": get_args(RewardSource),
    "reward_model": get_args(RewardModelName),
    "reward_preset": get_args(RewardPreset),
    "policy_reward": get_args(PolicyReward),
    "credit": get_args(Credit),
    "label_schedule": get_args(LabelScheduleName),
    "query_selection": get_args(QuerySelection),
}


def policy_settings(config: ExperimentConfig, n_threads: int = 0) -> PolicyConfig:
    """The learner's defaults, the experiment's seed and device, then what the researcher set.

    Raises:
        InvalidExperiment: if a setting is unknown or out of its range, or a rollout is too short for a segment.
    """
    try:
        settings = PolicyConfig.from_dict(
            {"seed": config.seed, "device": config.device, "n_threads": n_threads, **config.policy}
        )
    except InvalidConfig as error:
        raise InvalidExperiment(f"policy: {error}") from error
    if config.reward_source == "preferences" and settings.rollout_steps < config.segment_steps:
        raise InvalidExperiment(
            f"segment_steps is {config.segment_steps}, but a rollout has {settings.rollout_steps} steps of each "
            f"environment, so no segment fits. Set policy.rollout_steps to {config.segment_steps} or more."
        )
    return settings
