"""Settings of a reward network, with the two presets."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields, replace
from typing import Literal, get_args

from mapt.rewards.errors import InvalidConfig
from mapt.rewards.settings import check_positive_int, check_range, read_settings

TemporalEncoder = Literal["attention", "lstm", "none"]
PresetName = Literal["paper", "small"]


@dataclass(frozen=True, slots=True)
class RewardConfig:
    """Shape of a reward network. Every variant of the paper is a setting of this one network.

    MAPT is the default; `tpa=False` gives MAPT-TPA, `cpa=False` MAPT-CPA, `temporal="lstm"` MAPT*.

    Raises:
        InvalidConfig: naming the setting and its range.
    """

    #: C, numbers in one agent's observation
    observation_dim: int
    #: A, numbers in one agent's action, or how many actions there are
    action_dim: int
    #: N
    n_agents: int
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
    #: self-attention over the agents of a step in the embedding
    agent_attention: bool = True
    #: cooperation-aware preference attention (paper, eq. 4); without it, a linear read-out per agent
    cpa: bool = True
    #: temporal-aware preference attention (paper, eq. 5 and 6); without it, equal weights
    tpa: bool = True
    #: a Markov reward per agent beside the attention path, which then starts at zero
    markov_path: bool = True

    def __post_init__(self) -> None:
        for name in ("observation_dim", "action_dim", "n_agents", "hidden_dim", "layers", "heads"):
            check_positive_int(name, getattr(self, name))
        if self.hidden_dim % (2 * self.heads):
            raise InvalidConfig(f"hidden_dim is {self.hidden_dim}; it must be a multiple of twice heads ({self.heads})")
        if self.temporal not in get_args(TemporalEncoder):
            raise InvalidConfig(f"temporal is {self.temporal!r}; known: {', '.join(get_args(TemporalEncoder))}")
        check_range("dropout", self.dropout, 0.0, 0.9)
        for name in ("agent_attention", "cpa", "tpa", "markov_path"):
            if not isinstance(getattr(self, name), bool):
                raise InvalidConfig(f"{name} is {getattr(self, name)!r}; it must be true or false")

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
_NETWORK_PRESETS: dict[str, RewardConfig] = {
    "paper": RewardConfig(1, 1, 1, hidden_dim=256, layers=1, heads=4, dropout=0.1),
    "small": RewardConfig(1, 1, 1),
}
