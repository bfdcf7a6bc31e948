"""The interface of a policy, and the actor-critic of MAPPO, HAPPO and MAT-Dec: an actor per agent, a central critic.

Tensors are agent first, (N, B, ...), so that one batched matrix product serves all agents, whether they share weights
or not.
"""

import copy
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from itertools import pairwise

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from mapt.device import to_device
from mapt.policies.config import PolicyConfig
from mapt.policies.distributions import (
    ActionDistribution,
    Categorical,
    Gaussian,
    action_noise,
    mean_std,
    used_dimensions,
)
from mapt.policies.normalisation import InputNormaliser, PopArt
from mapt.tasks import TaskSpec

_ACTIVATIONS: dict[str, type[nn.Module]] = {"tanh": nn.Tanh, "relu": nn.ReLU}


class Critic(nn.Module, ABC):
    """Estimates the value of the current step for each of N agents, normalised by PopArt.

    With a shared reward the N values have the same target, with individual rewards each has its agent's. The output
    layer starts at zero, so that initial errors do not depend on the scale of the rewards.
    """

    statistics: PopArt

    @abstractmethod
    def forward(self, observations: Tensor, state: Tensor) -> Tensor:
        """Normalised values (B, N) of normalised observations (N, B, C) and state (B, S)."""

    @abstractmethod
    def last_layer(self) -> nn.Linear:
        """The layer whose outputs are the values."""

    def normalise(self, state: Tensor) -> Tensor:
        """Normalised state (B, S), as `forward` expects it."""
        return state

    def update_normaliser(self, state: Tensor) -> None:
        """Add raw state (B, S) to the input statistics."""

    def update_statistics(self, returns: Tensor) -> None:
        """Add the returns (B, N) of a rollout to PopArt's statistics; see `PopArt.update`."""
        self.statistics.update(returns, self.last_layer())


