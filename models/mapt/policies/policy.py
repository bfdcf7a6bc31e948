"""The seam between the learner and the networks of a team: what every algorithm's policy can do.

Networks work agent first, (N, B, C): one matrix product serves all agents, whether they share weights or not.
"""

from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import repeat

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from mapt.policies.actions import ActionDistribution, action_noise
from mapt.policies.critics import Critic
from mapt.tasks import TaskSpec


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
