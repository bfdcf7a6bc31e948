"""Settings of a reward network, with the two presets."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields, replace
from typing import Literal, get_args

from mapt.rewards.errors import InvalidConfig
from mapt.rewards.settings import check_positive_int, check_range, read_settings

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
