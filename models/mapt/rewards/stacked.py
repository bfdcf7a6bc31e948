"""Models of one shape run as one: every layer of all members is a single product."""

import copy
from collections.abc import Mapping, Sequence

import torch
from torch import Tensor, nn
from torch.func import functional_call, stack_module_state
from torch.nn.attention import SDPBackend, sdpa_kernel

from mapt.errors import ModelMismatch
from mapt.rewards.model import SMALLEST_REWARD_DEVIATION, RewardModel
from mapt.rewards.unrolled_lstm import unroll_lstms

# Segments in one pass over all members, when no gradient is taken.
SEGMENTS_PER_PASS = 64


class StackedModels:
    """M reward models whose parameters lie behind each other along a first axis.

    Inputs are as `RewardModel.forward` takes them, the same for every member, or with one more axis in front: M inputs,
    one for each. Outputs always have that axis.
    """

    def __init__(self, models: Sequence[RewardModel]) -> None:
        #: by name, (M, ...), leaves that an optimiser can train
        self.parameters: dict[str, nn.Parameter]
        #: by name, (M, ...)
        self.buffers: dict[str, Tensor]
        parameters, self.buffers = stack_module_state(list(models))
        self.parameters = {name: nn.Parameter(tensor.detach()) for name, tensor in parameters.items()}
        self.config = models[0].config
        template = copy.deepcopy(models[0])
        unroll_lstms(template)
        self._views = _Views(template.to("meta"))

    def __len__(self) -> int:
        return len(self.buffers["reward_mean"])

    def train(self, mode: bool) -> None:
        """Let dropout act, or not. Its draws are the same for every member: they differ in their batches."""
        self._views.train(mode)

    def to(self, device: torch.device) -> None:
        """Move all members; an optimiser made before no longer knows them."""
        for name, tensor in self.parameters.items():
            self.parameters[name] = nn.Parameter(tensor.detach().to(device))
        for name, tensor in self.buffers.items():
            self.buffers[name] = tensor.to(device)

    def outputs(self, observations: Tensor, actions: Tensor, mask: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Scores (M, S), shared rewards (M, S, T) and weights (M, S, T)."""
        score, rewards, weights = self._run("outputs", observations, actions, mask)
        return score, rewards, weights

    def markov_rewards(self, observations: Tensor, actions: Tensor) -> Tensor:
        """The Markov paths' part of the shared rewards, (M, S, T)."""
        return self._run("markov", observations, actions)[0]

    def set_reward_scales(self, mean: Tensor, deviation: Tensor) -> None:
        """Record each member's reward mean and deviation, (M,); see `RewardModel.set_reward_scale`."""
        self.buffers["reward_mean"].copy_(mean)
        self.buffers["reward_deviation"].copy_(deviation.clamp(min=SMALLEST_REWARD_DEVIATION))

    def state(self) -> dict[str, Tensor]:
        """Every parameter and buffer, (M, ...), detached."""
        return {name: tensor.detach() for name, tensor in {**self.parameters, **self.buffers}.items()}

    @torch.no_grad()
    def load(self, state: Mapping[str, Tensor]) -> None:
        """Take up another stack's `state`.

        Raises:
            ModelMismatch: if it is of another shape.
        """
        own = self.state()
        if shapes(state) != shapes(own):
            raise ModelMismatch("names and shapes of stacked weights", shapes(own), shapes(state))
        for name, tensor in own.items():
            tensor.copy_(state[name])

    def state_of(self, member: int) -> dict[str, Tensor]:
        """Copies of one member's parameters and buffers."""
        return {name: tensor[member].clone() for name, tensor in self.state().items()}

    def _run(self, view: str, *inputs: Tensor) -> tuple[Tensor, ...]:
        def member(parameters: Mapping[str, Tensor], buffers: Mapping[str, Tensor], *own: Tensor) -> tuple[Tensor, ...]:
            state = {f"model.{name}": tensor for name, tensor in {**parameters, **buffers}.items()}
            return functional_call(self._views, state, (view, *own))

        each = 0 if inputs[0].dim() == 5 else None
        # The fused attentions have no rule for a stack of members; the plain one is two products and a softmax.
        with sdpa_kernel(SDPBackend.MATH):
            run = torch.vmap(member, in_dims=(0, 0, *(each for _ in inputs)), randomness="same")
            return run(self.parameters, self.buffers, *inputs)


def shapes(state: Mapping[str, Tensor]) -> dict[str, tuple[int, ...]]:
    """Shape of every tensor, by name."""
    return {name: tuple(state[name].shape) for name in sorted(state)}


class _Views(nn.Module):
    """What is asked of a member, behind the one call that `functional_call` knows."""

    def __init__(self, model: RewardModel) -> None:
        super().__init__()
        self.model = model

    def forward(self, view: str, *inputs: Tensor) -> tuple[Tensor, ...]:
        if view == "markov":
            return (self.model.markov_rewards(*inputs).mean(dim=2),)
        output = self.model(*inputs)
        return output.score, output.rewards, output.weights
