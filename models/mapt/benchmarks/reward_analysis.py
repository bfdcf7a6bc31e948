"""What the attentions of a model look at: recorded while it runs, whatever its architecture."""

import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from mapt.benchmarks.evaluate import (
    IntArray,
    Judge,
    Predictions,
    predict,
    preference_quality,
    random_pairs,
    reward_quality,
    split_replay,
)
from mapt.benchmarks.job import count_parameters
from mapt.benchmarks.recorded_dataset import Replay, episodes_path
from mapt.preferences.dataset import SegmentArrays
from mapt.rewards.data import EVALUATION_SEGMENTS
from mapt.rewards.mapt import CooperationAwareAttention, TemporalAwareAttention
from mapt.rewards.metrics import CalibrationBin, calibration_bins, rank_correlation
from mapt.rewards.model import RewardModel
from mapt.rewards.relabelling import RolloutRelabeller


@dataclass(frozen=True, slots=True)
class AttentionMaps:
    """How agents and steps of S segments attend to each other; None where a model has no such attention."""

    #: (S, T, agent that asks, agent asked), each row sums to 1 (paper, eq. 4)
    agents: NDArray[np.float32] | None
    #: (S, step that asks, step asked), each row sums to 1, 0 on padding (paper, eq. 5)
    steps: NDArray[np.float32] | None


@dataclass(slots=True)
class _Seen:
    agents: list[Tensor] = field(default_factory=list)
    steps: list[Tensor] = field(default_factory=list)


@torch.inference_mode()
def attention_maps(model: RewardModel, segments: SegmentArrays) -> AttentionMaps:
    """Run `model`, on the CPU, over segments and note its preference attentions."""
    arrays = (segments.observations, segments.actions, segments.mask)
    with _watched(model) as seen:
        model(*(torch.as_tensor(array) for array in arrays))
    agents, steps = (torch.cat(found).numpy() if found else None for found in (seen.agents, seen.steps))
    return AttentionMaps(agents, steps)


@contextmanager
def _watched(model: nn.Module) -> Iterator[_Seen]:
    seen = _Seen()

    def note_agents(attention: CooperationAwareAttention, inputs: tuple[Tensor], _output: Tensor) -> None:
        seen.agents.append(attention.attention_weights(inputs[0]))

    def note_steps(_attention: TemporalAwareAttention, _inputs: tuple[Tensor, ...], output: Tensor) -> None:
        seen.steps.append(output)

    hooks = []
    for module in model.modules():
        if isinstance(module, CooperationAwareAttention):
            hooks.append(module.register_forward_hook(note_agents))
        elif isinstance(module, TemporalAwareAttention):
            hooks.append(module.register_forward_hook(note_steps))
    try:
        yield seen
    finally:
        for hook in hooks:
            hook.remove()


#: the paper's figures 2 and 4 are of so many state-action pairs
STATE_ACTIONS = 100_000
#: segments whose attention is drawn, by the share of segments with a smaller return
SHOWN_RANKS = (0.1, 0.5, 0.95)


@dataclass(frozen=True, slots=True)
class Sample:
    """The segments and pairs that models are diagnosed on, the same for each."""

    #: of the replay, in the order they were made, int64 (S,)
    indices: IntArray
    segments: SegmentArrays
    #: the task's own, float64 (S, T)
    rewards: NDArray[np.float64]
    #: places in `indices`, int64 (P, 2)
    pairs: IntArray
    #: the teacher's, float32 (P,), NaN where it skips
    labels: NDArray[np.float32]
    #: what the teacher judges by, (S,)
    judged_by: NDArray[np.float64]
    #: places of the segments whose attention is drawn
    shown: IntArray

    @property
    def mask(self) -> NDArray[np.bool_]:
        """bool (S, T)."""
        return self.segments.mask

    @property
    def returns(self) -> NDArray[np.float64]:
        """True returns, (S,)."""
        return self.rewards.sum(axis=1)


def draw_sample(replay: Replay, teacher: str, n_pairs: int, fresh_of_seed: int | None) -> Sample:
    """Segments for about `STATE_ACTIONS` state-action pairs, or all there are.

    Args:
        teacher: see `Judge`.
        fresh_of_seed: take only segments from which a table's cells of this seed do not learn.
    """
    pool = np.arange(len(replay)) if fresh_of_seed is None else split_replay(len(replay), fresh_of_seed).test
    rng = np.random.default_rng(0)
    n_segments = min(len(pool), math.ceil(STATE_ACTIONS / replay.source.n_steps))
    indices = np.sort(rng.choice(pool, n_segments, replace=False))
    pairs = random_pairs(np.arange(n_segments), n_pairs, rng)
    judge = Judge(teacher, replay, 0)
    judged_by = judge.scores(indices)
    order = np.argsort(replay.returns[indices], kind="stable")
    shown = order[[round(rank * (n_segments - 1)) for rank in SHOWN_RANKS]]
    labels, rewards = judge.labels(indices[pairs]), replay.rewards[indices]
    return Sample(indices, replay.segments(indices), rewards, pairs, labels, judged_by, shown)


@dataclass(frozen=True, slots=True)
class Diagnosis:
    """A model on a sample."""

    name: str
    #: settings of the network
    network: Mapping[str, object]
    metrics: Mapping[str, float]
    predictions: Predictions
    calibration: tuple[CalibrationBin, ...]
    #: of the sample's `shown` segments
    maps: AttentionMaps
    #: mean over steps and segments of who attends to whom, (N, N)
    agent_attention: NDArray[np.float32] | None


