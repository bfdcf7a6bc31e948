"""A preference dataset as tensors on one device, scored in fused passes."""

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mapt.preferences.dataset import PreferenceDataset, SegmentArrays
from mapt.rewards.network import MAPT

# Segments scored at once when no gradient is taken.
EVALUATION_SEGMENTS = 256


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

    def take(self, index: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Observations, actions and mask of the segments at `index`, ready for the network."""
        return self.observations[index], self.actions[index], self.mask[index]


@dataclass(frozen=True, slots=True)
class PairTensors:
    """Pairs (P, 2) and labels (P,) that point into shared segments."""

    segments: SegmentTensors
    pairs: Tensor
    labels: Tensor

    @classmethod
    def of(cls, dataset: PreferenceDataset, segments: SegmentTensors) -> "PairTensors":
        device = segments.mask.device
        return cls(
            segments,
            torch.as_tensor(dataset.pairs, device=device),
            torch.as_tensor(dataset.labels, device=device),
        )

    def __len__(self) -> int:
        return len(self.labels)

    def scores(self, model: MAPT, index: Tensor) -> tuple[Tensor, Tensor]:
        """Scores (B,) of segment 0 and of segment 1 of the pairs at `index`, both in one pass."""
        segment_index = self.pairs[index].T.reshape(-1)
        first, second = model(*self.segments.take(segment_index)).score.chunk(2)
        return first, second

    @torch.inference_mode()
    def logits(self, model: MAPT) -> Tensor:
        """score_0 - score_1 of every pair, (P,), without gradient; each segment is scored once."""
        used, position = torch.unique(self.pairs, return_inverse=True)
        chunks = [model(*self.segments.take(part)).score for part in used.split(EVALUATION_SEGMENTS)]
        score = torch.cat(chunks)[position] if chunks else torch.zeros_like(self.pairs, dtype=torch.float32)
        return score[:, 0] - score[:, 1]


@torch.inference_mode()
def step_rewards(model: MAPT, segments: SegmentTensors) -> NDArray[np.float32]:
    """Shared rewards r-hat_t of every real step of the segments, one flat array."""
    chunks = [
        model.agent_rewards(observations, actions).mean(dim=2)[mask]
        for observations, actions, mask in zip(
            segments.observations.split(EVALUATION_SEGMENTS),
            segments.actions.split(EVALUATION_SEGMENTS),
            segments.mask.split(EVALUATION_SEGMENTS),
            strict=True,
        )
    ]
    return torch.cat(chunks).cpu().numpy()
