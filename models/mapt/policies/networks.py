"""Layers that several networks are made of."""

import copy
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise, repeat

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from mapt.policies.config import PolicyConfig
from mapt.policies.distributions import ActionDistribution, Categorical, Gaussian, action_noise, mean_std, used_numbers
from mapt.policies.kernels import GaussianPerceptron
from mapt.policies.normalisation import InputNormaliser, ReturnStatistics
from mapt.tasks import TaskSpec

_ACTIVATIONS: dict[str, type[nn.Module]] = {"tanh": nn.Tanh, "relu": nn.ReLU}


class AgentLinear(nn.Module):
    """A linear layer of its own for each of N agents: (N, B, in) -> (N, B, out) in one batched product."""

    def __init__(self, n_agents: int, n_in: int, n_out: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.empty(n_agents, n_in, n_out))
        self.bias = nn.Parameter(torch.zeros(n_agents, 1, n_out))

    def forward(self, inputs: Tensor) -> Tensor:
        return torch.baddbmm(self.bias, inputs, self.weight)


def perceptron(
    layer: Callable[[int, int], nn.Module], sizes: Sequence[int], activation: str, last_gain: float
) -> nn.Sequential:
    """Layers with orthogonal weights and zero biases, the last scaled by `last_gain`."""
    modules: list[nn.Module] = []
    for n_in, n_out in pairwise(sizes):
        modules += [layer(n_in, n_out), _ACTIVATIONS[activation]()]
    modules.pop()
    linears = modules[::2]
    for linear in linears:
        initialise(linear, last_gain if linear is linears[-1] else math.sqrt(2))
    return nn.Sequential(*modules)


def initialise(linear: nn.Module, gain: float) -> None:
    """Orthogonal weights, each agent's if there are several, and zero biases."""
    weight, bias = linear.get_parameter("weight"), linear.get_parameter("bias")
    for matrix in weight if weight.dim() == 3 else (weight,):
        nn.init.orthogonal_(matrix, gain)
    nn.init.zeros_(bias)


@dataclass(frozen=True, slots=True)
class Batch:
    """Experience as an update reads it, B samples."""

    #: (N, B, C) normalised; (N, B, A) as drawn; (N, B) when drawn; (N, B).
    observations: Tensor
    actions: Tensor
    log_probs: Tensor
    advantages: Tensor
    #: (B, S) normalised; (B, N) in the critic's units.
    state: Tensor
    returns: Tensor
    #: (N, B, A) bool, or nothing if every action always is.
    available: Tensor | None = None

    def pick(self, index: Tensor) -> "Batch":
        """The samples of an index (b,)."""
        return Batch(
            self.observations.index_select(1, index),
            self.actions.index_select(1, index),
            self.log_probs.index_select(1, index),
            self.advantages.index_select(1, index),
            self.state.index_select(0, index),
            self.returns.index_select(0, index),
            None if self.available is None else self.available.index_select(1, index),
        )

    def split(self, size: int) -> Iterator["Batch"]:
        """Views of `size` samples each, in order; the last may be smaller."""
        parts = zip(
            self.observations.split(size, 1),
            self.actions.split(size, 1),
            self.log_probs.split(size, 1),
            self.advantages.split(size, 1),
            self.state.split(size),
            self.returns.split(size),
            repeat(None) if self.available is None else self.available.split(size, 1),
            strict=False,
        )
        return (Batch(*part) for part in parts)

    def of_agent(self, agent: int) -> "Batch":
        """The same samples with one agent on the agent axis; state and returns stay whole."""
        own = slice(agent, agent + 1)
        return replace(
            self,
            observations=self.observations[own],
            actions=self.actions[own],
            log_probs=self.log_probs[own],
            advantages=self.advantages[own],
            available=None if self.available is None else self.available[own],
        )


@dataclass(frozen=True, slots=True)
class Evaluation:
    """What the networks say of a batch."""

    #: (N, B): log-probabilities of its actions.
    log_probs: Tensor
    #: Of its actions; only its entropy is sure to have gradients.
    distribution: ActionDistribution
    #: (B, N): values in the critic's units.
    values: Tensor


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