class Policy(nn.Module, ABC):
    """The actors of a team and their critic.

    Input statistics change only in `update_normalisers`, so that a rollout and its update use the same networks.
    """

    critic: Critic

    def __init__(self, spec: TaskSpec) -> None:
        super().__init__()
        self.spec = spec

    @abstractmethod
    def sample(self, observations: Tensor, noise: Tensor | None, available: Tensor | None) -> tuple[Tensor, Tensor]:
        """Sample actions (N, B, A), before clipping to the task's limit, and their log-probabilities (N, B).

        Args:
            observations: raw, (N, B, C).
            noise: (N, B, A) from `noise`; without it, the mean or the most likely action of each agent.
            available: bool (N, B, A), for discrete actions.
        """

    @abstractmethod
    def evaluate_actions(
        self, observations: Tensor, state: Tensor, actions: Tensor, available: Tensor | None
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Evaluate recorded actions with the current weights.

        Args:
            observations: normalised, (N, B, C).
            state: normalised, (B, S).
            actions: (N, B, A), as sampled.
            available: bool (N, B, A), for discrete actions.

        Returns:
            Log-probabilities (N, B), mean entropy () and normalised values (B, N).
        """

    @abstractmethod
    def normalise(self, observations: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        """Normalised observations (N, B, C) and state (B, S), as `evaluate_actions` expects them."""

    @abstractmethod
    def update_normalisers(self, observations: Tensor, state: Tensor) -> None:
        """Add raw observations (N, B, C) and state (B, S) to the input statistics."""

    @abstractmethod
    def action_std(self) -> float | None:
        """Mean standard deviation of the actions; None for discrete actions."""

    @abstractmethod
    def limit_std(self, min_log_std: float) -> None:
        """Raise the logarithms of the actions' standard deviations to at least `min_log_std`."""

    def values(self, observations: Tensor, state: Tensor) -> Tensor:
        """Values (B, N) in units of the reward, of normalised observations (N, B, C) and state (B, S)."""
        return self.critic.statistics.denormalise(self.critic(observations, state))

    @property
    def device(self) -> torch.device:
        return next(self.parameters()).device

    def noise(self, batch_shape: tuple[int, ...], n_envs: int, generator: torch.Generator) -> Tensor:
        """Noise (*batch_shape, N, E, A) for `sample`, on this policy's device."""
        return action_noise(self.spec, (*batch_shape, self.spec.n_agents, n_envs), generator).to(self.device)

    @torch.inference_mode()
    def act(
        self,
        observations: NDArray[np.floating],
        noise: Tensor | None = None,
        available: NDArray[np.bool_] | None = None,
    ) -> NDArray[np.float32]:
        """Actions (E, N, A) within the task's limit for raw observations (E, N, C).

        Args:
            noise: (N, E, A) from `noise`; without it, the mean or the most likely action.
            available: bool (E, N, A), for discrete actions; None if all are available.
        """
        mask = None if available is None else self.agent_first(available)
        actions, _ = self.sample(self.agent_first(observations), noise, mask)
        return self.clip(actions).transpose(0, 1).cpu().numpy()

    def clip(self, actions: Tensor) -> Tensor:
        """Continuous actions clipped to the task's limit; discrete ones unchanged."""
        if self.spec.discrete_actions:
            return actions
        return actions.clamp(-self.spec.action_limit, self.spec.action_limit)

    def agent_first(self, array: NDArray[np.generic]) -> Tensor:
        """(E, N, ...) -> (N, E, ...) on this policy's device."""
        return to_device(array, self.device).transpose(0, 1)


class Actors(nn.Module):
    """One perceptron per agent, or one shared by all, from each agent's own observation to its action distribution.

    The standard deviation of a Gaussian does not depend on the observation. It is each agent's own even if they share
    the perceptron, since joints of different strength need different noise.
    """

    used: Tensor | None

    def __init__(self, spec: TaskSpec, config: PolicyConfig) -> None:
        super().__init__()
        n_agents, n_inputs = spec.n_agents, spec.observation_dim

        def layer(n_in: int, n_out: int) -> nn.Module:
            return nn.Linear(n_in, n_out) if config.shared_actor else AgentLinear(n_agents, n_in, n_out)

        self.normaliser = InputNormaliser(n_agents, 1, n_inputs, samples_dim=1)
        self.network = perceptron(layer, (n_inputs, *config.hidden, spec.action_dim), config.activation, last_gain=0.01)
        log_std = torch.full((n_agents, 1, spec.action_dim), config.initial_log_std)
        self.register_buffer("used", used_dimensions(spec), persistent=False)
        self.log_std = None if spec.discrete_actions else nn.Parameter(log_std)

    def forward(self, observations: Tensor, available: Tensor | None = None) -> ActionDistribution:
        """Distribution of actions (N, B, A) for normalised observations (N, B, C)."""
        outputs = self.network(observations)
        if self.log_std is None:
            return Categorical(outputs, available, self.used)
        return Gaussian(outputs, self.log_std, self.used)

    def of_agent(self, agent: int) -> "Actors":
        """The actor of one agent, for observations (1, B, C), if the agents do not share weights.

        Its parameters are views of this module's: training one trains the other.
        """
        actor = copy.deepcopy(self)
        for name, parameter in self.named_parameters():
            owner, _, leaf = name.rpartition(".")
            setattr(actor.get_submodule(owner), leaf, nn.Parameter(parameter.detach()[agent : agent + 1]))
        actor.used = None if self.used is None else self.used[agent : agent + 1]
        return actor


class StateCritic(Critic):
    """A perceptron from the state of the environment to one value per agent."""

    def __init__(self, spec: TaskSpec, config: PolicyConfig) -> None:
        super().__init__()
        self.normaliser = InputNormaliser(1, spec.state_dim, samples_dim=0)
        sizes = (spec.state_dim, *config.hidden, spec.n_agents)
        self.network = perceptron(nn.Linear, sizes, config.activation, last_gain=0.0)
        self.statistics = PopArt(spec.n_agents, config.value_statistics_rate)

    def forward(self, observations: Tensor, state: Tensor) -> Tensor:
        return self.network(state)

    def last_layer(self) -> nn.Linear:
        last = self.network[-1]
        assert isinstance(last, nn.Linear)
        return last

    def normalise(self, state: Tensor) -> Tensor:
        return self.normaliser(state)

    def update_normaliser(self, state: Tensor) -> None:
        self.normaliser.update(state)


class ActorCritic(Policy):
    """Decentralised actors and a central critic."""

    # An annotation of its own: torch declares attributes of modules as `Tensor | Module`.
    critic: Critic

    def __init__(self, spec: TaskSpec, actor: Actors, critic: Critic) -> None:
        super().__init__(spec)
        self.actor, self.critic = actor, critic

    def sample(self, observations: Tensor, noise: Tensor | None, available: Tensor | None) -> tuple[Tensor, Tensor]:
        distribution = self.actor(self.actor.normaliser(observations), available)
        actions = distribution.sample(noise)
        return actions, distribution.log_prob(actions)

    def evaluate_actions(
        self, observations: Tensor, state: Tensor, actions: Tensor, available: Tensor | None
    ) -> tuple[Tensor, Tensor, Tensor]:
        distribution = self.actor(observations, available)
        return distribution.log_prob(actions), distribution.entropy(), self.critic(observations, state)

    def normalise(self, observations: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        return self.actor.normaliser(observations), self.critic.normalise(state)

    def update_normalisers(self, observations: Tensor, state: Tensor) -> None:
        self.actor.normaliser.update(observations)
        self.critic.update_normaliser(state)

    def action_std(self) -> float | None:
        log_std = self.actor.log_std
        return None if log_std is None else mean_std(log_std, self.actor.used)

    @torch.no_grad()
    def limit_std(self, min_log_std: float) -> None:
        if self.actor.log_std is not None:
            self.actor.log_std.clamp_(min=min_log_std)


class AgentLinear(nn.Module):
    """A linear layer with separate weights for each of N agents: (N, B, in) -> (N, B, out) in one batched product."""

    def __init__(self, n_agents: int, n_in: int, n_out: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.empty(n_agents, n_in, n_out))
        self.bias = nn.Parameter(torch.zeros(n_agents, 1, n_out))

    def forward(self, inputs: Tensor) -> Tensor:
        return torch.baddbmm(self.bias, inputs, self.weight)


def perceptron(
    layer: Callable[[int, int], nn.Module], sizes: Sequence[int], activation: str, last_gain: float
) -> nn.Sequential:
    """Linear layers of these sizes with activations between them; the last has orthogonal weights of `last_gain`."""
    modules: list[nn.Module] = []
    for n_in, n_out in pairwise(sizes):
        modules += [layer(n_in, n_out), _ACTIVATIONS[activation]()]
    modules.pop()
    linears = modules[::2]
    for linear in linears:
        initialise(linear, last_gain if linear is linears[-1] else math.sqrt(2))
    return nn.Sequential(*modules)


def initialise(linear: nn.Module, gain: float) -> None:
    """Set orthogonal weights, for each agent if the layer has several, and zero biases."""
    weight, bias = linear.get_parameter("weight"), linear.get_parameter("bias")
    for matrix in weight if weight.dim() == 3 else (weight,):
        nn.init.orthogonal_(matrix, gain)
    nn.init.zeros_(bias)
