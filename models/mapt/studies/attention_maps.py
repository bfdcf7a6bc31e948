"""What the attentions of a model look at: recorded while it runs, whatever its architecture."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from mapt.preferences.dataset import SegmentArrays
from mapt.rewards.model import RewardModel
from mapt.rewards.preference_attention import CooperationAwareAttention, TemporalAwareAttention


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
        seen.agents.append(attention.shares(inputs[0]))

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
