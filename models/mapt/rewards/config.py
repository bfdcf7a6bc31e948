"""Settings of a reward network, with the two presets."""

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, fields, replace
from typing import Literal, TypeVar, get_args

from mapt.errors import InvalidConfig

SettingsT = TypeVar("SettingsT")


def read_settings(build: Callable[..., SettingsT], known: set[str], values: Mapping[str, object]) -> SettingsT:
    unknown = sorted(set(values) - known)
    if unknown:
        raise InvalidConfig(f"unknown setting {unknown[0]!r}; known: {', '.join(sorted(known))}")
    try:
        return build(**values)
    except TypeError as error:
        raise InvalidConfig(str(error)) from error


def check_positive_int(name: str, value: object) -> None:
    if not isinstance(value, int) or isinstance(value, bool) or value < 1:
        raise InvalidConfig(f"{name} is {value!r}; it must be a whole number, 1 or more")


def check_range(name: str, value: object, low: float, high: float) -> None:
    if not isinstance(value, int | float) or isinstance(value, bool) or not low <= value <= high:
        raise InvalidConfig(f"{name} is {value!r}; it must lie in [{low}, {high}]")


Architecture = Literal["mapt", "mlp", "lstm", "transformer"]
TemporalEncoder = Literal["attention", "lstm", "none"]
TpaKey = Literal["rewards", "features"]
PresetName = Literal["paper", "small"]


#: What each model of the tables is, beside a preset; in the order of the tables.
_NAMED: dict[str, dict[str, object]] = {
    "MAPT": {},
    "MAPT-TPA": {"tpa": False},
    "MAPT-CPA": {"cpa": False},
    "MAPT*": {"temporal": "lstm"},
    "MAPT*-CPA": {"temporal": "lstm", "cpa": False},
    "MA-MLP": {"architecture": "mlp", "temporal": "none"},
    "MA-LSTM": {"architecture": "lstm", "temporal": "lstm", "markov_path": False},
    "MA-Transformer": {"architecture": "transformer", "markov_path": False},
}
#: Every model of the tables, in their order.
MODEL_NAMES = tuple(_NAMED)
# The paths of the past that an architecture can have.
_TEMPORAL: dict[str, tuple[str, ...]] = {
    "mapt": get_args(TemporalEncoder),
    "mlp": ("none",),
    "lstm": ("lstm",),
    "transformer": ("attention",),
}


