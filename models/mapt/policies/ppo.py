"""PPO for teams of agents: from a rollout and its rewards to gradient steps.

`PPOUpdate` is the update of MAPPO (Yu et al. 2022), MAT and MAT-Dec (Wen et al. 2022): the three differ in their
networks only. `HAPPOUpdate` is the sequential update of HAPPO (Kuba et al. 2022).
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional as F

from mapt.device import to_device
from mapt.errors import InvalidRollout, TrainingDiverged
from mapt.policies.config import PolicyConfig
from mapt.policies.kernels import Adam, clip_grad_norm_
from mapt.policies.networks import ActorCritic, Policy
from mapt.policies.rollout import Rollout

#: Adam's epsilon, as in the reference implementation of PPO: gradients of normalised losses are small.
ADAM_EPSILON = 1e-5

Floats = NDArray[np.floating]
Bools = NDArray[np.bool_]
#: Scalars of one gradient step by name.
Metrics = dict[str, Tensor]


@dataclass(frozen=True, slots=True)
class Batch:
    """B samples of a rollout, ready for an update."""

    #: (N, B, C), normalised.
    observations: Tensor
    #: (N, B, A), as sampled.
    actions: Tensor
    #: (N, B), of the policy that acted.
    log_probs: Tensor
    #: (N, B), normalised.
    advantages: Tensor
    #: (B, S), normalised.
    state: Tensor
    #: (B, N), normalised by PopArt.
    returns: Tensor
    #: bool (N, B, A); None if every action is always available.
    available: Tensor | None = None
    #: (N, B): 1 where the agent had a choice, 0 where it had a single action, as a dead agent has; None if all always
    #: have a choice.
    alive: Tensor | None = None

    def samples(self, index: Tensor) -> "Batch":
        """The samples of an index (b,)."""
        return Batch(
            self.observations.index_select(1, index),
            self.actions.index_select(1, index),
            self.log_probs.index_select(1, index),
            self.advantages.index_select(1, index),
            self.state.index_select(0, index),
            self.returns.index_select(0, index),
            None if self.available is None else self.available.index_select(1, index),
            None if self.alive is None else self.alive.index_select(1, index),
        )

    def of_agent(self, agent: int) -> "Batch":
        """One agent's samples, (1, B, ...); state and returns stay those of the team."""
        own = slice(agent, agent + 1)
        return replace(
            self,
            observations=self.observations[own],
            actions=self.actions[own],
            log_probs=self.log_probs[own],
            advantages=self.advantages[own],
            available=None if self.available is None else self.available[own],
            alive=None if self.alive is None else self.alive[own],
        )


class Update(Protocol):
    """Improves a policy on a batch."""

    #: One for each loss; the learner sets their learning rate and stores their state, in this order.
    optimisers: list[Adam]

    def run(self, batch: Batch, generator: torch.Generator) -> list[Metrics]:
        """Take `epochs` passes over the batch; return the metrics of the gradient steps of the last pass.

        Args:
            generator: on the CPU; shuffles the samples.

        Raises:
            TrainingDiverged: if a gradient is not finite; the failed step is not taken.
        """
        ...


class PPOUpdate:
    """MAPPO, MAT and MAT-Dec: one loss for all agents and the critic."""

    def __init__(self, policy: Policy, config: PolicyConfig) -> None:
        self._policy, self._config = policy, config
        self.optimisers = [Adam(policy.parameters(), config.learning_rate, ADAM_EPSILON)]

    def run(self, batch: Batch, generator: torch.Generator) -> list[Metrics]:
        config, (optimiser,) = self._config, self.optimisers
        metrics: list[Metrics] = []
        for epoch in range(config.epochs):
            for minibatch in shuffled_minibatches(batch, config, generator):
                log_probs, entropy, values = self._policy.evaluate_actions(
                    minibatch.observations, minibatch.state, minibatch.actions, minibatch.available
                )
                log_ratio = log_probs - minibatch.log_probs
                actor_loss = clipped_surrogate_loss(log_ratio, minibatch.advantages, config.clip, minibatch.alive)
                entropy = mean_of_alive(entropy, minibatch.alive)
                critic_loss = F.mse_loss(values, minibatch.returns)
                loss = actor_loss + config.value_weight * critic_loss
                if config.entropy_weight:
                    loss = loss - config.entropy_weight * entropy

                optimiser.zero_grad()
                loss.backward()
                gradient_norm = clip_gradients(optimiser.parameters, config.max_gradient_norm)
                optimiser.step()
                if epoch == config.epochs - 1:
                    step_metrics = {"critic_loss": critic_loss.detach(), "gradient_norm": gradient_norm}
                    metrics.append(step_metrics | actor_metrics(actor_loss, entropy, log_ratio, minibatch, config))
        return metrics


