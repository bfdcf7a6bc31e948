"""Trains a reward model on labelled pairs.

`RewardTrainer.training_step` is one gradient step. After every epoch the hold-out evaluates a running average of the
weights, which decides which weights to keep and when to stop. `schedule.py` plans the stages.
"""

import copy
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import cast

import numpy as np
import torch
from torch import Tensor, nn
from torch.optim.swa_utils import AveragedModel

from mapt.device import resolve_device, seeded
from mapt.errors import ModelMismatch
from mapt.preferences.dataset import PreferenceDataset, SegmentSource
from mapt.preferences.loss import preference_loss, preference_losses
from mapt.rewards.config import RewardConfig, TrainConfig
from mapt.rewards.data import (
    PairTensors,
    Scorer,
    SegmentReader,
    check_fit,
    evenly_spaced_sample,
    markov_scorer,
    network_scorer,
    segment_reader,
    step_rewards,
)
from mapt.rewards.kernels import resolve_precision
from mapt.rewards.metrics import evaluate_logits
from mapt.rewards.model import RewardModel
from mapt.rewards.registry import build_reward_model
from mapt.rewards.schedule import (
    Schedule,
    StageSettings,
    is_above_chance,
    is_accepted,
    is_out_of_patience,
    is_reliable,
    plan_schedule,
    start_weights,
)

# Batches of small datasets shrink, down to MIN_BATCH_PAIRS, so that an epoch has about this many steps.
MIN_STEPS_PER_EPOCH = 8
MIN_BATCH_PAIRS = 8
GRADIENT_NORM_LIMIT = 1.0
# The evaluated weights average about the last hundred steps (Polyak and Juditsky, 1992). With 2,000 labels of a teacher
# who judges by the worst second, this raised a transformer's test accuracy from 0.726 to 0.764.
AVERAGE_DECAY = 0.99
# Training pairs from which `loss` and `accuracy` are computed.
MAX_EVALUATED_PAIRS = 500
# Activations (agent-steps times d) of one forward and backward pass on a CPU. At d = 256, passes of this size train on
# 8.0 pairs/s; whole batches, whose activations are allocated anew in every step, on 3.5.
ACTIVATIONS_PER_PASS = 1 << 20


@dataclass(frozen=True, slots=True)
class TrainProgress:
    """The state of a training after an epoch."""

    #: from 1, over all stages
    epoch: int
    #: upper bound of `epoch`
    max_epochs: int
    #: mean over the epoch's steps, nats
    loss: float
    holdout_loss: float
    holdout_accuracy: float
    seconds: float


@dataclass(frozen=True, slots=True)
class TrainedReward:
    """A trained model, in evaluation mode on the CPU."""

    model: RewardModel
    #: see `train_reward_model`
    metrics: dict[str, float]
    history: tuple[TrainProgress, ...]


@dataclass(frozen=True, slots=True)
class Stage:
    """One run of the training loop."""

    settings: StageSettings
    parameters: Sequence[nn.Parameter]
    scorer: Scorer
    #: weights to start with, instead of the model's own
    start: dict[str, Tensor] | None = None
    #: pairs per forward and backward pass; None for the whole batch
    pairs_per_pass: int | None = None