@dataclass(frozen=True, slots=True)
class RewardConfig:
    """Shape of a reward network. Every variant of the paper is a setting of one network, MAPT, the default.

    `RewardConfig.named` gives the models of the tables by name.

    Raises:
        InvalidConfig: naming the setting and its range.
    """

    #: C, numbers in one agent's observation
    observation_dim: int
    #: A, numbers in one agent's action, or how many actions there are
    action_dim: int
    #: N
    n_agents: int
    #: MAPT, or the baseline in its place: MA-MLP, MA-LSTM, MA-Transformer
    architecture: Architecture = "mapt"
    #: actions are one-hot, and no normalisation touches them
    discrete_actions: bool = False
    #: d
    hidden_dim: int = 64
    #: what carries the past to step t
    temporal: TemporalEncoder = "attention"
    #: blocks of the temporal encoder
    layers: int = 1
    #: heads of the self-attentions (the two preference attentions have one)
    heads: int = 2
    #: probability with which a branch's output is dropped, number by number
    dropout: float = 0.1
    #: self-attention over the agents of a step in the embedding (this and the next two: MAPT alone)
    agent_attention: bool = True
    #: cooperation-aware preference attention (paper, eq. 4); without it, a linear read-out per agent
    cpa: bool = True
    #: temporal-aware preference attention (paper, eq. 5 and 6); without it, equal weights
    tpa: bool = True
    #: what a step is weighed by in that attention: the individual rewards, as in eq. 5, or the team's features, as
    #: in Preference Transformer
    tpa_key: TpaKey = "rewards"
    #: a Markov reward per agent beside the path that sees the past, which then starts at zero
    markov_path: bool = True
    #: width of that path; 0 for d
    markov_dim: int = 0

    def __post_init__(self) -> None:
        for name in ("observation_dim", "action_dim", "n_agents", "hidden_dim", "layers", "heads"):
            check_positive_int(name, getattr(self, name))
        if self.hidden_dim % (2 * self.heads):
            raise InvalidConfig(f"hidden_dim is {self.hidden_dim}; it must be a multiple of twice heads ({self.heads})")
        if self.tpa_key not in get_args(TpaKey):
            raise InvalidConfig(f"tpa_key is {self.tpa_key!r}; known: {', '.join(get_args(TpaKey))}")
        if not isinstance(self.markov_dim, int) or isinstance(self.markov_dim, bool) or self.markov_dim < 0:
            raise InvalidConfig(f"markov_dim is {self.markov_dim!r}; it must be a whole number, 0 for hidden_dim")
        self._check_paths()
        check_range("dropout", self.dropout, 0.0, 0.9)
        for name in ("discrete_actions", "agent_attention", "cpa", "tpa", "markov_path"):
            if not isinstance(getattr(self, name), bool):
                raise InvalidConfig(f"{name} is {getattr(self, name)!r}; it must be true or false")

    def _check_paths(self) -> None:
        if self.architecture not in _TEMPORAL:
            raise InvalidConfig(f"architecture is {self.architecture!r}; known: {', '.join(_TEMPORAL)}")
        known = _TEMPORAL[self.architecture]
        if self.temporal not in known:
            raise InvalidConfig(
                f"temporal is {self.temporal!r}; known for the architecture {self.architecture!r}: {', '.join(known)}"
            )
        if self.architecture == "mlp" and not self.markov_path:
            raise InvalidConfig("markov_path is False, but the architecture 'mlp' has no other path")

    @classmethod
    def preset(cls, name: PresetName, *, observation_dim: int, action_dim: int, n_agents: int) -> "RewardConfig":
        """The network of a preset for a task of these dimensions.

        Raises:
            InvalidConfig: if no preset has this name.
        """
        if name not in _NETWORK_PRESETS:
            raise InvalidConfig(f"no preset is called {name!r}; known: {', '.join(_NETWORK_PRESETS)}")
        return replace(
            _NETWORK_PRESETS[name],
            observation_dim=observation_dim,
            action_dim=action_dim,
            n_agents=n_agents,
        )

    @classmethod
    def named(
        cls,
        name: str,
        preset: PresetName = "small",
        *,
        observation_dim: int,
        action_dim: int,
        n_agents: int,
        discrete_actions: bool = False,
    ) -> "RewardConfig":
        """The model of the tables called `name`, one of `MODEL_NAMES`, at the size of a preset.

        Raises:
            InvalidConfig: if no model or preset has this name.
        """
        if name not in _NAMED:
            raise InvalidConfig(f"no reward model is called {name!r}; known: {', '.join(MODEL_NAMES)}")
        sized = cls.preset(preset, observation_dim=observation_dim, action_dim=action_dim, n_agents=n_agents)
        return cls.from_dict({**sized.to_dict(), "discrete_actions": discrete_actions, **_NAMED[name]})

    @property
    def dimensions(self) -> tuple[int, int, int]:
        """Agents, numbers of an observation and of an action: (N, C, A)."""
        return self.n_agents, self.observation_dim, self.action_dim

    def to_dict(self) -> dict[str, object]:
        """Plain values, fit for JSON; `from_dict` reads them back."""
        return asdict(self)

    @classmethod
    def from_dict(cls, values: Mapping[str, object]) -> "RewardConfig":
        """Read settings; those left out keep their default.

        Raises:
            InvalidConfig: for an unknown or missing key, or a value out of range.
        """
        return read_settings(cls, {field.name for field in fields(cls)}, values)


# The dimensions are the task's: `RewardConfig.preset` puts them in.
#
# d = 32 takes half the time of 64 on a CPU and told no fewer fresh pairs rightly on 2,000 labels (recency: 0.888 both
# for MA-Transformer; phase: 0.862 to 0.837 for MAPT trained at once).
_NETWORK_PRESETS: dict[str, RewardConfig] = {
    "paper": RewardConfig(1, 1, 1, hidden_dim=256, layers=1, heads=4, dropout=0.1, markov_dim=64),
    "small": RewardConfig(1, 1, 1, hidden_dim=32, markov_dim=64),
}


Precision = Literal["float32", "bfloat16", "auto"]


