"""Train a reward model on labelled pairs: first its Markov path, then the whole network."""

import copy
import math
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

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
    markov_scorer,
    segment_reader,
    spread_sample,
    step_rewards,
    whole_scorer,
)
from mapt.rewards.kernels import resolve_precision
from mapt.rewards.metrics import accuracy, calibration_error
from mapt.rewards.model import RewardModel
from mapt.rewards.registry import build_reward_model
from mapt.rewards.schedule import Stages, StageSettings, plan_stages, state_to_begin_with

# Below this many held-out pairs, their loss says too little to choose weights by.
FEWEST_HOLD_OUT_PAIRS = 10
# A small dataset still gets about this many steps an epoch, as long as a batch keeps FEWEST_BATCH_PAIRS.
FEWEST_STEPS_PER_EPOCH = 8
FEWEST_BATCH_PAIRS = 8
GRADIENT_NORM_LIMIT = 1.0
# The weights that are judged and kept are an average of about the last hundred steps. On 2,000 labels of a teacher who
# goes by the worst second, that took a transformer from 0.726 to 0.764 of fresh pairs, and a Markov model from 0.692 to
# 0.702: single steps on a few noisy pairs jump about more than they still learn.
AVERAGE_DECAY = 0.99


@dataclass(frozen=True, slots=True)
class TrainProgress:
    """Where a training stands after an epoch."""

    #: from 1, over all stages
    epoch: int
    #: the most there can be
    max_epochs: int
    #: mean over the epoch's steps, nats
    loss: float
    holdout_loss: float
    holdout_accuracy: float
    seconds: float


@dataclass(frozen=True, slots=True)
class Stage:
    """What one run of the loop trains."""

    settings: StageSettings
    parameters: Sequence[nn.Parameter]
    scorer: Scorer
    #: weights to begin with, in place of the model's own
    start: dict[str, Tensor] | None = None
    #: pairs of a batch whose activations are held at once; None for all
    pairs_per_pass: int | None = None


