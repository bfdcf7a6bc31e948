"""Train an ensemble of reward models in one vectorised pass.

Members begin with weights of their own and see the pairs in an order of their own, or a draw of their own. Where labels
settle the matter they agree; where they do not, the spread of their predictions says so.
"""

import math
import time
from collections.abc import Callable, Sequence

import numpy as np
import torch
from torch import Tensor

from mapt.device import resolve_device, seeded
from mapt.errors import ModelMismatch
from mapt.preferences.dataset import PreferenceDataset, SegmentSource
from mapt.rewards.config import RewardConfig, TrainConfig, check_positive_int
from mapt.rewards.data import PairTensors, SegmentReader, check_fit, segment_reader, spread_sample
from mapt.rewards.ensemble_fitting import (
    EnsembleFitting,
    EnsembleStage,
    logit_losses,
    mean_accuracy,
    pair_logits,
)
from mapt.rewards.ensemble_scorers import (
    markov_stack_scorer,
    measure_reward_scales,
    whole_stack_scorer,
)
from mapt.rewards.kernels import resolve_precision
from mapt.rewards.members import RewardEnsemble
from mapt.rewards.model import RewardModel
from mapt.rewards.registry import build_reward_model
from mapt.rewards.schedule import Stages, StageSettings, plan_stages, state_to_begin_with
from mapt.rewards.stacked import StackedModels
from mapt.rewards.trainer import MOST_PAIRS_JUDGED, TrainProgress, is_reliable

__all__ = ["RewardEnsemble", "train_reward_ensemble"]


def train_reward_ensemble(
    dataset: PreferenceDataset,
    config: RewardConfig,
    train_config: TrainConfig,
    members: int,
    *,
    initial: RewardEnsemble | None = None,
    reference: SegmentSource | None = None,
    resampled: bool = False,
    progress: Callable[[TrainProgress], None] | None = None,
    stop: Callable[[], bool] | None = None,
) -> RewardEnsemble:
    """Train M models at once; the same arguments give the same ensemble on the same machine.

    Stages, patience and what must convince the hold-out are those of `train_reward_model`; every member is judged
    by itself, on the same hold-out.

    Args:
        dataset: at least two labelled pairs.
        config: of every member; its dimensions must be the dataset's.
        members: M, 1 or more.
        initial: an ensemble of the same `config` and M to go on from; it is left as it is.
        reference: segments over which each member's rewards are normalised; the dataset's own when not given.
        resampled: each member learns from its own draw, with replacement, of the training pairs (a bootstrap). That
            costs each a third of the pairs; without it, members differ by their initial weights and order.
        progress: called after every epoch, with means over members.
        stop: asked before every step; true ends the training with each member's best weights so far.

    Returns:
        The ensemble. Its metrics are means over members: `loss` and `accuracy` (of the first 500 training pairs),
        `holdout_loss`, `holdout_accuracy`; of the mean of the members' probabilities: `ensemble_holdout_loss`,
        `ensemble_holdout_accuracy`; and `members`, `labels`, `holdout_labels`, `holdout_reliable`, `epochs`,
        `seconds`, `stopped`. What cannot be measured is left out.

    Raises:
        InvalidConfig: if `members` is no positive whole number.
        NotEnoughPairs: with fewer than two pairs.
        ModelMismatch: if dataset, config and `initial` do not fit each other.
    """
    check_positive_int("members", members)
    check_fit(config, dataset.segments)
    _check_initial(initial, config, members)
    started = time.perf_counter()
    device = resolve_device(train_config.device)
    segments = segment_reader(dataset.segments, device)
    train, hold_out = (
        PairTensors.of(part, device) for part in dataset.split(train_config.hold_out_fraction, train_config.seed)
    )
    with seeded(train_config.seed, device):
        models = [build_reward_model(config) if initial is None else initial.member(i) for i in range(members)]
        observed = segments.take(spread_sample(segments)).inputs
        for model in models:
            model.to(device).measure_inputs(*observed, keep_function=initial is not None)
        stack = StackedModels(models)
        stages = plan_stages(train_config, config, len(train), warm=initial is not None, reliable=is_reliable(hold_out))
        fitting = EnsembleFitting(
            stack,
            train,
            hold_out,
            seed=train_config.seed,
            max_epochs=stages.max_epochs,
            resampled=resampled,
            progress=progress,
            stop=stop,
        )
        used = torch.as_tensor(np.unique(dataset.pairs), device=device)
        products = resolve_precision(train_config.precision, config.hidden_dim, device)
        _run_stages(fitting, stack, models, segments, stages, used=used, products=products)
    judged = segments if reference is None else segment_reader(reference, device)
    measure_reward_scales(stack, judged, spread_sample(judged))
    metrics = {
        **_judged(stack, segments, train.first(MOST_PAIRS_JUDGED), hold_out, train_config.label_noise),
        "members": float(members),
        "labels": float(len(dataset)),
        "holdout_labels": float(len(hold_out)),
        "holdout_reliable": float(fitting.reliable),
        "epochs": float(fitting.epochs),
        "stopped": float(fitting.stopped),
        "seconds": time.perf_counter() - started,
    }
    stack.to(torch.device("cpu"))
    return RewardEnsemble(stack, {name: value for name, value in metrics.items() if math.isfinite(value)})


