"""Fit a reward network to labelled pairs.

One training step, from top to bottom: draw pairs, score both segments of all of them in one pass, take the
Bradley-Terry loss, step AdamW. After every epoch the hold-out decides which weights to keep and when to stop.
"""

import copy
import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from mapt.preferences.dataset import PreferenceDataset, SegmentArrays
from mapt.preferences.loss import preference_loss
from mapt.rewards.config import RewardConfig, TrainConfig
from mapt.rewards.device import resolve_device
from mapt.rewards.errors import ModelMismatch
from mapt.rewards.metrics import accuracy, calibration_error
from mapt.rewards.network import MAPT
from mapt.rewards.pair_tensors import PairTensors, SegmentTensors, step_rewards

# Below this many held-out pairs, their loss says too little to choose weights by.
FEWEST_HOLD_OUT_PAIRS = 10
# A small dataset still gets about this many steps an epoch, as long as a batch keeps FEWEST_BATCH_PAIRS.
FEWEST_STEPS_PER_EPOCH = 8
FEWEST_BATCH_PAIRS = 8
GRADIENT_NORM_LIMIT = 1.0


@dataclass(frozen=True, slots=True)
class TrainProgress:
    """Where a training stands after an epoch."""

    #: from 1
    epoch: int
    max_epochs: int
    #: mean over the epoch's steps, nats
    loss: float
    holdout_loss: float
    holdout_accuracy: float
    seconds: float


@dataclass(frozen=True, slots=True)
class TrainedReward:
    """A trained model, in evaluation mode on the CPU, and how its training went."""

    model: MAPT
    #: see `train_reward_model`
    metrics: dict[str, float]
    history: tuple[TrainProgress, ...]


def train_reward_model(
    dataset: PreferenceDataset,
    config: RewardConfig,
    train_config: TrainConfig,
    *,
    initial: MAPT | None = None,
    reference: SegmentArrays | None = None,
    progress: Callable[[TrainProgress], None] | None = None,
    stop: Callable[[], bool] | None = None,
) -> TrainedReward:
    """Train MAPT on labelled pairs; the same arguments give the same model on the same machine.

    Args:
        dataset: at least two labelled pairs.
        config: the network; its dimensions must be the dataset's.
        initial: a model of the same `config` to go on from; it is left as it is.
        reference: segments over which rewards are normalised to mean 0 and deviation 1; the dataset's own
            when not given.
        progress: called after every epoch.
        stop: asked before every step; true ends the training with the best weights so far.

    Returns:
        The model and its metrics: `loss` and `accuracy` on the training pairs, `holdout_loss`,
        `holdout_accuracy`, `ece` (of the hold-out), `epochs`, `seconds`, `labels`, `holdout_labels`,
        `holdout_reliable` (1 when the hold-out was large enough to choose weights by, else 0), `stopped` (1
        when `stop` ended it). A number that cannot be measured, such as the accuracy over ties alone, is
        left out.

    Raises:
        NotEnoughPairs: with fewer than two pairs.
        ModelMismatch: if dataset, config and `initial` do not fit each other.
    """
    _check_fit(dataset, config, initial)
    started = time.perf_counter()
    device = resolve_device(train_config.device)
    segments = SegmentTensors.of(dataset.segments, device)
    train, hold_out = (
        PairTensors.of(part, segments) for part in dataset.split(train_config.hold_out_fraction, train_config.seed)
    )
    # Initial weights and dropout draw from torch's global generators: seeded here, and given back as they were.
    with torch.random.fork_rng(devices=[device] if device.type == "cuda" else []):
        torch.manual_seed(train_config.seed)
        model = (MAPT(config) if initial is None else copy.deepcopy(initial)).to(device)
        model.measure_inputs(segments.observations, segments.actions, segments.mask, keep_function=initial is not None)
        history, stopped = _fit(model, train, hold_out, train_config, started=started, progress=progress, stop=stop)
    model.eval()
    rewards = step_rewards(model, segments if reference is None else SegmentTensors.of(reference, device))
    model.set_reward_scale(float(rewards.mean()), float(rewards.std()))
    metrics = {
        **_measure(model, train, "", with_ece=False),
        **_measure(model, hold_out, "holdout_", with_ece=True),
        "epochs": float(len(history)),
        "labels": float(len(dataset)),
        "holdout_labels": float(len(hold_out)),
        "holdout_reliable": float(len(hold_out) >= FEWEST_HOLD_OUT_PAIRS),
        "stopped": float(stopped),
        "seconds": time.perf_counter() - started,
    }
    metrics = {name: value for name, value in metrics.items() if math.isfinite(value)}
    return TrainedReward(model.cpu(), metrics, tuple(history))