class Fitting:
    """Trains one model, stage by stage; it ends each with the weights that judged best, those it began with included.

    Args:
        progress: called after every epoch.
        stop: asked before every step; true ends this stage and all that follow.
    """

    def __init__(
        self,
        model: nn.Module,
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
        self._average = WeightAverage([])
        self._max_epochs = max_epochs
        self._progress, self._stop = progress, stop
        self._started = time.perf_counter()
        self.history: list[TrainProgress] = []
        self.stopped = False
        #: the weights that judged best up to `remember_epoch` of the last stage that has one
        self.early: dict[str, Tensor] | None = None

    @property
    def reliable(self) -> bool:
        """Whether the hold-out is large enough to judge by."""
        return is_reliable(self._hold_out)

    def run(self, stage: Stage) -> None:
        """Train `stage.parameters`, and leave the model in evaluation mode."""
        # A hold-out too small to judge by leaves that to the training pairs.
        judge = self._hold_out if self.reliable else self._train
        noise = stage.settings.label_noise
        self._model.eval()
        before = preference_losses(judge.logits(stage.scorer), judge.labels, noise)
        initial = kept = self._weights()
        # A stage that begins elsewhere is measured by its own progress; at its end it must beat where it did not begin.
        best = before.mean().item() if stage.start is None else math.inf
        kept_at, after, begun = 0, before, torch.tensor(False)
        if stage.start is not None:
            self._model.load_state_dict(stage.start)
        optimiser, self._average = adamw(stage.parameters, stage.settings), WeightAverage(stage.parameters)
        for epoch in range(1, stage.settings.max_epochs + 1):
            loss = self._epoch(stage, optimiser)
            if self.stopped:
                break
            with self._average.in_place():
                logits = judge.logits(stage.scorer)
                held_out = logits if self.reliable else self._hold_out.logits(stage.scorer)
                self._report(loss, held_out, noise)
                judged = preference_losses(logits, judge.labels, noise)
                if judged.mean().item() < best:
                    best, kept, kept_at, after = judged.mean().item(), self._weights(), epoch, judged
                if epoch == stage.settings.remember_epoch:
                    self.early = kept
            begun = begun | beats_guessing(judged)
            if is_out_of_patience(stage.settings, torch.tensor(epoch - kept_at), begun):
                break
        gained = bool(is_kept(stage.settings, before, after))
        self._model.load_state_dict(kept if gained else initial)
        self._model.eval()

    def _epoch(self, stage: Stage, optimiser: torch.optim.Optimizer) -> float:
        """Mean loss of one pass over the training pairs; NaN when stopped."""
        losses: list[Tensor] = []
        self._model.train()
        order = torch.randperm(len(self._train), generator=self._shuffle)
        for index in epoch_batches(order, stage.settings.batch_pairs):
            self.stopped = self.stopped or (self._stop is not None and self._stop())
            if self.stopped:
                return math.nan
            losses.append(self._step(stage, optimiser, index))
        self._model.eval()
        return torch.stack(losses).mean().item()

    def _step(self, stage: Stage, optimiser: torch.optim.Optimizer, index: Tensor) -> Tensor:
        optimiser.zero_grad(set_to_none=True)
        loss = torch.zeros((), device=self._train.labels.device)
        for part in index.split(stage.pairs_per_pass or len(index)):
            score_0, score_1 = self._train.scores(stage.scorer, part)
            label = self._train.labels[part]
            share = preference_loss(score_0, score_1, label, stage.settings.label_noise) * (len(part) / len(index))
            share.backward()
            loss += share.detach()
        nn.utils.clip_grad_norm_(stage.parameters, GRADIENT_NORM_LIMIT)
        optimiser.step()
        self._average.follow()
        return loss

    def _report(self, loss: float, hold_out_logits: Tensor, label_noise: float) -> None:
        held_out = judge_logits(hold_out_logits, self._hold_out.labels, label_noise)
        seconds = time.perf_counter() - self._started
        self.history.append(
            TrainProgress(len(self.history) + 1, self._max_epochs, loss, held_out.loss, held_out.accuracy, seconds)
        )
        if self._progress is not None:
            self._progress(self.history[-1])

    def _weights(self) -> dict[str, Tensor]:
        return copy.deepcopy(self._model.state_dict())


class WeightAverage:
    """A running average of parameters that an optimiser moves (Polyak and Juditsky, 1992), youngest steps first."""

    def __init__(self, parameters: Sequence[nn.Parameter]) -> None:
        self._parameters = list(parameters)
        self._averages = [parameter.detach().clone() for parameter in parameters]
        self._n_steps = 0

    @torch.no_grad()
    def follow(self) -> None:
        """Take in the parameters as they are now."""
        self._n_steps += 1
        # The first steps leave the beginning behind faster than the last ones leave each other.
        share = max(1 - AVERAGE_DECAY, 9 / (9 + self._n_steps))
        for average, parameter in zip(self._averages, self._parameters, strict=True):
            average.lerp_(parameter, share)

    @contextmanager
    def in_place(self) -> Iterator[None]:
        """The average takes the parameters' place for a while."""
        moved = [parameter.detach().clone() for parameter in self._parameters]
        self._write(self._averages)
        yield
        self._write(moved)

    @torch.no_grad()
    def _write(self, values: Sequence[Tensor]) -> None:
        for parameter, value in zip(self._parameters, values, strict=True):
            parameter.copy_(value)


def is_reliable(hold_out: PairTensors) -> bool:
    """Whether a hold-out is large enough to judge by."""
    return len(hold_out) >= FEWEST_HOLD_OUT_PAIRS


@dataclass(frozen=True, slots=True)
class Judgement:
    """How well a scorer explains some pairs; NaN where there is nothing to measure."""

    #: nats
    loss: float
    #: over decided pairs
    accuracy: float
    calibration_error: float


def is_kept(settings: StageSettings, before: Tensor, after: Tensor) -> Tensor:
    """Whether what a stage learned takes the place of what it found, by the losses (..., P) of both; bool (...)."""
    if settings.must_convince:
        return exceeds_chance(before - after)
    # What began elsewhere may be a little worse on pairs that the earlier weights were trained on; not worthless.
    return after.mean(dim=-1) <= before.mean(dim=-1).clamp(min=math.log(2))


def beats_guessing(losses: Tensor) -> Tensor:
    """Whether pairs with these losses (..., P) are told better than by a coin, beyond chance; bool (...)."""
    return exceeds_chance(math.log(2) - losses)


def is_out_of_patience(settings: StageSettings, waited: Tensor, begun: Tensor) -> Tensor:
    """Whether a stage ends; bool (...).

    Args:
        waited: epochs since the best judgement, (...).
        begun: whether it has ever told pairs better than guessing does, bool (...).
    """
    return waited >= torch.where(begun, settings.patience, max(settings.patience, settings.first_patience))


def exceeds_chance(gains: Tensor) -> Tensor:
    """Whether the mean of `gains` (..., P) is more than two standard errors above 0; bool (...).

    The best of several epochs on a hundred pairs beats its start by luck alone more often than not.
    """
    return gains.mean(dim=-1) > 2 * gains.std(dim=-1) / math.sqrt(gains.shape[-1])


def judge_pairs(pairs: PairTensors, scorer: Scorer, label_noise: float = 0.0) -> Judgement:
    """Measure `scorer` on `pairs`."""
    if not len(pairs):
        return Judgement(math.nan, math.nan, math.nan)
    return judge_logits(pairs.logits(scorer), pairs.labels, label_noise)


def judge_logits(logits: Tensor, labels: Tensor, label_noise: float = 0.0) -> Judgement:
    """Measure logits (P,) against labels (P,)."""
    if not len(labels):
        return Judgement(math.nan, math.nan, math.nan)
    probabilities, known = logits.sigmoid().cpu().numpy(), labels.cpu().numpy()
    return Judgement(
        preference_losses(logits, labels, label_noise).mean().item(),
        accuracy(probabilities, known),
        calibration_error(probabilities, known),
    )


def adamw(parameters: Iterable[nn.Parameter], settings: StageSettings, *, matrix_dims: int = 2) -> torch.optim.AdamW:
    """The optimiser of a stage.

    Args:
        matrix_dims: dimensions from which a parameter is a matrix; one more for stacked ones.
    """
    # Biases and norms are not shrunk: their size says nothing about how complex the function is.
    moved = list(parameters)
    matrices = [parameter for parameter in moved if parameter.dim() >= matrix_dims]
    vectors = [parameter for parameter in moved if parameter.dim() < matrix_dims]
    return torch.optim.AdamW(
        [{"params": matrices, "weight_decay": settings.weight_decay}, {"params": vectors, "weight_decay": 0.0}],
        lr=settings.lr,
        # One pass over all parameters instead of a dozen per tensor.
        fused=True,
    )


def epoch_batches(order: Tensor, batch_pairs: int) -> tuple[Tensor, ...]:
    """Indices (..., P) of pairs in batches (..., B) of one epoch, of `batch_pairs` at most."""
    n_pairs = order.shape[-1]
    size = min(batch_pairs, max(FEWEST_BATCH_PAIRS, n_pairs // FEWEST_STEPS_PER_EPOCH))
    # Equal parts: a last batch of one or two pairs would be a step of mere noise.
    return order.tensor_split(math.ceil(n_pairs / size), dim=-1)


# Training pairs of which loss and accuracy are told.
MOST_PAIRS_JUDGED = 500
# Agents' steps times d in one pass on a CPU. Activations of a whole batch at d = 256 would come from fresh pages of
# memory each time, which took more than half of the time: 3.5 pairs/s in one pass, 8.0 in small ones.
NUMBERS_PER_PASS = 1 << 20


@dataclass(frozen=True, slots=True)
class TrainedReward:
    """A trained model, in evaluation mode on the CPU, and how its training went."""

    model: RewardModel
    #: see `train_reward_model`
    metrics: dict[str, float]
    history: tuple[TrainProgress, ...]


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
    """Train the model of `config` on labelled pairs; the same arguments give the same model on the same machine.

    Args:
        dataset: at least two labelled pairs. Segments on disk stay there when they are many: the memory is
            then that of a batch.
        config: the network; its dimensions must be the dataset's.
        initial: a model of the same `config` to go on from, for `warm_markov_epochs` and `warm_epochs` at most;
            it is left as it is.
        hold_out: pairs of the same segments to evaluate on; by default a fraction of `dataset` is held out.
        reference: segments over which rewards are normalised to mean 0 and deviation 1; the dataset's own
            when not given.
        progress: called after every epoch.
        stop: asked before every step; true ends the training with the best weights so far.

    Returns:
        The model and its metrics: `loss` and `accuracy` on the training pairs (the first 500), `holdout_loss`,
        `holdout_accuracy`, `ece` (of the hold-out), `epochs`, `seconds`, `labels`, `holdout_labels`,
        `holdout_reliable` (1 when the hold-out was large enough to choose weights by, else 0), `stopped` (1
        when `stop` ended it). A number that cannot be measured, such as the accuracy over ties alone, is
        left out.

    Raises:
        NotEnoughPairs: with fewer than two pairs.
        ModelMismatch: if dataset, config and `initial` do not fit each other.
    """
    check_fit(config, dataset.segments)
    if initial is not None and initial.config != config:
        raise ModelMismatch("settings of the initial model", config, initial.config)
    started = time.perf_counter()
    device = resolve_device(train_config.device)
    segments = segment_reader(dataset.segments, device)
    train, held_out = dataset, hold_out
    if held_out is None:
        train, held_out = dataset.split(train_config.hold_out_fraction, train_config.seed)
    train_pairs, held_out_pairs = PairTensors.of(train, device), PairTensors.of(held_out, device)
    with seeded(train_config.seed, device):
        model = (build_reward_model(config) if initial is None else copy.deepcopy(initial)).to(device)
        sample = segments.take(spread_sample(segments))
        model.measure_inputs(*sample.inputs, keep_function=initial is not None)
        stages = plan_stages(
            train_config, config, len(train), warm=initial is not None, reliable=is_reliable(held_out_pairs)
        )
        fitting = Fitting(
            model,
            train_pairs,
            held_out_pairs,
            seed=train_config.seed,
            max_epochs=stages.max_epochs,
            progress=progress,
            stop=stop,
        )
        products = resolve_precision(train_config.precision, config.hidden_dim, device)
        used = torch.as_tensor(np.unique(np.concatenate((train.pairs, held_out.pairs))), device=device)
        _run_stages(fitting, model, segments, stages, used=used, products=products)
    judged = segments if reference is None else segment_reader(reference, device)
    rewards = step_rewards(model, judged, spread_sample(judged))
    model.set_reward_scale(float(rewards.mean()), float(rewards.std()))
    scorer, noise = whole_scorer(model, segments), train_config.label_noise
    learned = judge_pairs(train_pairs.first(MOST_PAIRS_JUDGED), scorer, noise)
    judged_hold_out = judge_pairs(held_out_pairs, scorer, noise)
    metrics = {
        "loss": learned.loss,
        "accuracy": learned.accuracy,
        "holdout_loss": judged_hold_out.loss,
        "holdout_accuracy": judged_hold_out.accuracy,
        "ece": judged_hold_out.calibration_error,
        "epochs": float(len(fitting.history)),
        "labels": float(len(train) + len(held_out)),
        "holdout_labels": float(len(held_out)),
        "holdout_reliable": float(fitting.reliable),
        "stopped": float(fitting.stopped),
        "seconds": time.perf_counter() - started,
    }
    measured = {name: value for name, value in metrics.items() if math.isfinite(value)}
    return TrainedReward(model.cpu(), measured, tuple(fitting.history))


def _run_stages(
    fitting: Fitting,
    model: RewardModel,
    segments: SegmentReader,
    stages: Stages,
    *,
    used: Tensor,
    products: torch.dtype,
) -> None:
    model.eval()
    first, second = (state_to_begin_with(stage, model) for stage in (stages.markov, stages.whole))
    if stages.markov is not None and model.markov is not None:
        parameters = list(model.markov.parameters())
        fitting.run(Stage(stages.markov, parameters, markov_scorer(model, segments, used), start=first))
    if stages.whole is not None and not fitting.stopped:
        scorer = whole_scorer(model, segments, products)
        parameters = list(model.parameters())
        passes = _pairs_per_pass(model, segments)
        start = fitting.early if second is None else second
        fitting.run(Stage(stages.whole, parameters, scorer, start=start, pairs_per_pass=passes))


def _pairs_per_pass(model: RewardModel, segments: SegmentReader) -> int | None:
    if segments.device.type != "cpu":
        return None
    numbers_of_a_pair = 2 * model.config.n_agents * segments.n_steps * model.config.hidden_dim
    return max(1, NUMBERS_PER_PASS // numbers_of_a_pair)
