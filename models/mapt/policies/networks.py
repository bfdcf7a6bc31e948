"""The actor of the team and its central critic.

The actor works agent first, (N, B, C): one matrix product serves all agents, whether they share weights or not.
"""

import math
from collections.abc import Callable, Sequence
from itertools import pairwise

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from mapt.policies.config import MappoConfig
from mapt.policies.normalisation import InputNormaliser, ReturnStatistics
from mapt.tasks import TaskSpec

HALF_LOG_TWO_PI = 0.5 * math.log(2 * math.pi)
_ACTIVATIONS: dict[str, type[nn.Module]] = {"tanh": nn.Tanh, "relu": nn.ReLU}


class AgentLinear(nn.Module):
    """A linear layer of its own for each of N agents: (N, B, in) -> (N, B, out) in one batched product."""

    def __init__(self, n_agents: int, n_in: int, n_out: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.empty(n_agents, n_in, n_out))
        self.bias = nn.Parameter(torch.zeros(n_agents, 1, n_out))

    def forward(self, inputs: Tensor) -> Tensor:
        return torch.baddbmm(self.bias, inputs, self.weight)


class Actor(nn.Module):
    """Gaussian actions with a mean from each agent's own observation and a spread that depends on nothing.

    The spread is each agent's own even when they share the network, since joints of unlike strength need unlike noise.
    """

    def __init__(self, spec: TaskSpec, config: MappoConfig) -> None:
        super().__init__()
        self._action_limit = spec.action_limit
        n_agents, width = spec.n_agents, spec.observation_dim

        def layer(n_in: int, n_out: int) -> nn.Module:
            return nn.Linear(n_in, n_out) if config.shared_actor else AgentLinear(n_agents, n_in, n_out)

        self.normaliser = InputNormaliser(n_agents, 1, width, over=1)
        self.network = _mlp(layer, (width, *config.hidden, spec.action_dim), config.activation, last_gain=0.01)
        self.log_std = nn.Parameter(torch.full((n_agents, 1, spec.action_dim), config.initial_log_std))

    def means(self, observations: Tensor) -> Tensor:
        """Mean actions (N, B, A) for raw observations (N, B, C)."""
        return self.network(self.normaliser(observations))

    def log_probs(self, inputs: Tensor, actions: Tensor) -> Tensor:
        """Log-density (N, B) of actions (N, B, A) for normalised observations (N, B, C)."""
        noise = (actions - self.network(inputs)) * torch.exp(-self.log_std)
        return self.log_density(noise)

    def log_density(self, noise: Tensor) -> Tensor:
        """Log-density (N, B) of the actions that lie `noise` (N, B, A) standard deviations from their means."""
        return (-0.5 * noise.square() - self.log_std - HALF_LOG_TWO_PI).sum(-1)

    def entropy(self) -> Tensor:
        """Mean over agents of the entropy of their actions, in nats."""
        return (self.log_std + 0.5 + HALF_LOG_TWO_PI).sum(-1).mean()

    @torch.inference_mode()
    def act(self, observations: NDArray[np.floating], noise: Tensor | None = None) -> NDArray[np.float32]:
        """Actions (E, N, A) for observations (E, N, C), within the task's limit.

        Args:
            noise: standard normal draws (N, E, A); without them, the mean action.
        """
        return self.bounded(self.sample(observations, noise)).cpu().numpy()

    def sample(self, observations: NDArray[np.floating], noise: Tensor | None) -> Tensor:
        """Actions (E, N, A) as drawn, which may lie beyond the limit."""
        agent_first = torch.from_numpy(observations).to(self.log_std.device).transpose(0, 1)
        actions = self.means(agent_first)
        if noise is not None:
            actions = actions + self.log_std.exp() * noise.to(actions.device)
        return actions.transpose(0, 1)

    def bounded(self, actions: Tensor) -> Tensor:
        """What the task is given: actions cut to its limit."""
        return actions.clamp(-self._action_limit, self._action_limit)


class Critic(nn.Module):
    """Value of the state of the whole environment for each of N agents, in units of `ReturnStatistics`.

    One network with N outputs: with a shared reward they learn the same, with individual rewards each its agent's.
    It starts at zero everywhere, so that no scale of rewards is drowned by what it says before it learned.
    """

    def __init__(self, spec: TaskSpec, config: MappoConfig) -> None:
        super().__init__()
        self.normaliser = InputNormaliser(1, spec.state_dim, over=0)
        self.network = _mlp(
            nn.Linear, (spec.state_dim, *config.hidden, spec.n_agents), config.activation, last_gain=0.0
        )
        self.statistics = ReturnStatistics(spec.n_agents, config.value_statistics_rate)

    def values(self, state: Tensor) -> Tensor:
        """Values (B, N) in units of the reward, for raw state (B, S)."""
        return self.statistics.denormalise(self.network(self.normaliser(state)))

    @torch.no_grad()
    def absorb_returns(self, returns: Tensor) -> None:
        """Renew the statistics by returns (B, N) and keep every value as it was.

        The last layer is rescaled to undo the change of units (PopArt, van Hasselt et al. 2016). The first returns only
        set the units: a critic that has learned nothing starts from their mean.
        """
        if self.statistics.weight == 0:
            self.statistics.absorb(returns)
            return
        old_mean, old_std = self.statistics.mean.clone(), self.statistics.std.clone()
        self.statistics.absorb(returns)
        last = self.network[-1]
        assert isinstance(last, nn.Linear)
        last.weight.mul_((old_std / self.statistics.std)[:, None])
        last.bias.mul_(old_std).add_(old_mean - self.statistics.mean).div_(self.statistics.std)


def _mlp(
    layer: Callable[[int, int], nn.Module], sizes: Sequence[int], activation: str, last_gain: float
) -> nn.Sequential:
    """Layers with orthogonal weights and zero biases, the last scaled by `last_gain`."""
    modules: list[nn.Module] = []
    for n_in, n_out in pairwise(sizes):
        modules += [layer(n_in, n_out), _ACTIVATIONS[activation]()]
    modules.pop()
    linears = modules[::2]
    for linear in linears:
        _initialise(linear, last_gain if linear is linears[-1] else math.sqrt(2))
    return nn.Sequential(*modules)


def _initialise(linear: nn.Module, gain: float) -> None:
    weight, bias = linear.get_parameter("weight"), linear.get_parameter("bias")
    for matrix in weight if weight.dim() == 3 else (weight,):
        nn.init.orthogonal_(matrix, gain)
    nn.init.zeros_(bias)
