"""How a reward model's training goes: the Markov path by itself, while the rest is held still; then everything.

The Markov path takes a tenth of the time of the whole network and, where the true reward is Markov, all there is
to learn. Trained to its end it also explains, by heart, what a Markov reward cannot: so the whole network goes on
from an early state of it, which has left something to explain. It is kept only where the hold-out gains by it
against the Markov path at its best; a hold-out too small to tell lets nothing be added.

A version that goes on from another keeps half of the Markov path's weights: what explained the first labels holds it
back otherwise, in the rewards of single steps more than in what pairs can show.

An LSTM finds nothing even beside an early Markov path: its gradient comes through layers that are still zero, and the
Markov path takes up what there is to gain meanwhile. A network with one begins the second stage untrained.
"""

import math
from dataclasses import dataclass

from torch import Tensor

from mapt.rewards.config import RewardConfig, TrainConfig
from mapt.rewards.model import RewardModel

# How far the Markov path's own training has come where the whole network goes on from it.
EARLY_SHARE = 0.3
# Memories and attention may tell pairs no better than guessing for ten epochs and more, and then find what there is: an
# LSTM on teachers of history and co-operation. Five epochs of patience would end that before it has begun.
FIRST_PATIENCE = 20


@dataclass(frozen=True, slots=True)
class StageSettings:
    """How one stage is trained, and how long."""

    lr: float
    weight_decay: float
    batch_pairs: int
    max_epochs: int
    #: epochs without a better judgement before the stage ends, once it tells pairs better than guessing does
    patience: int
    #: share of the labels that the loss takes to be mistakes
    label_noise: float
    #: and until then; `patience` where that is more
    first_patience: int = 0
    #: keep what was learned only if it beats the weights that the model had by more than chance would
    must_convince: bool = False
    #: how much of the trained weights to begin with, beside newly drawn ones
    kept_share: float = 1.0
    #: begin with the weights that the model had before any training, and with a read-out that is not zero
    anew: bool = False
    #: epoch whose weights are remembered for the next stage; 0 for none
    remember_epoch: int = 0


@dataclass(frozen=True, slots=True)
class Stages:
    """Both stages; None where a model has nothing for it to train."""

    markov: StageSettings | None
    whole: StageSettings | None

    @property
    def max_epochs(self) -> int:
        """The most epochs of both."""
        return sum(stage.max_epochs for stage in (self.markov, self.whole) if stage is not None)


def plan_stages(config: TrainConfig, network: RewardConfig, n_pairs: int, *, warm: bool, reliable: bool) -> Stages:
    """The stages of a training on so many pairs.

    Args:
        warm: whether it goes on from a trained model.
        reliable: whether the hold-out is large enough to judge by.
    """
    markov = _markov_stage(config, n_pairs, warm=warm) if network.markov_path else None
    # A Markov model is its Markov path; and nothing is added to one that nothing can be judged by.
    if markov is not None and (network.architecture == "mlp" or not reliable):
        return Stages(markov, None)
    # Without a Markov path there is nothing good to fall back to.
    must_convince = network.markov_path and reliable
    anew = network.markov_path and network.temporal == "lstm" and not warm
    return Stages(markov, _whole_stage(config, n_pairs, warm=warm, must_convince=must_convince, anew=anew))


def state_to_begin_with(stage: StageSettings | None, model: RewardModel) -> dict[str, Tensor] | None:
    """Weights with which a stage begins in place of those that `model`, not trained on yet, has; None for these."""
    if stage is None:
        return None
    if stage.anew:
        return model.awake_state()
    return model.softened_state(stage.kept_share) if stage.kept_share < 1.0 else None


def _markov_stage(config: TrainConfig, n_pairs: int, *, warm: bool) -> StageSettings | None:
    epochs = _epochs(config.warm_markov_epochs if warm else config.markov_epochs, config.markov_visits, n_pairs)
    if not epochs:
        return None
    return StageSettings(
        lr=config.markov_lr,
        weight_decay=config.markov_weight_decay,
        batch_pairs=config.batch_pairs,
        max_epochs=epochs,
        patience=config.markov_patience,
        label_noise=config.label_noise,
        remember_epoch=0 if warm else math.ceil(EARLY_SHARE * epochs),
        kept_share=config.warm_share if warm else 1.0,
    )


def _whole_stage(config: TrainConfig, n_pairs: int, *, warm: bool, must_convince: bool, anew: bool) -> StageSettings:
    return StageSettings(
        lr=config.lr,
        weight_decay=config.weight_decay,
        batch_pairs=config.batch_pairs,
        max_epochs=_epochs(config.warm_epochs if warm else config.max_epochs, config.visits, n_pairs),
        patience=config.patience,
        first_patience=FIRST_PATIENCE,
        label_noise=config.label_noise,
        must_convince=must_convince,
        anew=anew,
    )


def _epochs(most: int, visits: int, n_pairs: int) -> int:
    # Many labels need fewer passes over them.
    return min(most, math.ceil(visits / n_pairs))