def diagnose(name: str, model: RewardModel, sample: Sample) -> Diagnosis:
    """Measure `model`, on the CPU.

    Beside those of `preference_quality` and `reward_quality`, the metrics are `rank_correlation_teacher`; `parameters`;
    `spread_across_agents`, the mean over steps of the deviation among agents, in deviations of all rewards;
    `past_share`, how much of the variation of the rewards is not the Markov path's, from 0 to about 1;
    `weight_concentration`, 1 - entropy of the weights of steps / its greatest: 0 where all weigh the same;
    `breadth` and `true_breadth`, the range of the middle half of the rewards in that of all but 1%.
    """
    predictions = predict(model, sample.segments)
    maps = attention_maps(model, sample.segments.take(sample.shown))
    first, second = predictions.scores[sample.pairs].T
    mask, given = sample.mask, np.isfinite(sample.labels)
    learned = predictions.agent_rewards[mask]
    metrics = {
        **preference_quality(first - second, sample.labels),
        "rank_correlation_teacher": rank_correlation(predictions.scores, sample.judged_by),
        **reward_quality(predictions, sample.rewards, mask),
        "spread_across_agents": float(learned.std(axis=1).mean() / max(learned.std(), 1e-12)),
        "past_share": _past_share(model, sample.segments, predictions),
        "weight_concentration": weight_concentration(predictions.weights, mask),
        "breadth": breadth(predictions.rewards[mask]),
        "true_breadth": breadth(sample.rewards[mask]),
        "parameters": float(count_parameters(model)),
    }
    probabilities = 1 / (1 + np.exp(-np.clip(first - second, -60, 60)))
    calibration = calibration_bins(probabilities[given], sample.labels[given])
    measured = {key: float(value) for key, value in metrics.items() if math.isfinite(value)}
    attention = None if maps.agents is None else _agent_attention(model, sample)
    return Diagnosis(name, model.config.to_dict(), measured, predictions, calibration, maps, attention)


def weight_concentration(weights: NDArray[np.floating], mask: NDArray[np.bool_]) -> float:
    """1 - entropy / greatest entropy of weights (S, T), mean over segments of more than one step: 0 to 1."""
    real = mask & (weights > 0)
    entropy = -(np.where(real, weights, 1.0) * np.log(np.where(real, weights, 1.0))).sum(axis=1)
    n_steps = mask.sum(axis=1)
    long = n_steps > 1
    return float((1 - entropy[long] / np.log(n_steps[long])).mean()) if long.any() else math.nan


def breadth(rewards: NDArray[np.floating]) -> float:
    """Range of the middle half of rewards in that of all but 1% of them: small where most are alike."""
    low, quarter, three_quarters, high = np.percentile(rewards, (0.5, 25, 75, 99.5))
    return float((three_quarters - quarter) / (high - low)) if high > low else math.nan


@torch.inference_mode()
def _past_share(model: RewardModel, segments: SegmentArrays, predictions: Predictions) -> float:
    if model.markov is None:
        return 1.0
    arrays = (torch.as_tensor(array) for array in (segments.observations, segments.actions))
    parts = zip(*(array.split(EVALUATION_SEGMENTS) for array in arrays), strict=True)
    markov = torch.cat([model.markov_rewards(*part) for part in parts]).numpy()[segments.mask]
    whole = predictions.agent_rewards[segments.mask]
    return float((whole - markov).var() / max(float(whole.var()), 1e-12))


def _agent_attention(model: RewardModel, sample: Sample) -> NDArray[np.float32]:
    """Mean over at most a hundred segments, evenly spread over the replay."""
    spread = np.unique(np.linspace(0, len(sample.indices) - 1, 100).astype(np.int64))
    segments = sample.segments.take(spread)
    agents = attention_maps(model, segments).agents
    assert agents is not None
    return agents[segments.mask].mean(axis=0)


#: of an episode; more cannot be told apart in a picture
_MOST_STEPS = 300
#: which segments, by their place in the replay, where no episode was recorded
_PLACES = (0.02, 0.25, 0.5, 0.75, 0.98)


@dataclass(frozen=True, slots=True)
class RolloutSeries:
    """Steps to compare rewards along."""

    #: in words
    what: str
    #: steps before which another segment begins
    breaks: tuple[int, ...]
    #: (L,)
    true: NDArray[np.float64]
    #: for each model, (L,)
    learned: dict[str, NDArray[np.floating]]


def rollout_series(replay: Replay, models: dict[str, RewardModel]) -> RolloutSeries:
    """The team's rewards along a rollout of the replay's policy, as the policy would be given them."""
    path = episodes_path(replay.path)
    return _episode(Replay.open(path), replay.source.n_steps, models) if path.exists() else _segments(replay, models)


def _episode(episodes: Replay, window: int, models: dict[str, RewardModel]) -> RolloutSeries:
    steps = slice(0, min(_MOST_STEPS, int(episodes.mask[0].sum())))
    played = episodes.segments([0])
    observations, actions = (array[0, steps, None] for array in (played.observations, played.actions))
    start = np.zeros((len(observations), 1), np.bool_)
    start[0] = True
    learned = {
        name: RolloutRelabeller(model, window, 1).relabel(observations, actions, start)[:, 0]
        for name, model in models.items()
    }
    what = f"The first {len(start)} steps of an episode of the trained policy"
    return RolloutSeries(what, (), episodes.rewards[0, steps], learned)


def _segments(replay: Replay, models: dict[str, RewardModel]) -> RolloutSeries:
    places = [round(place * (len(replay) - 1)) for place in _PLACES]
    segments, mask = replay.segments(places), replay.mask[places]
    breaks = tuple(np.cumsum(mask.sum(axis=1))[:-1].tolist())
    learned = {name: predict(model, segments).rewards[mask] for name, model in models.items()}
    what = f"{len(places)} segments from the replay's beginning to its end"
    return RolloutSeries(what, breaks, replay.rewards[places][mask], learned)
