"""Settings of the training of a reward network, with the two presets."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from typing import Literal, get_args

from mapt.rewards.config import PresetName
from mapt.rewards.errors import InvalidConfig
from mapt.rewards.settings import check_positive_int, check_range, read_settings

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