class RewardTrainer:
    """Trains one model, stage by stage; after each stage the model has the best weights found.

    Args:
        seed: of the order of the pairs.
        progress: called after every epoch; the model then has the weights that are being trained.
        stop: called before every step; true ends this stage and all later ones.
    """

    def __init__(
        self,
        model: RewardModel,
        train: PairTensors,
        hold_out: PairTensors,
        *,
        seed: int,
        max_epochs: int,
        progress: Callable[[TrainProgress], None] | None = None,
        stop: Callable[[], bool] | None = None,
    ) -> None:
        self._model, self._train, self._hold_out = model, train, hold_out
        self._shuffle = torch.Generator().manual_seed(seed)
        self._max_epochs = max_epochs
        self._progress, self._stop = progress, stop
        self._started = time.perf_counter()
        self.history: list[TrainProgress] = []
        self.stopped = False
        #: the best weights up to `early_epoch` of the last stage that has one
        self.early_weights: dict[str, Tensor] | None = None

    def training_step(
        self, stage: Stage, optimiser: torch.optim.Optimizer, average: AveragedModel, batch: Tensor
    ) -> Tensor:
        """Take one gradient step on the pairs at `batch`, int64 (B,); return their mean loss before it, in nats."""
        optimiser.zero_grad()
        loss = torch.zeros((), device=self._train.labels.device)
        for part in batch.split(stage.pairs_per_pass or len(batch)):
            score_0, score_1 = self._train.scores(self._model, stage.scorer, part)
            part_loss = preference_loss(score_0, score_1, self._train.labels[part], stage.settings.label_noise)
            part_loss = part_loss * (len(part) / len(batch))
            part_loss.backward()
            loss += part_loss.detach()
        nn.utils.clip_grad_norm_(stage.parameters, GRADIENT_NORM_LIMIT)
        optimiser.step()
        average.update_parameters(self._model)
        return loss

    def run(self, stage: Stage) -> None:
        """Train `stage.parameters`; leaves the model in evaluation mode."""
        settings = stage.settings
        # A hold-out that is too small leaves the choice of weights to the training pairs.
        reliable = is_reliable(len(self._hold_out))
        evaluated = self._hold_out if reliable else self._train
        self._model.eval()
        logits = evaluated.logits(self._model, stage.scorer)
        before = after = preference_losses(logits, evaluated.labels, settings.label_noise)
        initial = best = self._weights(self._model)
        # A stage that starts from other weights competes with `initial` only at its end.
        best_loss = before.mean().item() if stage.start is None else math.inf
        best_epoch, above_chance = 0, False
        if stage.start is not None:
            self._model.load_state_dict(stage.start)
        optimiser, average = adamw(stage.parameters, settings), weight_average(self._model)
        averaged = cast(RewardModel, average.module)
        for epoch in range(1, settings.max_epochs + 1):
            train_loss = self._train_epoch(stage, optimiser, average)
            if self.stopped:
                break
            hold_out_logits = self._hold_out.logits(averaged, stage.scorer)
            self._report(train_loss, hold_out_logits, settings.label_noise)
            logits = hold_out_logits if reliable else self._train.logits(averaged, stage.scorer)
            losses = preference_losses(logits, evaluated.labels, settings.label_noise)
            if losses.mean().item() < best_loss:
                best_loss, best, best_epoch, after = losses.mean().item(), self._weights(averaged), epoch, losses
            if epoch == settings.early_epoch:
                self.early_weights = best
            above_chance = above_chance or is_above_chance(losses)
            if is_out_of_patience(settings, epoch - best_epoch, above_chance):
                break
        self._model.load_state_dict(best if is_accepted(settings, before, after) else initial)
        self._model.eval()

    def _train_epoch(self, stage: Stage, optimiser: torch.optim.Optimizer, average: AveragedModel) -> float:
        """Mean loss of one pass over the training pairs; NaN if stopped."""
        losses: list[Tensor] = []
        self._model.train()
        order = torch.randperm(len(self._train), generator=self._shuffle)
        for batch in split_batches(order, stage.settings.batch_pairs):
            self.stopped = self.stopped or (self._stop is not None and self._stop())
            if self.stopped:
                return math.nan
            losses.append(self.training_step(stage, optimiser, average, batch))
        self._model.eval()
        return torch.stack(losses).mean().item()

    def _report(self, train_loss: float, hold_out_logits: Tensor, label_noise: float) -> None:
        evaluation = evaluate_logits(hold_out_logits, self._hold_out.labels, label_noise)
        self.history.append(
            TrainProgress(
                epoch=len(self.history) + 1,
                max_epochs=self._max_epochs,
                loss=train_loss,
                holdout_loss=evaluation.loss,
                holdout_accuracy=evaluation.accuracy,
                seconds=time.perf_counter() - self._started,
            )
        )
        if self._progress is not None:
            self._progress(self.history[-1])

    @staticmethod
    def _weights(model: RewardModel) -> dict[str, Tensor]:
        return copy.deepcopy(model.state_dict())


