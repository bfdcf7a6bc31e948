"""Segments as tensors on one device: kept there when they fit, read from disk batch by batch when they do not."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mapt.errors import ModelMismatch
from mapt.preferences.dataset import PreferenceDataset, SegmentArrays, SegmentSource
from mapt.rewards.config import RewardConfig
from mapt.rewards.kernels import products_in
from mapt.rewards.model import RewardModel

# Segments scored at once when no gradient is taken: so few that their activations stay in cache. At d = 64 and T = 50
# that was 545 segments a CPU second, with 256 at once 334.
EVALUATION_SEGMENTS = 16
# What is measured over all segments is measured over no more than these: a mean over so many is exact to a few
# percent of its deviation, and 50,000 pairs must not be read again for it.
MOST_SEGMENTS_MEASURED = 1024
# A source of fewer numbers than this is copied to the device whole: 2 GiB of float32.
MOST_NUMBERS_KEPT = 1 << 29


@dataclass(frozen=True, slots=True)
class SegmentTensors:
    """`SegmentArrays` on a device."""

    observations: Tensor
    actions: Tensor
    mask: Tensor

    @classmethod
    def of(cls, segments: SegmentArrays, device: torch.device) -> "SegmentTensors":
        return cls(
            torch.as_tensor(segments.observations, dtype=torch.float32, device=device),
            torch.as_tensor(segments.actions, dtype=torch.float32, device=device),
            torch.as_tensor(segments.mask, device=device),
        )

    @property
    def inputs(self) -> tuple[Tensor, Tensor, Tensor]:
        """What a reward model's `forward` takes."""
        return self.observations, self.actions, self.mask


class SegmentReader(Protocol):
    """Gives segments by index, as tensors."""

    def __len__(self) -> int: ...

    @property
    def n_steps(self) -> int:
        """T."""
        ...

    @property
    def device(self) -> torch.device: ...

    def take(self, index: Tensor) -> SegmentTensors:
        """The segments at `index`, int64 (B,)."""
        ...


class KeptSegments:
    """All segments on the device."""

    def __init__(self, segments: SegmentArrays, device: torch.device) -> None:
        self._segments = SegmentTensors.of(segments, device)

    def __len__(self) -> int:
        return len(self._segments.mask)

    @property
    def n_steps(self) -> int:
        """T."""
        return self._segments.mask.shape[1]

    @property
    def device(self) -> torch.device:
        """Where they are kept."""
        return self._segments.mask.device

    def take(self, index: Tensor) -> SegmentTensors:
        """See `SegmentReader.take`."""
        return SegmentTensors(*(tensor[index] for tensor in self._segments.inputs))


class StreamedSegments:
    """Segments read from their source each time they are asked for, in the memory of one batch."""

    def __init__(self, source: SegmentSource, device: torch.device) -> None:
        self._source, self._device = source, device

    def __len__(self) -> int:
        return len(self._source)

    @property
    def n_steps(self) -> int:
        """T."""
        return self._source.n_steps

    @property
    def device(self) -> torch.device:
        """Where they are given."""
        return self._device

    def take(self, index: Tensor) -> SegmentTensors:
        """See `SegmentReader.take`."""
        return SegmentTensors.of(self._source.take(index.cpu().numpy()), self._device)


def check_fit(config: RewardConfig, source: SegmentSource) -> None:
    """
    Raises:
        ModelMismatch: if a model of these settings cannot read these segments.
    """
    found = (source.n_agents, source.observation_dim, source.action_dim)
    if found != config.dimensions:
        raise ModelMismatch("agents, observation and action dimension", config.dimensions, found)


def segment_reader(source: SegmentSource, device: torch.device) -> SegmentReader:
    """The reader that fits the size of `source`."""
    numbers = len(source) * source.n_steps * source.n_agents * (source.observation_dim + source.action_dim)
    if isinstance(source, SegmentArrays):
        return KeptSegments(source, device)
    if numbers <= MOST_NUMBERS_KEPT:
        return KeptSegments(source.take(np.arange(len(source))), device)
    return StreamedSegments(source, device)


