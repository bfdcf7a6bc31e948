"""Measure a trained reward model on recorded segments: agreement with the true reward, calibration, attention."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from mapt.benchmarks.evaluate import (
    DatasetTeacher,
    IntArray,
    preference_metrics,
    random_pairs,
    reward_metrics,
    split_dataset,
)
from mapt.benchmarks.job import count_parameters
from mapt.benchmarks.recorded_dataset import RecordedDataset, episodes_path
from mapt.preferences.dataset import SegmentArrays
from mapt.rewards.data import EVALUATION_SEGMENTS
from mapt.rewards.inspection import AttentionMaps, Predictions, attention_maps, predict
from mapt.rewards.metrics import CalibrationBin, calibration_bins, rank_correlation
from mapt.rewards.model import RewardModel
from mapt.rewards.relabelling import RolloutRelabeller

#: State-action pairs of the paper's figures 2 and 4.
STATE_ACTIONS = 100_000
#: Segments whose attention is drawn, by the fraction of segments with a smaller return.
SHOWN_RANKS = (0.1, 0.5, 0.95)
#: Segments over which the attention between agents is averaged.
_AVERAGED_SEGMENTS = 100
#: Maximum number of steps of an episode that are drawn; more would not be distinguishable.
_MAX_STEPS = 300
#: Segments drawn if no episode was recorded, as fractions of the dataset in the order of recording.
_POSITIONS = (0.02, 0.25, 0.5, 0.75, 0.98)


@dataclass(frozen=True, slots=True)
class Sample:
    """The segments and pairs on which models are measured, the same for each model."""

    #: positions in the dataset, ascending, int64 (S,)
    indices: IntArray
    segments: SegmentArrays
    #: true rewards, float64 (S, T)
    rewards: NDArray[np.float64]
    #: positions in `indices`, int64 (P, 2)
    pairs: IntArray
    #: the teacher's labels, float32 (P,); NaN where it skips
    labels: NDArray[np.float32]
    #: the teacher's scores of the segments, (S,)
    teacher_scores: NDArray[np.float64]
    #: positions of the segments whose attention is drawn
    shown: IntArray

    @property
    def mask(self) -> NDArray[np.bool_]:
        """bool (S, T)."""
        return self.segments.mask

    @property
    def returns(self) -> NDArray[np.float64]:
        """True returns, (S,)."""
        return self.rewards.sum(axis=1)


def draw_sample(dataset: RecordedDataset, teacher: str, n_pairs: int, held_out_seed: int | None) -> Sample:
    """Draw segments with about `STATE_ACTIONS` state-action pairs, or all of them.

    Args:
        teacher: see `DatasetTeacher`.
        held_out_seed: draw only from the segments that are held out for this seed; None draws from all.
    """
    pool = np.arange(len(dataset)) if held_out_seed is None else split_dataset(len(dataset), held_out_seed).test
    rng = np.random.default_rng(0)
    n_segments = min(len(pool), math.ceil(STATE_ACTIONS / dataset.source.n_steps))
    indices = np.sort(rng.choice(pool, n_segments, replace=False))
    pairs = random_pairs(np.arange(n_segments), n_pairs, rng)
    judge = DatasetTeacher(teacher, dataset, 0)
    scores = judge.scores(indices)
    order = np.argsort(dataset.returns[indices], kind="stable")
    shown = order[[round(rank * (n_segments - 1)) for rank in SHOWN_RANKS]]
    labels, rewards = judge.labels(indices[pairs]), dataset.rewards[indices]
    return Sample(indices, dataset.segments(indices), rewards, pairs, labels, scores, shown)


@dataclass(frozen=True, slots=True)
class RewardAnalysis:
    """Measurements of one model on a sample."""

    name: str
    #: settings of the network
    network: Mapping[str, object]
    metrics: Mapping[str, float]
    predictions: Predictions
    calibration: tuple[CalibrationBin, ...]
    #: of the sample's `shown` segments
    attention: AttentionMaps
    #: attention between agents, mean over steps and segments, (N, N)
    agent_attention: NDArray[np.float32] | None


def analyse(name: str, model: RewardModel, sample: Sample) -> RewardAnalysis:
    """Measure `model` on the CPU.

    Besides those of `preference_metrics` and `reward_metrics`, the metrics are:
    `rank_correlation_teacher`: Spearman correlation of scores with the teacher's scores.
    `parameters`: number of trainable parameters.
    `spread_across_agents`: standard deviation between agents, mean over steps, divided by that of all rewards.
    `past_share`: variance of the rewards minus the Markov path's part, divided by their variance; 0 to about 1.
    `weight_concentration`: see `weight_concentration`.
    `breadth`, `true_breadth`: see `breadth`, of learned and of true rewards.
    """
    predictions = predict(model, sample.segments)
    attention = attention_maps(model, sample.segments.take(sample.shown))
    first, second = predictions.scores[sample.pairs].T
    mask, labelled = sample.mask, np.isfinite(sample.labels)
    learned = predictions.agent_rewards[mask]
    metrics = {
        **preference_metrics(first - second, sample.labels),
        "rank_correlation_teacher": rank_correlation(predictions.scores, sample.teacher_scores),
        **reward_metrics(predictions, sample.rewards, mask),
        "spread_across_agents": float(learned.std(axis=1).mean() / max(learned.std(), 1e-12)),
        "past_share": _past_share(model, sample.segments, predictions),
        "weight_concentration": weight_concentration(predictions.weights, mask),
        "breadth": breadth(predictions.rewards[mask]),
        "true_breadth": breadth(sample.rewards[mask]),
        "parameters": float(count_parameters(model)),
    }
    probabilities = 1 / (1 + np.exp(-np.clip(first - second, -60, 60)))
    calibration = calibration_bins(probabilities[labelled], sample.labels[labelled])
    finite = {key: float(value) for key, value in metrics.items() if math.isfinite(value)}
    agents = None if attention.agents is None else _agent_attention(model, sample)
    return RewardAnalysis(name, model.config.to_dict(), finite, predictions, calibration, attention, agents)


def weight_concentration(weights: NDArray[np.floating], mask: NDArray[np.bool_]) -> float:
    """1 - entropy / maximum entropy of step weights (S, T), mean over segments longer than one step.

    0 if all steps weigh the same, 1 if one step has all the weight.
    """
    real = mask & (weights > 0)
    entropy = -(np.where(real, weights, 1.0) * np.log(np.where(real, weights, 1.0))).sum(axis=1)
    n_steps = mask.sum(axis=1)
    long = n_steps > 1
    return float((1 - entropy[long] / np.log(n_steps[long])).mean()) if long.any() else math.nan


def breadth(rewards: NDArray[np.floating]) -> float:
    """Interquartile range divided by the range of the middle 99%: small if most rewards are nearly equal."""
    low, quarter, three_quarters, high = np.percentile(rewards, (0.5, 25, 75, 99.5))
    return float((three_quarters - quarter) / (high - low)) if high > low else math.nan


@torch.inference_mode()
def _past_share(model: RewardModel, segments: SegmentArrays, predictions: Predictions) -> float:
    """`past_share` of `analyse`; 1 for a model without a Markov path."""
    if any(network.markov is None for network in model.networks):
        return 1.0
    arrays = (torch.as_tensor(array) for array in (segments.observations, segments.actions))
    parts = zip(*(array.split(EVALUATION_SEGMENTS) for array in arrays), strict=True)
    markov = torch.cat([model.markov_rewards(*part) for part in parts]).numpy()[segments.mask]
    total = predictions.agent_rewards[segments.mask]
    return float((total - markov).var() / max(float(total.var()), 1e-12))


def _agent_attention(model: RewardModel, sample: Sample) -> NDArray[np.float32]:
    """Mean over at most `_AVERAGED_SEGMENTS` segments, evenly spaced over the sample."""
    chosen = np.unique(np.linspace(0, len(sample.indices) - 1, _AVERAGED_SEGMENTS).astype(np.int64))
    segments = sample.segments.take(chosen)
    agents = attention_maps(model, segments).agents
    assert agents is not None
    return agents[segments.mask].mean(axis=0)


@dataclass(frozen=True, slots=True)
class RolloutSeries:
    """Learned and true team rewards along consecutive steps."""

    title: str
    #: first steps of the segments after the first one
    breaks: tuple[int, ...]
    #: (L,)
    true: NDArray[np.float64]
    #: (L,) by model
    learned: dict[str, NDArray[np.floating]]


def rollout_series(dataset: RecordedDataset, models: dict[str, RewardModel]) -> RolloutSeries:
    """Team rewards as a policy receives them: along a recorded episode, or along a few segments if there is none."""
    path = episodes_path(dataset.path)
    if path.exists():
        return episode_series(RecordedDataset.open(path), dataset.source.n_steps, models, "the trained policy")
    return _segments(dataset, models)


def episode_series(
    episodes: RecordedDataset, segment_steps: int, models: dict[str, RewardModel], policy: str
) -> RolloutSeries:
    """Team rewards along the first of the recorded episodes.

    Args:
        segment_steps: T, the window of the relabelling.
        policy: describes the policy, for the title.
    """
    steps = slice(0, min(_MAX_STEPS, int(episodes.mask[0].sum())))
    played = episodes.segments([0])
    observations, actions = (array[0, steps, None] for array in (played.observations, played.actions))
    start = np.zeros((len(observations), 1), np.bool_)
    start[0] = True
    learned = {
        name: RolloutRelabeller(model, segment_steps, 1).relabel(observations, actions, start)[:, 0]
        for name, model in models.items()
    }
    title = f"The first {len(start)} steps of an episode of {policy}"
    return RolloutSeries(title, (), episodes.rewards[0, steps], learned)


def _segments(dataset: RecordedDataset, models: dict[str, RewardModel]) -> RolloutSeries:
    indices = [round(position * (len(dataset) - 1)) for position in _POSITIONS]
    segments, mask = dataset.segments(indices), dataset.mask[indices]
    breaks = tuple(np.cumsum(mask.sum(axis=1))[:-1].tolist())
    learned = {name: predict(model, segments).rewards[mask] for name, model in models.items()}
    title = f"{len(indices)} segments from the beginning to the end of the training"
    return RolloutSeries(title, breaks, dataset.rewards[indices][mask], learned)
