"""Segments as tensors on one device: kept there when they fit, read from disk batch by batch when they do not."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from mapt.preferences.dataset import SegmentArrays, SegmentSource
from mapt.rewards.config import RewardConfig
from mapt.rewards.errors import ModelMismatch

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
