"""How the members of a stack score segments named by index, wherever the segments lie."""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mapt.preferences.dataset import SegmentSource
from mapt.rewards.ensemble_fitting import SEGMENTS_PER_PASS, StackScorer
from mapt.rewards.members import segment_tensors
from mapt.rewards.stacked import StackedModels


def taken(segments: SegmentSource, index: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Observations, actions and mask of the segments at `index`, of any shape, on its device."""
    found = segment_tensors(segments.take(index.flatten().cpu().numpy()), index.device)
    observations, actions, mask = (tensor.view(*index.shape, *tensor.shape[1:]) for tensor in found)
    return observations, actions, mask


def whole_stack_scorer(stack: StackedModels, segments: SegmentSource) -> StackScorer:
    """Scores by the whole networks."""

    def score(index: Tensor) -> Tensor:
        return stack.outputs(*taken(segments, index))[0]

    return score


@torch.no_grad()
def markov_stack_scorer(stack: StackedModels, segments: SegmentSource, used: Tensor) -> StackScorer:
    """Scores in which only the Markov paths move: all else keeps what it says now of the segments `used`, int (U,)
    ascending and without repetition, and needs one pass over them for the whole training."""
    fixed = [_fixed(stack, segments, part) for part in used.split(SEGMENTS_PER_PASS)]
    weights, offset = (torch.cat(parts, dim=1) for parts in zip(*fixed, strict=True))
    member = torch.arange(len(stack), device=used.device)[:, None]

    def score(index: Tensor) -> Tensor:
        at = torch.searchsorted(used, index)
        observations, actions, _ = taken(segments, index)
        rewards = stack.markov_rewards(observations, actions)
        return offset[member, at] + (weights[member, at] * rewards).sum(dim=2)

    return score


def _fixed(stack: StackedModels, segments: SegmentSource, part: Tensor) -> tuple[Tensor, Tensor]:
    """Weights (M, S, T), and the part (M, S) of the scores that is not the Markov paths'."""
    observations, actions, mask = taken(segments, part)
    score, _, weights = stack.outputs(observations, actions, mask)
    return weights, score - (weights * stack.markov_rewards(observations, actions)).sum(dim=2)


@torch.no_grad()
def measure_reward_scales(stack: StackedModels, segments: SegmentSource, device: torch.device) -> None:
    """Set each member's reward mean and deviation from its shared rewards of the real steps of these segments."""
    sums = torch.zeros(3, len(stack), dtype=torch.float64, device=device)
    for part in torch.arange(len(segments), device=device).split(SEGMENTS_PER_PASS):
        observations, actions, mask = taken(segments, part)
        rewards = stack.outputs(observations, actions, mask)[1][:, mask].double()
        sums += torch.stack((torch.ones_like(rewards), rewards, rewards.square())).sum(dim=2)
    mean = sums[1] / sums[0]
    stack.set_reward_scales(mean, (sums[2] / sums[0] - mean.square()).clamp(min=0).sqrt())


def spread_sample(segments: SegmentSource, most: int) -> NDArray[np.int64]:
    """Indices of at most `most` segments, spread evenly over all."""
    return np.unique(np.linspace(0, len(segments) - 1, min(most, len(segments))).round().astype(np.int64))