def _run_stages(
    fitting: EnsembleFitting,
    stack: StackedModels,
    before: Sequence[RewardModel],
    segments: SegmentReader,
    stages: Stages,
    *,
    used: Tensor,
    products: torch.dtype,
) -> None:
    names = list(stack.parameters)
    markov = [name for name in names if name.startswith("markov.")]
    first, second = _start(stages.markov, before, markov), _start(stages.whole, before, names)
    if stages.markov is not None:
        fitting.run(EnsembleStage(stages.markov, markov, markov_stack_scorer(stack, segments, used), start=first))
    if stages.whole is not None and not fitting.stopped:
        scorer = whole_stack_scorer(stack, segments, products)
        start = fitting.early if second is None else second
        fitting.run(EnsembleStage(stages.whole, names, scorer, start=start))


def _start(
    stage: StageSettings | None, models: Sequence[RewardModel], names: Sequence[str]
) -> dict[str, Tensor] | None:
    """What `state_to_begin_with` says of these parameters of each member, stacked."""
    states = [state for model in models if (state := state_to_begin_with(stage, model)) is not None]
    return {name: torch.stack([state[name] for state in states]) for name in names} if states else None


def _judged(
    stack: StackedModels, segments: SegmentReader, train: PairTensors, hold_out: PairTensors, label_noise: float
) -> dict[str, float]:
    scorer = whole_stack_scorer(stack, segments)
    logits, held_out = (pair_logits(part, scorer, len(stack)) for part in (train, hold_out))
    together = held_out.sigmoid().mean(dim=0, keepdim=True).logit(eps=1e-6)
    return {
        "loss": logit_losses(logits, train.labels, label_noise).mean().item(),
        "accuracy": mean_accuracy(logits, train.labels),
        "holdout_loss": logit_losses(held_out, hold_out.labels, label_noise).mean().item(),
        "holdout_accuracy": mean_accuracy(held_out, hold_out.labels),
        "ensemble_holdout_loss": logit_losses(together, hold_out.labels, label_noise).mean().item(),
        "ensemble_holdout_accuracy": mean_accuracy(together, hold_out.labels),
    }


def _check_initial(initial: RewardEnsemble | None, config: RewardConfig, members: int) -> None:
    if initial is not None and initial.config != config:
        raise ModelMismatch("settings of the initial ensemble", config, initial.config)
    if initial is not None and len(initial) != members:
        raise ModelMismatch("members of the initial ensemble", members, len(initial))