def train_reward_model(
    dataset: PreferenceDataset,
    config: RewardConfig,
    train_config: TrainConfig,
    *,
    initial: RewardModel | None = None,
    hold_out: PreferenceDataset | None = None,
    reference: SegmentSource | None = None,
    progress: Callable[[TrainProgress], None] | None = None,
    stop: Callable[[], bool] | None = None,
) -> TrainedReward:
    """Train the model of `config` on labelled pairs. On one machine, equal arguments give equal models.

    Args:
        dataset: at least two labelled pairs. Large sets of segments on disk are read batch by batch.
        config: the network; its dimensions must be the dataset's.
        initial: a model with the same `config` to continue from, for at most `warm_markov_epochs` and `warm_epochs`;
            it is not changed.
        hold_out: pairs of the same segments to evaluate on; by default a fraction of `dataset` is held out.
        reference: segments over which rewards are normalised (`RewardModel.normalised`); default: the dataset's own.
        progress: called after every epoch.
        stop: called before every step; true ends the training with the best weights so far.

    Returns:
        The model and its metrics: `loss` and `accuracy` on the first 500 training pairs; `holdout_loss`,
        `holdout_accuracy` and `ece` on the hold-out; `epochs`, `seconds`, `labels`, `holdout_labels`,
        `holdout_reliable` (1 if the hold-out was large enough to compare weights by, else 0) and `stopped` (1 if
        `stop` ended the training). Undefined metrics, such as the accuracy over ties alone, are left out.

    Raises:
        NotEnoughPairs: with fewer than two pairs.
        ModelMismatch: if the dimensions of dataset, config and `initial` differ.
    """
    check_fit(config, dataset.segments)
    if initial is not None and initial.config != config:
        raise ModelMismatch("settings of the initial model", config, initial.config)
    started = time.perf_counter()
    device = resolve_device(train_config.device)
    segments = segment_reader(dataset.segments, device)
    if hold_out is None:
        dataset, hold_out = dataset.split(train_config.hold_out_fraction, train_config.seed)
    train, held_out = PairTensors.of(dataset, device), PairTensors.of(hold_out, device)
    warm, reliable = initial is not None, is_reliable(len(held_out))
    schedule = plan_schedule(train_config, config, len(train), warm=warm, reliable=reliable)
    with seeded(train_config.seed, device):
        model = (build_reward_model(config) if initial is None else copy.deepcopy(initial)).to(device)
        sample = segments.take(evenly_spaced_sample(segments))
        model.fit_normalisers(*sample.inputs, keep_function=warm)
        trainer = RewardTrainer(
            model,
            train,
            held_out,
            seed=train_config.seed,
            max_epochs=schedule.max_epochs,
            progress=progress,
            stop=stop,
        )
        used = torch.as_tensor(np.unique(np.concatenate((dataset.pairs, hold_out.pairs))), device=device)
        dtype = resolve_precision(train_config.precision, config.hidden_dim, device)
        _run_stages(trainer, model, segments, schedule, used=used, dtype=dtype)
    scaled = segments if reference is None else segment_reader(reference, device)
    rewards = step_rewards(model, scaled, evenly_spaced_sample(scaled))
    mean = float(rewards.mean()) if train_config.subtract_mean else 0.0
    model.set_reward_scale(mean, float(rewards.std()))
    scorer = network_scorer(segments)
    on_train, on_hold_out = (
        evaluate_logits(pairs.logits(model, scorer), pairs.labels, train_config.label_noise)
        for pairs in (train.first(MAX_EVALUATED_PAIRS), held_out)
    )
    metrics = {
        "loss": on_train.loss,
        "accuracy": on_train.accuracy,
        "holdout_loss": on_hold_out.loss,
        "holdout_accuracy": on_hold_out.accuracy,
        "ece": on_hold_out.calibration_error,
        "epochs": float(len(trainer.history)),
        "labels": float(len(train) + len(held_out)),
        "holdout_labels": float(len(held_out)),
        "holdout_reliable": float(reliable),
        "stopped": float(trainer.stopped),
        "seconds": time.perf_counter() - started,
    }
    defined = {name: value for name, value in metrics.items() if math.isfinite(value)}
    return TrainedReward(model.cpu(), defined, tuple(trainer.history))


def _run_stages(
    trainer: RewardTrainer,
    model: RewardModel,
    segments: SegmentReader,
    schedule: Schedule,
    *,
    used: Tensor,
    dtype: torch.dtype,
) -> None:
    """Train the stages of `schedule`; `used` and `dtype` as in `markov_scorer` and `network_scorer`."""
    model.eval()
    markov_start, network_start = (start_weights(stage, model) for stage in (schedule.markov, schedule.network))
    if schedule.markov is not None and model.markov is not None:
        scorer = markov_scorer(model, segments, used)
        trainer.run(Stage(schedule.markov, list(model.markov.parameters()), scorer, start=markov_start))
    if schedule.network is not None and not trainer.stopped:
        trainer.run(
            Stage(
                schedule.network,
                list(model.parameters()),
                network_scorer(segments, dtype),
                start=trainer.early_weights if network_start is None else network_start,
                pairs_per_pass=_pairs_per_pass(model, segments),
            )
        )


def _pairs_per_pass(model: RewardModel, segments: SegmentReader) -> int | None:
    if segments.device.type != "cpu":
        return None
    activations_per_pair = 2 * model.config.n_agents * segments.n_steps * model.config.hidden_dim
    return max(1, ACTIVATIONS_PER_PASS // activations_per_pair)


def adamw(parameters: Sequence[nn.Parameter], settings: StageSettings) -> torch.optim.AdamW:
    """The optimiser of a stage. Weight decay applies to matrices, not to biases and norms."""
    matrices = [parameter for parameter in parameters if parameter.dim() >= 2]
    vectors = [parameter for parameter in parameters if parameter.dim() < 2]
    return torch.optim.AdamW(
        [{"params": matrices, "weight_decay": settings.weight_decay}, {"params": vectors, "weight_decay": 0.0}],
        lr=settings.lr,
        fused=True,
    )


def weight_average(model: nn.Module) -> AveragedModel:
    """A copy of `model` whose weights follow it as a running average; its decay grows to `AVERAGE_DECAY`."""

    def update(averages: Sequence[Tensor], weights: Sequence[Tensor], n_averaged: Tensor | int) -> None:
        # The first steps move the average faster, so that it forgets the initial weights.
        rate = max(1 - AVERAGE_DECAY, 9 / (9 + int(n_averaged)))
        for mean, weight in zip(averages, weights, strict=True):
            mean.lerp_(weight, rate)

    average = AveragedModel(model, multi_avg_fn=update)
    # The first update copies the weights.
    average.update_parameters(model)
    return average.eval()


def split_batches(order: Tensor, batch_pairs: int) -> tuple[Tensor, ...]:
    """Indices (P,) of one epoch's pairs in batches (B,) of at most `batch_pairs`, of nearly equal size."""
    size = min(batch_pairs, max(MIN_BATCH_PAIRS, len(order) // MIN_STEPS_PER_EPOCH))
    return order.tensor_split(math.ceil(len(order) / size))
