"""How the gradient steps of an update are taken: all networks at once, or agent after agent."""

from collections.abc import Callable, Iterable
from typing import Protocol

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from mapt.policies.actor_critic import ActorCritic
from mapt.policies.config import PolicyConfig
from mapt.policies.policy import Batch, Policy

#: Takes a gradient step on a loss and gives the gradient's norm.
Step = Callable[[Tensor], Tensor]
#: Indices of the samples of each step, shuffled anew by every call.
Minibatches = Callable[[], Iterable[Tensor]]


class Update(Protocol):
    """Improves a policy on a batch."""

    @property
    def parameters(self) -> list[nn.Parameter]:
        """What `step` is to move, where a loss gives it a gradient."""
        ...

    def run(
        self, batch: Batch, minibatches: Minibatches, step: Step, generator: torch.Generator
    ) -> list[dict[str, Tensor]]:
        """Take the steps, by draws of `generator`, which is on the CPU; metrics of each step of the last passes."""
        ...


def make_update(policy: Policy, config: PolicyConfig) -> Update:
    """The update of the configured algorithm."""
    if isinstance(policy, ActorCritic) and config.algorithm == "happo":
        return SequentialUpdate(policy, config)
    return JointUpdate(policy, config)


class JointUpdate:
    """One loss for all agents and the critic, as MAPPO (Yu et al. 2022) and MAT have it."""

    def __init__(self, policy: Policy, config: PolicyConfig) -> None:
        self._policy, self._config = policy, config
        self.parameters = list(policy.parameters())

    def run(
        self, batch: Batch, minibatches: Minibatches, step: Step, generator: torch.Generator
    ) -> list[dict[str, Tensor]]:
        metrics = [self._step(batch.pick(index), step) for index in minibatches()]
        return metrics[-self._config.minibatches :]

    def _step(self, batch: Batch, step: Step) -> dict[str, Tensor]:
        now = self._policy.evaluate(batch)
        actor_loss, metrics = clipped_loss(now.log_probs - batch.log_probs, batch.advantages, self._config.clip)
        critic_loss = F.mse_loss(now.values, batch.returns)
        loss = actor_loss + self._config.value_weight * critic_loss - self._config.entropy_weight * now.entropy
        norm = step(loss)
        return metrics | {"critic_loss": critic_loss.detach(), "entropy": now.entropy.detach(), "gradient_norm": norm}


class SequentialUpdate:
    """HAPPO (Kuba et al. 2022): agents in random order, each minding what those before it have become.

    An agent's advantages are weighed by the factor M, how much likelier the agents before it now are to act as they
    did. The critic follows by itself.
    """

    def __init__(self, policy: ActorCritic, config: PolicyConfig) -> None:
        self._critic, self._config = policy.critic, config
        self._actors = [policy.actor.alone(agent) for agent in range(policy.spec.n_agents)]
        self.parameters = [
            *(parameter for actor in self._actors for parameter in actor.parameters()),
            *policy.critic.parameters(),
        ]

    def run(
        self, batch: Batch, minibatches: Minibatches, step: Step, generator: torch.Generator
    ) -> list[dict[str, Tensor]]:
        metrics: list[dict[str, Tensor]] = []
        factor = torch.ones_like(batch.log_probs[0])
        for agent in torch.randperm(len(self._actors), generator=generator).tolist():
            own = batch.of_agent(agent)
            steps = [self._agent_step(agent, own.pick(index), factor[index], step) for index in minibatches()]
            metrics += steps[-self._config.minibatches :]
            with torch.no_grad():
                log_probs = self._actors[agent](own.observations, own.available).log_probs(own.actions)
                factor = factor * (log_probs - own.log_probs)[0].exp()
        steps = [self._critic_step(batch.pick(index), step) for index in minibatches()]
        return metrics + steps[-self._config.minibatches :]

    def _agent_step(self, agent: int, batch: Batch, factor: Tensor, step: Step) -> dict[str, Tensor]:
        distribution = self._actors[agent](batch.observations, batch.available)
        log_ratio = distribution.log_probs(batch.actions) - batch.log_probs
        loss, metrics = clipped_loss(log_ratio, factor * batch.advantages, self._config.clip)
        entropy = distribution.entropy()
        norm = step(loss - self._config.entropy_weight * entropy)
        return metrics | {"entropy": entropy.detach(), "gradient_norm": norm, "factor_spread": factor.std()}

    def _critic_step(self, batch: Batch, step: Step) -> dict[str, Tensor]:
        loss = F.mse_loss(self._critic(batch.observations, batch.state), batch.returns)
        step(self._config.value_weight * loss)
        return {"critic_loss": loss.detach()}


def clipped_loss(log_ratio: Tensor, advantages: Tensor, clip: float) -> tuple[Tensor, dict[str, Tensor]]:
    """PPO's clipped objective (Schulman et al. 2017, eq. 7), to be made small.

    Args:
        log_ratio: log of how much likelier the actions have become, any shape.
        advantages: of the same shape.
        clip: change of probability beyond which nothing is earned.

    Returns:
        The loss () and metrics by name.
    """
    ratio = log_ratio.exp()
    clipped = ratio.clamp(1.0 - clip, 1.0 + clip)
    loss = -torch.minimum(ratio * advantages, clipped * advantages).mean()
    with torch.no_grad():
        return loss, {
            "actor_loss": loss.detach(),
            # Schulman's low-variance estimate of KL(old, new).
            "kl": (ratio - 1.0 - log_ratio).mean(),
            "clip_fraction": (ratio != clipped).float().mean(),
        }