def spread_sample(segments: SegmentReader) -> Tensor:
    """Indices of up to `MOST_SEGMENTS_MEASURED` segments, evenly spread: all ages of a replay have their say."""
    n_taken = min(len(segments), MOST_SEGMENTS_MEASURED)
    return torch.linspace(0, len(segments) - 1, n_taken, dtype=torch.float64).round().long().to(segments.device)


#: From indices of segments (B,) to their scores (B,).
Scorer = Callable[[Tensor], Tensor]


@dataclass(frozen=True, slots=True)
class PairTensors:
    """Pairs (P, 2) of segments and their labels (P,)."""

    pairs: Tensor
    labels: Tensor

    @classmethod
    def of(cls, dataset: PreferenceDataset, device: torch.device) -> "PairTensors":
        return cls(torch.as_tensor(dataset.pairs, device=device), torch.as_tensor(dataset.labels, device=device))

    def __len__(self) -> int:
        return len(self.labels)

    def first(self, n_pairs: int) -> "PairTensors":
        """The first pairs, all of them if there are no more than `n_pairs`."""
        return PairTensors(self.pairs[:n_pairs], self.labels[:n_pairs])

    def scores(self, scorer: Scorer, index: Tensor) -> tuple[Tensor, Tensor]:
        """Scores (B,) of segment 0 and of segment 1 of the pairs at `index`, both in one pass."""
        first, second = scorer(self.pairs[index].T.reshape(-1)).chunk(2)
        return first, second

    @torch.no_grad()
    def logits(self, scorer: Scorer) -> Tensor:
        """score_0 - score_1 of every pair, (P,), without gradient; each segment is scored once."""
        used, position = torch.unique(self.pairs, return_inverse=True)
        score = torch.empty(len(used), device=used.device)
        for place in torch.arange(len(used), device=used.device).split(EVALUATION_SEGMENTS):
            score[place] = scorer(used[place])
        return score[position[:, 0]] - score[position[:, 1]]


def whole_scorer(model: RewardModel, segments: SegmentReader, products: torch.dtype = torch.float32) -> Scorer:
    """Scores by the whole network, float32, whatever its layers multiply in."""

    def score(index: Tensor) -> Tensor:
        inputs = segments.take(index).inputs
        with products_in(products, inputs[0].device):
            return model(*inputs).score.float()

    return score


@torch.no_grad()
def markov_scorer(model: RewardModel, segments: SegmentReader, used: Tensor) -> Scorer:
    """Scores in which only the Markov path moves: the attention path's rewards and the weights of the steps
    stay what they are now, so that they need one pass over the segments `used`, int64 (U,) ascending and without
    repetition, for the whole training."""

    def markov_score(part: SegmentTensors, weights: Tensor) -> Tensor:
        rewards = model.markov_rewards(part.observations, part.actions).mean(dim=2)
        return (weights * rewards).sum(dim=1)

    # Filled in place: small tensors that are kept between large ones that go leave the memory in pieces, and 50,000
    # pairs then take gigabytes.
    weights = torch.empty(len(used), segments.n_steps, device=segments.device)
    offset = torch.empty(len(used), device=segments.device)
    for place in torch.arange(len(used), device=segments.device).split(EVALUATION_SEGMENTS):
        part = segments.take(used[place])
        output = model(*part.inputs)
        weights[place] = output.weights
        offset[place] = output.score - markov_score(part, output.weights)

    def score(index: Tensor) -> Tensor:
        at = torch.searchsorted(used, index)
        return offset[at] + markov_score(segments.take(index), weights[at])

    return score


@torch.no_grad()
def step_rewards(model: RewardModel, segments: SegmentReader, index: Tensor) -> NDArray[np.float32]:
    """Shared rewards r-hat_t of every real step of the segments at `index`, one flat array."""
    rewards = np.empty((len(index), segments.n_steps), dtype=np.float32)
    mask = np.empty(rewards.shape, dtype=np.bool_)
    for place in torch.arange(len(index)).split(EVALUATION_SEGMENTS):
        part = segments.take(index[place])
        rewards[place.numpy()] = model.agent_rewards(part.observations, part.actions).mean(dim=2).cpu().numpy()
        mask[place.numpy()] = part.mask.cpu().numpy()
    return rewards[mask]