class HAPPOUpdate:
    """HAPPO: updates the actors one after the other in random order, then the critic.

    Each agent's advantages are weighted by the factor M, the product of the probability ratios of the agents updated
    before it (Kuba et al. 2022, algorithm 4).
    """

    def __init__(self, policy: ActorCritic, config: PolicyConfig) -> None:
        self._critic, self._config = policy.critic, config
        self._actors = [policy.actor.of_agent(agent) for agent in range(policy.spec.n_agents)]
        self.optimisers = [
            Adam(network.parameters(), config.learning_rate, ADAM_EPSILON) for network in (*self._actors, policy.critic)
        ]

    def run(self, batch: Batch, generator: torch.Generator) -> list[Metrics]:
        config, metrics = self._config, list[Metrics]()
        *actor_optimisers, critic_optimiser = self.optimisers
        factor = torch.ones_like(batch.log_probs[:1])
        for agent in torch.randperm(len(self._actors), generator=generator).tolist():
            actor, optimiser, own = self._actors[agent], actor_optimisers[agent], batch.of_agent(agent)
            weighted = replace(own, advantages=factor * own.advantages)
            for epoch in range(config.epochs):
                for minibatch in shuffled_minibatches(weighted, config, generator):
                    distribution = actor(minibatch.observations, minibatch.available)
                    log_ratio = distribution.log_prob(minibatch.actions) - minibatch.log_probs
                    actor_loss = clipped_surrogate_loss(log_ratio, minibatch.advantages, config.clip, minibatch.alive)
                    loss = actor_loss
                    if config.entropy_weight:
                        loss = loss - config.entropy_weight * mean_of_alive(distribution.entropy(), minibatch.alive)

                    optimiser.zero_grad()
                    loss.backward()
                    gradient_norm = clip_gradients(optimiser.parameters, config.max_gradient_norm)
                    optimiser.step()
                    if epoch == config.epochs - 1:
                        entropy = mean_of_alive(distribution.entropy(), minibatch.alive)
                        step_metrics = actor_metrics(actor_loss, entropy, log_ratio, minibatch, config)
                        metrics.append(step_metrics | {"gradient_norm": gradient_norm})
            metrics.append({"factor_spread": factor.std()})
            with torch.no_grad():
                log_probs = actor(own.observations, own.available).log_prob(own.actions)
                factor = factor * (log_probs - own.log_probs).exp()

        for epoch in range(config.epochs):
            for minibatch in shuffled_minibatches(batch, config, generator):
                critic_loss = F.mse_loss(self._critic(minibatch.observations, minibatch.state), minibatch.returns)
                critic_optimiser.zero_grad()
                (config.value_weight * critic_loss).backward()
                clip_gradients(critic_optimiser.parameters, config.max_gradient_norm)
                critic_optimiser.step()
                if epoch == config.epochs - 1:
                    metrics.append({"critic_loss": critic_loss.detach()})
        return metrics


def clipped_surrogate_loss(log_ratio: Tensor, advantages: Tensor, clip: float, alive: Tensor | None = None) -> Tensor:
    """Negative of PPO's clipped surrogate objective (Schulman et al. 2017, eq. 7), ().

    Args:
        log_ratio: log-probabilities of the actions now, less those when they were sampled, any shape.
        advantages: of the same shape.
        clip: PPO's epsilon.
        alive: of the same shape; the mean is over the ones only.
    """
    ratio = log_ratio.exp()
    gain = torch.min(ratio * advantages, ratio.clamp(1.0 - clip, 1.0 + clip) * advantages)
    return -(gain if alive is None else gain * alive).mean() / share_alive(alive)


def mean_of_alive(mean: Tensor, alive: Tensor | None) -> Tensor:
    """The mean over living agents, (), from the mean over all of a quantity that is 0 for the others."""
    return mean / share_alive(alive)


def share_alive(alive: Tensor | None) -> Tensor | float:
    """The share of living agents; 1 if there are none, whose losses are 0 in any case."""
    if alive is None:
        return 1.0
    share = alive.mean()
    return torch.where(share > 0, share, 1.0)


def clip_gradients(parameters: Sequence[nn.Parameter], max_norm: float) -> Tensor:
    """Scale gradients down to `max_norm`; return their norm () before.

    Raises:
        TrainingDiverged: if the norm is not finite.
    """
    norm = clip_grad_norm_(parameters, max_norm)
    if not math.isfinite(norm):
        raise TrainingDiverged(f"The gradient norm is {norm.item()}. Lower the learning rate, and check the rewards.")
    return norm


@torch.no_grad()
def actor_metrics(
    actor_loss: Tensor, entropy: Tensor, log_ratio: Tensor, minibatch: Batch, config: PolicyConfig
) -> Metrics:
    """Metrics of one gradient step: loss, entropy, and how far the policy has moved from the one that acted."""
    # An agent without a choice has a ratio of 1, which adds 0 to both sums.
    ratio = log_ratio.exp()
    return {
        "actor_loss": actor_loss.detach(),
        "entropy": entropy.detach(),
        # Schulman's low-variance estimate of KL(old, new).
        "kl": mean_of_alive((ratio - 1.0 - log_ratio).mean(), minibatch.alive),
        "clip_fraction": mean_of_alive(((ratio - 1.0).abs() > config.clip).float().mean(), minibatch.alive),
    }


