"""How a reward model's training goes: the Markov path by itself, while the rest is held still; then everything.

The Markov path takes a tenth of the time of the whole network and, where the true reward is Markov, all there is
to learn. Trained to its end it also explains, by heart, what a Markov reward cannot: so the whole network goes on
from an early state of it, which has left something to explain. It is kept only where the hold-out gains by it
against the Markov path at its best; a hold-out too small to tell lets nothing be added.
"""

import math
from dataclasses import dataclass

from mapt.rewards.config import RewardConfig
from mapt.rewards.train_config import TrainConfig

# How far the Markov path's own training has come where the whole network goes on from it.
EARLY_SHARE = 0.3


@dataclass(frozen=True, slots=True)
class StageSettings:
    """How one stage is trained, and how long."""

    lr: float
    weight_decay: float
    batch_pairs: int
    max_epochs: int
    #: epochs without a better judgement before the stage ends
    patience: int
    #: share of the labels that the loss takes to be mistakes
    label_noise: float
    #: keep what was learned only if it beats the weights that the model had by more than chance would
    must_convince: bool = False
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
    markov, whole = config.markov_epochs, config.max_epochs
    if warm:
        markov, whole = config.warm_markov_epochs, config.warm_epochs
    # Many labels need fewer passes over them.
    markov = min(markov, math.ceil(config.markov_visits / n_pairs)) if network.markov_path else 0
    whole = min(whole, math.ceil(config.visits / n_pairs))
    # A Markov model is its Markov path; and nothing is added to one that nothing can be judged by.
    done = markov > 0 and (network.architecture == "mlp" or not reliable)
    return Stages(
        StageSettings(
            config.markov_lr,
            config.weight_decay,
            config.batch_pairs,
            markov,
            config.markov_patience,
            config.label_noise,
            remember_epoch=0 if warm else math.ceil(EARLY_SHARE * markov),
        )
        if markov
        else None,
        None
        if done
        else StageSettings(
            config.lr,
            config.weight_decay,
            config.batch_pairs,
            whole,
            config.patience,
            config.label_noise,
            # Without a Markov path there is nothing good to fall back to.
            must_convince=network.markov_path and reliable,
        ),
    )
