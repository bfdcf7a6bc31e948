"""Critics: the value of a moment for each of N agents, in units of `ReturnStatistics`.

With a shared reward the N values learn the same, with individual rewards each its agent's. A critic starts at zero
everywhere, so that no scale of rewards is drowned by what it says before it learned.
"""

from abc import ABC, abstractmethod

import torch
from torch import Tensor, nn

from mapt.policies.config import PolicyConfig
from mapt.policies.layers import perceptron
from mapt.policies.normalisation import InputNormaliser, ReturnStatistics
from mapt.policies.transformer import TeamEncoder, output_head
from mapt.tasks import TaskSpec


class Critic(nn.Module, ABC):
    """What critics share: units of their values that follow the returns."""

    statistics: ReturnStatistics

    @abstractmethod
    def forward(self, observations: Tensor, state: Tensor) -> Tensor:
        """Values (B, N) in this critic's units, for normalised observations (N, B, C) and state (B, S)."""

    @abstractmethod
    def last_layer(self) -> nn.Linear:
        """The layer whose outputs are the values."""

    def normalised(self, state: Tensor) -> Tensor:
        """State (B, S) as `forward` takes it."""
        return state

    def absorb_inputs(self, state: Tensor) -> None:
        """Renew the statistics of inputs by raw state (B, S)."""

    @torch.no_grad()
    def absorb_returns(self, returns: Tensor) -> None:
        """Renew the statistics by returns (B, N) and keep every value as it was.

        The last layer is rescaled to undo the change of units (PopArt, van Hasselt et al. 2016). The first returns only
        set the units: a critic that has learned nothing starts from their mean.
        """
        returns = returns.reshape(-1, len(self.statistics.mean))
        if self.statistics.weight == 0:
            self.statistics.absorb(returns)
            return
        old_mean, old_std = self.statistics.mean.clone(), self.statistics.std.clone()
        self.statistics.absorb(returns)
        last = self.last_layer()
        last.weight.mul_((old_std / self.statistics.std)[:, None])
        last.bias.mul_(old_std).add_(old_mean - self.statistics.mean).div_(self.statistics.std)


class StateCritic(Critic):
    """Reads the state of the whole environment; each agent's value has units of its own."""

    def __init__(self, spec: TaskSpec, config: PolicyConfig) -> None:
        super().__init__()
        self.normaliser = InputNormaliser(1, spec.state_dim, over=0)
        sizes = (spec.state_dim, *config.hidden, spec.n_agents)
        self.network = perceptron(nn.Linear, sizes, config.activation, last_gain=0.0)
        self.statistics = ReturnStatistics(spec.n_agents, config.value_statistics_rate)

    def forward(self, observations: Tensor, state: Tensor) -> Tensor:
        return self.network(state)

    def last_layer(self) -> nn.Linear:
        last = self.network[-1]
        assert isinstance(last, nn.Linear)
        return last

    def normalised(self, state: Tensor) -> Tensor:
        return self.normaliser(state)

    def absorb_inputs(self, state: Tensor) -> None:
        self.normaliser.absorb(state)


class EncoderCritic(Critic):
    """Reads what all agents see, with the transformer's encoder; one head serves all agents, so they share units."""

    def __init__(self, spec: TaskSpec, config: PolicyConfig) -> None:
        super().__init__()
        self.encoder = TeamEncoder(spec.observation_dim, config)
        self.head = output_head(config.width, 1, gain=0.0)
        self.statistics = ReturnStatistics(1, config.value_statistics_rate)

    def forward(self, observations: Tensor, state: Tensor) -> Tensor:
        return self.head(self.encoder(observations.transpose(0, 1))).squeeze(-1)

    def last_layer(self) -> nn.Linear:
        last = self.head[-1]
        assert isinstance(last, nn.Linear)
        return last
