"""How the members of a stack score segments named by index, wherever the segments lie."""

import torch
from torch import Tensor

from mapt.rewards.data import SegmentReader
from mapt.rewards.ensemble_fitting import StackScorer
from mapt.rewards.kernels import products_in
from mapt.rewards.stacked import SEGMENTS_PER_PASS, StackedModels


def taken(segments: SegmentReader, index: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Observations, actions and mask of the segments at `index`, of any shape."""
    found = segments.take(index.flatten()).inputs
    observations, actions, mask = (tensor.view(*index.shape, *tensor.shape[1:]) for tensor in found)
    return observations, actions, mask


def whole_stack_scorer(
    stack: StackedModels, segments: SegmentReader, products: torch.dtype = torch.float32
) -> StackScorer:
    """Scores by the whole networks, float32, whatever their layers multiply in."""

    def score(index: Tensor) -> Tensor:
        with products_in(products, segments.device):
            return stack.outputs(*taken(segments, index))[0].float()

    return score


@torch.no_grad()
def markov_stack_scorer(stack: StackedModels, segments: SegmentReader, used: Tensor) -> StackScorer:
    """Scores in which only the Markov paths move: all else keeps what it says now of the segments `used`, int (U,)
    ascending and without repetition, and needs one pass over them for the whole training."""
    # Filled in place, as in `pair_tensors.markov_scorer`.
    weights = torch.empty(len(stack), len(used), segments.n_steps, device=used.device)
    offset = torch.empty(len(stack), len(used), device=used.device)
    for place in torch.arange(len(used), device=used.device).split(SEGMENTS_PER_PASS):
        weights[:, place], offset[:, place] = _fixed(stack, segments, used[place])
    member = torch.arange(len(stack), device=used.device)[:, None]

    def score(index: Tensor) -> Tensor:
        at = torch.searchsorted(used, index)
        observations, actions, _ = taken(segments, index)
        rewards = stack.markov_rewards(observations, actions)
        return offset[member, at] + (weights[member, at] * rewards).sum(dim=2)

    return score


def _fixed(stack: StackedModels, segments: SegmentReader, part: Tensor) -> tuple[Tensor, Tensor]:
    """Weights (M, S, T), and the part (M, S) of the scores that is not the Markov paths'."""
    observations, actions, mask = taken(segments, part)
    score, _, weights = stack.outputs(observations, actions, mask)
    return weights, score - (weights * stack.markov_rewards(observations, actions)).sum(dim=2)


@torch.no_grad()
def measure_reward_scales(stack: StackedModels, segments: SegmentReader, index: Tensor) -> None:
    """Set each member's reward mean and deviation from its shared rewards of the real steps of segments."""
    rewards = []
    for part in index.split(SEGMENTS_PER_PASS):
        observations, actions, mask = taken(segments, part)
        rewards.append(stack.outputs(observations, actions, mask)[1][:, mask])
    every = torch.cat(rewards, dim=1).double()
    stack.set_reward_scales(every.mean(dim=1), every.std(dim=1, correction=0))
