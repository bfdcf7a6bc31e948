"""Train a reward model on labelled pairs: first its Markov path, then the whole network."""

import copy
import math
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from mapt.preferences.dataset import PreferenceDataset, SegmentSource
from mapt.rewards.base import RewardModel
from mapt.rewards.config import RewardConfig
from mapt.rewards.device import resolve_device, seeded
from mapt.rewards.errors import ModelMismatch
from mapt.rewards.fitting import Fitting, Stage, TrainProgress, is_reliable, judge_pairs
from mapt.rewards.model import build_reward_model
from mapt.rewards.pair_tensors import PairTensors, markov_scorer, step_rewards, whole_scorer
from mapt.rewards.precision import resolve_precision
from mapt.rewards.segment_reader import SegmentReader, check_fit, segment_reader, spread_sample
from mapt.rewards.stages import Stages, plan_stages, state_to_begin_with
from mapt.rewards.train_config import TrainConfig

__all__ = ["TrainProgress", "TrainedReward", "train_reward_model"]

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
    train, hold_out = (
        PairTensors.of(part, device) for part in dataset.split(train_config.hold_out_fraction, train_config.seed)
    )
    with seeded(train_config.seed, device):
        model = (build_reward_model(config) if initial is None else copy.deepcopy(initial)).to(device)
        sample = segments.take(spread_sample(segments))
        model.measure_inputs(*sample.inputs, keep_function=initial is not None)
        stages = plan_stages(train_config, config, len(train), warm=initial is not None, reliable=is_reliable(hold_out))
        fitting = Fitting(
            model,
            train,
            hold_out,
            seed=train_config.seed,
            max_epochs=stages.max_epochs,
            progress=progress,
            stop=stop,
        )
        products = resolve_precision(train_config.precision, config.hidden_dim, device)
        used = torch.as_tensor(np.unique(dataset.pairs), device=device)
        _run_stages(fitting, model, segments, stages, used=used, products=products)
    judged = segments if reference is None else segment_reader(reference, device)
    rewards = step_rewards(model, judged, spread_sample(judged))
    model.set_reward_scale(float(rewards.mean()), float(rewards.std()))
    scorer, noise = whole_scorer(model, segments), train_config.label_noise
    learned = judge_pairs(train.first(MOST_PAIRS_JUDGED), scorer, noise)
    held_out = judge_pairs(hold_out, scorer, noise)
    metrics = {
        "loss": learned.loss,
        "accuracy": learned.accuracy,
        "holdout_loss": held_out.loss,
        "holdout_accuracy": held_out.accuracy,
        "ece": held_out.calibration_error,
        "epochs": float(len(fitting.history)),
        "labels": float(len(dataset)),
        "holdout_labels": float(len(hold_out)),
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