def shuffled_minibatches(batch: Batch, config: PolicyConfig, generator: torch.Generator) -> Iterator[Batch]:
    """The minibatches of one pass over the batch, in random order."""
    order = torch.randperm(config.steps_per_rollout, generator=generator).to(batch.returns.device)
    for index in order.chunk(config.minibatches):
        yield batch.samples(index)


@torch.no_grad()
def make_batch(
    policy: Policy, rollout: Rollout, rewards: NDArray[np.float32], config: PolicyConfig, gamma: float
) -> tuple[Batch, dict[str, float]]:
    """Compute advantages and returns, normalise them and the inputs, and update PopArt's statistics.

    Args:
        rewards: (L, E, N), from `team_rewards`.
        gamma: discount per step.

    Returns:
        The batch of B = L * E samples, and metrics by name.
    """

    def values(observations: Tensor, state: Tensor) -> NDArray[np.float32]:
        return policy.values(observations, state).unflatten(0, rollout.rewards.shape).cpu().numpy()

    observations, state = policy.normalise(*raw_inputs(policy, rollout))
    final_observations = _agent_first(policy, rollout.final_observations)
    final_inputs = policy.normalise(final_observations, _flat(policy, rollout.final_state))
    current_values = values(observations, state)
    advantages = gae(
        rewards,
        current_values,
        values(*final_inputs),
        rollout.terminated,
        rollout.truncated,
        gamma=gamma,
        gae_lambda=config.gae_lambda,
    )
    returns = advantages + current_values
    metrics = {
        "explained_variance": float(1.0 - advantages.var() / max(returns.var(), 1e-12)),
        "return_mean": float(returns.mean()),
        "return_std": float(returns.std()),
    }
    available = rollout.available_actions
    alive = None if available is None else available.sum(axis=-1) > 1
    # Normalised over all agents together: an agent whose actions matter little keeps its small advantages.
    counted = advantages if alive is None or not alive.any() else advantages[alive]
    advantages = (advantages - counted.mean()) / (counted.std() + 1e-8)

    flat_returns = _flat(policy, returns)
    policy.critic.update_statistics(flat_returns)
    batch = Batch(
        observations=observations,
        actions=_agent_first(policy, rollout.sampled_actions),
        log_probs=_agent_first(policy, rollout.log_probs),
        advantages=_agent_first(policy, advantages),
        state=state,
        returns=policy.critic.statistics.normalise(flat_returns),
        available=None if available is None else _agent_first(policy, available),
        # The critic's loss counts dead agents, too: the values of the steps before their death build on these.
        alive=None if alive is None else _agent_first(policy, alive).float(),
    )
    return batch, metrics


def gae(
    rewards: Floats,
    values: Floats,
    next_values: Floats,
    terminated: Bools,
    truncated: Bools,
    *,
    gamma: float,
    gae_lambda: float,
) -> Floats:
    """Generalised advantage estimates (L, E, N) (Schulman et al. 2016) of a rollout in which episodes may end.

    The value of the last state of a truncated episode is bootstrapped; after termination it is zero. In both cases
    no later reward is included.

    Args:
        rewards: (L, E, N).
        values: (L, E, N), of the states in which the actions were taken.
        next_values: (L, E, N), of the states that followed, before any reset.
        terminated, truncated: (L, E).
        gamma, gae_lambda: discount per step and the estimator's lambda.
    """
    not_terminated = (~terminated)[..., None]
    delta = rewards + gamma * next_values * not_terminated - values
    decay = gamma * gae_lambda * (~(terminated | truncated))[..., None].astype(values.dtype)
    advantages = np.empty_like(values)
    advantage = np.zeros_like(values[0])
    for t in reversed(range(len(values))):
        advantage = delta[t] + decay[t] * advantage
        advantages[t] = advantage
    return advantages


def team_rewards(rewards: NDArray[np.floating], rollout: Rollout) -> NDArray[np.float32]:
    """Rewards (L, E, N) from a shared reward (L, E) or one per agent (L, E, N).

    Raises:
        InvalidRollout: if the rewards have another shape or are not finite.
    """
    shared, individual = rollout.rewards.shape, rollout.log_probs.shape
    if rewards.shape not in {shared, individual}:
        raise InvalidRollout(f"Rewards must have the shape {shared} or {individual}, got {rewards.shape}.")
    if not np.isfinite(rewards).all():
        raise InvalidRollout("Rewards must be finite numbers.")
    if rewards.shape == shared:
        rewards = np.broadcast_to(rewards[..., None], individual)
    return rewards.astype(np.float32)


def raw_inputs(policy: Policy, rollout: Rollout) -> tuple[Tensor, Tensor]:
    """Observations (N, B, C) and state (B, S) of a rollout, not normalised, on the policy's device."""
    return _agent_first(policy, rollout.observations), _flat(policy, rollout.state)


def _flat(policy: Policy, array: NDArray[np.generic]) -> Tensor:
    """(L, E, ...) -> (B, ...)."""
    return to_device(array, policy.device).flatten(0, 1)


def _agent_first(policy: Policy, array: NDArray[np.generic]) -> Tensor:
    """(L, E, N, ...) -> (N, B, ...)."""
    return _flat(policy, array).transpose(0, 1).contiguous()
