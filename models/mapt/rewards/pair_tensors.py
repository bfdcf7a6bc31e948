"""The pairs of a preference dataset as tensors, and what scores their segments in fused passes."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mapt.preferences.dataset import PreferenceDataset
from mapt.rewards.base import RewardModel
from mapt.rewards.precision import products_in
from mapt.rewards.segment_reader import EVALUATION_SEGMENTS, SegmentReader, SegmentTensors

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