def _fit(
    model: MAPT,
    train: PairTensors,
    hold_out: PairTensors,
    config: TrainConfig,
    *,
    started: float,
    progress: Callable[[TrainProgress], None] | None,
    stop: Callable[[], bool] | None,
) -> tuple[list[TrainProgress], bool]:
    """Train `model` in place; it ends with the weights of its best epoch."""
    optimiser = _optimiser(model, config)
    shuffle = torch.Generator().manual_seed(config.seed)
    best_loss, best_weights, best_epoch = math.inf, copy.deepcopy(model.state_dict()), 0
    history: list[TrainProgress] = []
    stopped = False
    for epoch in range(1, config.max_epochs + 1):
        losses: list[float] = []
        model.train()
        for index in _batches(len(train), config.batch_pairs, shuffle):
            stopped = stop is not None and stop()
            if stopped:
                break
            losses.append(_step(model, optimiser, train, index))
        if stopped:
            break
        model.eval()
        measured = _measure(model, hold_out, "", with_ece=False)
        loss = sum(losses) / len(losses)
        history.append(
            TrainProgress(
                epoch,
                config.max_epochs,
                loss,
                measured["loss"],
                measured["accuracy"],
                time.perf_counter() - started,
            )
        )
        if progress is not None:
            progress(history[-1])
        # A hold-out too small to judge by leaves the training loss to say when to stop.
        judged = measured["loss"] if len(hold_out) >= FEWEST_HOLD_OUT_PAIRS else loss
        if judged < best_loss:
            best_loss, best_weights, best_epoch = judged, copy.deepcopy(model.state_dict()), epoch
        elif epoch - best_epoch >= config.patience:
            break
    model.load_state_dict(best_weights)
    return history, stopped


def _step(model: MAPT, optimiser: torch.optim.Optimizer, train: PairTensors, index: Tensor) -> float:
    score_0, score_1 = train.scores(model, index)
    loss = preference_loss(score_0, score_1, train.labels[index])
    optimiser.zero_grad(set_to_none=True)
    loss.backward()
    torch.nn.utils.clip_grad_norm_(model.parameters(), GRADIENT_NORM_LIMIT)
    optimiser.step()
    return loss.item()


def _optimiser(model: MAPT, config: TrainConfig) -> torch.optim.Optimizer:
    # Biases and norms are not shrunk: their size says nothing about how complex the function is.
    matrices = [parameter for parameter in model.parameters() if parameter.dim() >= 2]
    vectors = [parameter for parameter in model.parameters() if parameter.dim() < 2]
    return torch.optim.AdamW(
        [{"params": matrices}, {"params": vectors, "weight_decay": 0.0}],
        lr=config.lr,
        weight_decay=config.weight_decay,
    )


def _batches(n_pairs: int, batch_pairs: int, shuffle: torch.Generator) -> Iterator[Tensor]:
    size = min(batch_pairs, max(FEWEST_BATCH_PAIRS, n_pairs // FEWEST_STEPS_PER_EPOCH))
    # Equal parts: a last batch of one or two pairs would be a step of mere noise.
    n_batches = math.ceil(n_pairs / size)
    yield from torch.randperm(n_pairs, generator=shuffle).tensor_split(n_batches)


def _measure(model: MAPT, pairs: PairTensors, prefix: str, *, with_ece: bool) -> dict[str, float]:
    """Loss, accuracy and calibration; NaN where there is nothing to measure."""
    logits = pairs.logits(model)
    probabilities, labels = logits.sigmoid().cpu().numpy(), pairs.labels.cpu().numpy()
    measured = {
        f"{prefix}loss": F.binary_cross_entropy_with_logits(logits, pairs.labels).item(),
        f"{prefix}accuracy": accuracy(probabilities, labels),
    }
    return measured | {"ece": calibration_error(probabilities, labels)} if with_ece else measured


def _check_fit(dataset: PreferenceDataset, config: RewardConfig, initial: MAPT | None) -> None:
    segments = dataset.segments
    expected = (config.n_agents, config.observation_dim, config.action_dim)
    found = (segments.n_agents, segments.observation_dim, segments.action_dim)
    if found != expected:
        raise ModelMismatch("agents, observation and action dimension", expected, found)
    if initial is not None and initial.config != config:
        raise ModelMismatch("settings of the initial model", config, initial.config)