class Policy(nn.Module, ABC):
    """A team that acts, and a critic that tells what to expect.

    Statistics of inputs change only in `absorb_inputs`, so a rollout and its update see the same networks.
    """

    critic: Critic

    def __init__(self, spec: TaskSpec) -> None:
        super().__init__()
        self.spec = spec

    @abstractmethod
    def draw(self, observations: Tensor, noise: Tensor | None, available: Tensor | None) -> tuple[Tensor, Tensor]:
        """Actions (N, B, A) as drawn, which may lie beyond the task's limit, and their log-probabilities (N, B).

        Args:
            observations: raw, (N, B, C).
            noise: (N, B, A) of `noise`; without it each agent does what is likeliest.
            available: bool (N, B, A), of discrete actions.
        """

    @abstractmethod
    def evaluate(self, batch: Batch) -> Evaluation:
        """Log-probabilities of the batch's actions, and values, with gradients."""

    @abstractmethod
    def normalised(self, observations: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        """Observations (N, B, C) and state (B, S) as `evaluate` takes them."""

    @abstractmethod
    def absorb_inputs(self, observations: Tensor, state: Tensor) -> None:
        """Renew the statistics of inputs by raw observations (N, B, C) and state (B, S)."""

    @abstractmethod
    def action_std(self) -> float | None:
        """Mean standard deviation of the actions; none if they are discrete."""

    def values(self, observations: Tensor, state: Tensor) -> Tensor:
        """Values (B, N) in units of the reward, for raw observations (N, B, C) and state (B, S)."""
        return self.critic.statistics.denormalise(self.critic(*self.normalised(observations, state)))

    @property
    def device(self) -> torch.device:
        return next(self.parameters()).device

    def noise(self, lead: tuple[int, ...], n_envs: int, generator: torch.Generator) -> Tensor:
        """What `draw` draws from, (*lead, N, E, A), on this policy's device."""
        return action_noise(self.spec, (*lead, self.spec.n_agents, n_envs), generator).to(self.device)

    @torch.inference_mode()
    def act(
        self,
        observations: NDArray[np.floating],
        noise: Tensor | None = None,
        available: NDArray[np.bool_] | None = None,
    ) -> NDArray[np.float32]:
        """Actions (E, N, A) for observations (E, N, C), within the task's limit.

        Args:
            noise: (N, E, A) of `noise`; without it, the mean or the likeliest action.
            available: bool (E, N, A), of discrete actions; without it every one is.
        """
        actions, _ = self.draw(self.agent_first(observations), noise, self.agent_first_or_none(available))
        return self.bounded(actions).transpose(0, 1).cpu().numpy()

    def bounded(self, actions: Tensor) -> Tensor:
        """What the task is given: continuous actions cut to its limit."""
        if self.spec.discrete_actions:
            return actions
        return actions.clamp(-self.spec.action_limit, self.spec.action_limit)

    def agent_first(self, array: NDArray[np.generic]) -> Tensor:
        """(E, N, ...) -> (N, E, ...) on this policy's device."""
        return torch.from_numpy(array).to(self.device).transpose(0, 1)

    def agent_first_or_none(self, array: NDArray[np.generic] | None) -> Tensor | None:
        return None if array is None else self.agent_first(array)


class ActorCritic(Policy):
    """Decentralised actors beside a central critic."""

    critic: Critic

    def __init__(self, spec: TaskSpec, actor: Actors, critic: Critic) -> None:
        super().__init__(spec)
        self.actor, self.critic = actor, critic

    def draw(self, observations: Tensor, noise: Tensor | None, available: Tensor | None) -> tuple[Tensor, Tensor]:
        return self.actor(self.actor.normaliser(observations), available).draw(noise)

    def evaluate(self, batch: Batch) -> Evaluation:
        log_probs, distribution = self.actor.evaluate(batch.observations, batch.actions, batch.available)
        return Evaluation(log_probs, distribution, self.critic(batch.observations, batch.state))

    def normalised(self, observations: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        return self.actor.normaliser(observations), self.critic.normalised(state)

    def absorb_inputs(self, observations: Tensor, state: Tensor) -> None:
        self.actor.normaliser.absorb(observations)
        self.critic.absorb_inputs(state)

    def action_std(self) -> float | None:
        log_std = self.actor.log_std
        return None if log_std is None else mean_std(log_std, self.actor.used)
