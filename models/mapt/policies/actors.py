"""Actors that decide each from its own observation, with weights of their own or shared."""

import copy

import torch
from torch import Tensor, nn

from mapt.policies.actions import ActionDistribution, Categorical, Gaussian, used_numbers
from mapt.policies.config import PolicyConfig
from mapt.policies.gaussian_perceptron import GaussianPerceptron
from mapt.policies.layers import AgentLinear, perceptron
from mapt.policies.normalisation import InputNormaliser
from mapt.tasks import TaskSpec


class Actors(nn.Module):
    """Gaussian actions with a mean from each agent's own observation, or a choice by it if actions are discrete.

    A Gaussian's spread depends on nothing. It is each agent's own even when they share the network, since joints of
    unlike strength need unlike noise.
    """

    used: Tensor | None

    def __init__(self, spec: TaskSpec, config: PolicyConfig) -> None:
        super().__init__()
        n_agents, width = spec.n_agents, spec.observation_dim

        def layer(n_in: int, n_out: int) -> nn.Module:
            return nn.Linear(n_in, n_out) if config.shared_actor else AgentLinear(n_agents, n_in, n_out)

        self._in_one_node = not (config.shared_actor or spec.discrete_actions) and config.activation == "tanh"
        self.normaliser = InputNormaliser(n_agents, 1, width, over=1)
        self.network = perceptron(layer, (width, *config.hidden, spec.action_dim), config.activation, last_gain=0.01)
        spread = torch.full((n_agents, 1, spec.action_dim), config.initial_log_std)
        self.register_buffer("used", used_numbers(spec), persistent=False)
        self.log_std = None if spec.discrete_actions else nn.Parameter(spread)

    def forward(self, inputs: Tensor, available: Tensor | None = None) -> ActionDistribution:
        """Distribution of the actions (N, B, A) for normalised observations (N, B, C)."""
        outputs = self.network(inputs)
        if self.log_std is None:
            return Categorical.masked(outputs, available, self.used)
        return Gaussian(outputs, self.log_std, self.used)

    def evaluate(
        self, inputs: Tensor, actions: Tensor, available: Tensor | None = None
    ) -> tuple[Tensor, ActionDistribution]:
        """Log-probabilities (N, B) of actions (N, B, A), with gradients, and the distribution, maybe without."""
        if self._in_one_node and self.log_std is not None:
            layers = [layer for layer in self.network if isinstance(layer, AgentLinear)]
            tensors = [tensor for layer in layers for tensor in (layer.weight, layer.bias)]
            log_probs, mean = GaussianPerceptron.apply(inputs, actions, self.used, self.log_std, *tensors)
            return log_probs, Gaussian(mean, self.log_std, self.used)
        distribution = self(inputs, available)
        return distribution.log_probs(actions), distribution

    def alone(self, agent: int) -> "Actors":
        """The actor of one agent of those with weights of their own, for (1, B, C).

        Its parameters are the very memory of this one's, so who trains it trains that agent here.
        """
        actor = copy.deepcopy(self)
        for name, parameter in self.named_parameters():
            owner, _, leaf = name.rpartition(".")
            setattr(actor.get_submodule(owner), leaf, nn.Parameter(parameter.detach()[agent : agent + 1]))
        actor.used = None if self.used is None else self.used[agent : agent + 1]
        return actor