@dataclass(frozen=True, slots=True)
class TrainConfig:
    """How a reward network is trained.

    Raises:
        InvalidConfig: naming the setting and its range.
    """

    #: AdamW's step size for the whole network
    lr: float = 2e-3
    #: and for the Markov path by itself
    markov_lr: float = 3e-3
    #: most pairs in one step; fewer where the dataset is small
    batch_pairs: int = 32
    #: most epochs of the Markov path alone, before the whole network is trained; 0 leaves them out
    markov_epochs: int = 40
    #: most epochs of the whole network
    max_epochs: int = 60
    #: epochs without a better hold-out loss before the Markov path's own training stops
    markov_patience: int = 10
    #: and before that of the whole network stops, once it tells pairs better than guessing does (at least 20 before)
    patience: int = 5
    #: most times that a pair is shown to the Markov path, and to the whole network: pairs times epochs
    markov_visits: int = 160_000
    visits: int = 96_000
    #: most epochs of either stage when a version goes on from the one before, which knows most of it already
    warm_markov_epochs: int = 8
    warm_epochs: int = 1
    #: how much of the Markov path's weights such a version begins with, beside new ones; 1 for all
    warm_share: float = 0.5
    hold_out_fraction: float = 0.2
    #: share of the labels that the loss takes to be mistakes; see `mapt.preferences.loss`
    label_noise: float = 0.0
    #: AdamW's decoupled weight decay for the whole network
    weight_decay: float = 1.0
    #: and for the Markov path by itself
    markov_weight_decay: float = 0.01
    seed: int = 0
    #: "auto" takes CUDA where there is one
    device: str = "auto"
    #: what layers multiply in: float32, bfloat16, or auto, which takes bfloat16 where it pays
    precision: Precision = "auto"

    def __post_init__(self) -> None:
        for name in (
            "batch_pairs",
            "max_epochs",
            "markov_patience",
            "patience",
            "warm_epochs",
            "markov_visits",
            "visits",
        ):
            check_positive_int(name, getattr(self, name))
        if not isinstance(self.seed, int) or isinstance(self.seed, bool) or self.seed < 0:
            raise InvalidConfig(f"seed is {self.seed!r}; it must be a whole number, 0 or more")
        for name in ("markov_epochs", "warm_markov_epochs"):
            epochs = getattr(self, name)
            if not isinstance(epochs, int) or isinstance(epochs, bool) or epochs < 0:
                raise InvalidConfig(f"{name} is {epochs!r}; it must be a whole number, 0 or more")
        if self.precision not in get_args(Precision):
            raise InvalidConfig(f"precision is {self.precision!r}; known: {', '.join(get_args(Precision))}")
        check_range("lr", self.lr, 1e-8, 1.0)
        check_range("markov_lr", self.markov_lr, 1e-8, 1.0)
        check_range("warm_share", self.warm_share, 0.0, 1.0)
        check_range("hold_out_fraction", self.hold_out_fraction, 0.01, 0.5)
        check_range("label_noise", self.label_noise, 0.0, 0.49)
        check_range("weight_decay", self.weight_decay, 0.0, 10.0)
        check_range("markov_weight_decay", self.markov_weight_decay, 0.0, 10.0)

    @classmethod
    def preset(cls, name: PresetName) -> "TrainConfig":
        """The training of a preset.

        Raises:
            InvalidConfig: if no preset has this name.
        """
        if name not in _TRAIN_PRESETS:
            raise InvalidConfig(f"no preset is called {name!r}; known: {', '.join(_TRAIN_PRESETS)}")
        return _TRAIN_PRESETS[name]

    def to_dict(self) -> dict[str, object]:
        """Plain values, fit for JSON; `from_dict` reads them back."""
        return asdict(self)

    @classmethod
    def from_dict(cls, values: Mapping[str, object]) -> "TrainConfig":
        """Read settings; those left out keep their default.

        Raises:
            InvalidConfig: for an unknown key or a value out of range.
        """
        return read_settings(cls, {field.name for field in fields(cls)}, values)


# `small` was chosen on 500 oracle-labelled pairs (T = 50) from replays of teams learning HalfCheetah-6x1, two
# seeds. The Markov path by itself told 0.984 of fresh pairs rightly, at ten times the pairs a second of the whole
# network; steps of 3e-4 of the whole network then kept that. For the Markov path, two hidden layers correlated
# better with the true reward of single steps than one (0.82 to 0.74, within segments), a constant 3e-3 with
# batches of 32 better than annealed steps and smaller batches (0.84 to 0.81), and dropout there cost accuracy
# (0.986 to 0.980).
# `warm_share` and its epochs were chosen on 3,000 labels of a run of `accord demo` (seed 1), taken in by eleven
# versions as they came. With all weights kept, the path holds on to what explained the untrained team: the last
# version's rewards of single steps correlated with the true ones within segments at 0.62, trained from scratch at 0.71
# to 0.76, with half of the weights at 0.72 (Ash and Adams, 2020, "On Warm-Starting Neural Network Training"). Pairs of
# whole segments show nothing of it.
# The weight decay of the whole network was chosen on 2,000 pairs of a teacher of history and co-operation (finds-phase,
# seed 0): with 0.01 the hold-out loss was at its best after 9 epochs, 0.46, and rose; with 1.0 it still fell after 40,
# to 0.32.
_TRAIN_PRESETS: dict[str, TrainConfig] = {
    "paper": TrainConfig(
        lr=1e-4, batch_pairs=256, markov_epochs=0, max_epochs=300, patience=30, visits=10**9, weight_decay=0.01
    ),
    "small": TrainConfig(),
}
