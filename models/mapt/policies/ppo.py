"""How the gradient steps of an update are taken: all networks at once, or agent after agent."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.autograd.function import once_differentiable
from torch.nn import functional as F

from mapt.errors import InvalidRollout
from mapt.policies.config import PolicyConfig
from mapt.policies.distributions import ActionDistribution
from mapt.policies.networks import ActorCritic, Batch, Policy
from mapt.policies.rollout import Rollout

#: Takes a gradient step of a group of parameters on a loss, and gives the gradient's norm.
Step = Callable[[Tensor, int], Tensor]
Metrics = dict[str, Tensor]


class Update(Protocol):
    """Improves a policy on a batch."""

    @property
    def groups(self) -> list[list[nn.Parameter]]:
        """What `step` moves: every parameter of a group has a gradient of each of that group's losses."""
        ...

    def run(self, batch: Batch, step: Step, generator: torch.Generator) -> list[Metrics]:
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
        self.groups = [list(policy.parameters())]

    def run(self, batch: Batch, step: Step, generator: torch.Generator) -> list[Metrics]:
        parts = minibatches(batch, self._config, generator)
        return [self._step(part, step, told=is_last_pass) for part, is_last_pass in parts][-self._config.minibatches :]

    def _step(self, batch: Batch, step: Step, *, told: bool) -> Metrics:
        now = self._policy.evaluate(batch)
        log_ratio = now.log_probs - batch.log_probs
        actor_loss = clipped_loss(log_ratio, batch.advantages, self._config.clip)
        critic_loss = F.mse_loss(now.values, batch.returns)
        metrics = {"critic_loss": critic_loss.detach()}
        if told:
            metrics |= actor_metrics(actor_loss, log_ratio, now.distribution, self._config)
        loss = with_entropy(actor_loss, now.distribution, self._config) + self._config.value_weight * critic_loss
        return metrics | {"gradient_norm": step(loss, 0)}


class SequentialUpdate:
    """HAPPO (Kuba et al. 2022): agents in random order, each minding what those before it have become.

    An agent's advantages are weighed by the factor M, how much likelier the agents before it now are to act as they
    did. The critic follows by itself.
    """

    def __init__(self, policy: ActorCritic, config: PolicyConfig) -> None:
        self._critic, self._config = policy.critic, config
        self._actors = [policy.actor.alone(agent) for agent in range(policy.spec.n_agents)]
        self.groups = [*(list(actor.parameters()) for actor in self._actors), list(policy.critic.parameters())]

    def run(self, batch: Batch, step: Step, generator: torch.Generator) -> list[Metrics]:
        config, metrics = self._config, list[Metrics]()
        factor = torch.ones_like(batch.log_probs[0])
        for agent in torch.randperm(len(self._actors), generator=generator).tolist():
            own = batch.of_agent(agent)
            parts = minibatches(replace(own, advantages=factor * own.advantages), config, generator)
            steps = [self._agent_step(agent, part, step, told=is_last_pass) for part, is_last_pass in parts]
            metrics += [*steps[-config.minibatches :], {"factor_spread": factor.std()}]
            with torch.no_grad():
                log_probs, _ = self._actors[agent].evaluate(own.observations, own.actions, own.available)
                factor = factor * (log_probs - own.log_probs)[0].exp()
        steps = [self._critic_step(part, step) for part, _ in minibatches(batch, config, generator)]
        return metrics + steps[-config.minibatches :]

    def _agent_step(self, agent: int, batch: Batch, step: Step, *, told: bool) -> Metrics:
        log_probs, distribution = self._actors[agent].evaluate(batch.observations, batch.actions, batch.available)
        log_ratio = log_probs - batch.log_probs
        loss = clipped_loss(log_ratio, batch.advantages, self._config.clip)
        metrics = actor_metrics(loss, log_ratio, distribution, self._config) if told else {}
        return metrics | {"gradient_norm": step(with_entropy(loss, distribution, self._config), agent)}

    def _critic_step(self, batch: Batch, step: Step) -> Metrics:
        loss = F.mse_loss(self._critic(batch.observations, batch.state), batch.returns)
        step(self._config.value_weight * loss, len(self._actors))
        return {"critic_loss": loss.detach()}


def clipped_loss(log_ratio: Tensor, advantages: Tensor, clip: float) -> Tensor:
    """PPO's clipped objective (Schulman et al. 2017, eq. 7), to be made small, ().

    Args:
        log_ratio: log of how much likelier the actions have become, any shape.
        advantages: of the same shape.
        clip: change of probability beyond which nothing is earned.
    """
    loss: Tensor = _ClippedLoss.apply(log_ratio, advantages, clip)  # pyright: ignore[reportAssignmentType]
    return loss


class _ClippedLoss(torch.autograd.Function):
    """One node instead of eight, to the bit what autograd makes of the formula."""

    @staticmethod
    def forward(ctx: Any, log_ratio: Tensor, advantages: Tensor, clip: float) -> Tensor:
        ratio = log_ratio.exp()
        free, clipped = ratio * advantages, ratio.clamp(1.0 - clip, 1.0 + clip) * advantages
        # Where the clipped one is the smaller, the ratio is beyond the clip and the gradient zero.
        ctx.save_for_backward(torch.where(free <= clipped, advantages * (-1.0 / advantages.numel()), 0.0) * ratio)
        return -torch.minimum(free, clipped).mean()

    @staticmethod
    @once_differentiable
    def backward(  # pyright: ignore[reportIncompatibleMethodOverride]  (the decorator's declaration)
        ctx: Any, *gradients: Tensor
    ) -> tuple[Tensor | None, ...]:
        (by_log_ratio,) = ctx.saved_tensors
        return gradients[0] * by_log_ratio, None, None


def with_entropy(loss: Tensor, distribution: ActionDistribution, config: PolicyConfig) -> Tensor:
    """The loss, made smaller by the entropy of the actions where that counts."""
    return loss - config.entropy_weight * distribution.entropy() if config.entropy_weight else loss


@torch.no_grad()
def actor_metrics(loss: Tensor, log_ratio: Tensor, distribution: ActionDistribution, config: PolicyConfig) -> Metrics:
    """What a step's loss without entropy, its log-ratios and its actions say, by name."""
    ratio = log_ratio.exp()
    return {
        "actor_loss": loss.detach(),
        # Schulman's low-variance estimate of KL(old, new).
        "kl": (ratio - 1.0 - log_ratio).mean(),
        "clip_fraction": (ratio != ratio.clamp(1.0 - config.clip, 1.0 + config.clip)).float().mean(),
        "entropy": distribution.entropy(),
    }


def checked_rewards(rewards: NDArray[np.floating], rollout: Rollout) -> NDArray[np.float32]:
    """Rewards (L, E, N) from those of the team (L, E) or of each agent (L, E, N).

    Raises:
        InvalidRollout: if the shape is another or a number is not finite.
    """
    shared, individual = rollout.rewards.shape, rollout.log_probs.shape
    if rewards.shape not in {shared, individual}:
        raise InvalidRollout(f"Rewards must have the shape {shared} or {individual}, got {rewards.shape}.")
    if not np.isfinite(rewards).all():
        raise InvalidRollout("Rewards must be finite numbers.")
    if rewards.shape == shared:
        rewards = np.broadcast_to(rewards[..., None], individual)
    return rewards.astype(np.float32)


@torch.no_grad()
def prepare(
    policy: Policy, rollout: Rollout, rewards: NDArray[np.float32], config: PolicyConfig
) -> tuple[Batch, dict[str, float]]:
    """Advantages and returns by GAE, inputs normalised, agents first; renews the critic's units.

    Args:
        rewards: (L, E, N).

    Returns:
        The rollout's B = L * E samples, and metrics by name.
    """
    observations, state = inputs(policy, rollout)
    statistics = policy.critic.statistics

    def values(normalised: tuple[Tensor, Tensor]) -> NDArray[np.float32]:
        found = statistics.denormalise(policy.critic(*normalised))
        return found.unflatten(0, rollout.rewards.shape).cpu().numpy()

    normalised = policy.normalised(observations, state)
    now = values(normalised)
    later = values(
        policy.normalised(_agent_first(policy, rollout.final_observations), _flat(policy, rollout.final_state))
    )
    gains = advantages(
        rewards,
        now,
        later,
        rollout.terminated,
        rollout.truncated,
        gamma=config.gamma,
        gae_lambda=config.gae_lambda,
    )
    returns = gains + now
    metrics = {
        "explained_variance": float(1.0 - gains.var() / max(returns.var(), 1e-12)),
        "return_mean": float(returns.mean()),
        "return_std": float(returns.std()),
    }
    # Over all agents at once: an agent whose actions matter little keeps its small advantages.
    gains = (gains - gains.mean()) / (gains.std() + 1e-8)

    flat_returns = _flat(policy, returns)
    policy.critic.absorb_returns(flat_returns)
    available = rollout.available_actions
    batch = Batch(
        observations=normalised[0],
        actions=_agent_first(policy, rollout.drawn_actions),
        log_probs=_agent_first(policy, rollout.log_probs),
        advantages=_agent_first(policy, gains),
        state=normalised[1],
        returns=statistics.normalise(flat_returns),
        available=None if available is None else _agent_first(policy, available),
    )
    return batch, metrics


def inputs(policy: Policy, rollout: Rollout) -> tuple[Tensor, Tensor]:
    """Raw observations (N, B, C) and state (B, S) of a rollout, on the policy's device."""
    return _agent_first(policy, rollout.observations), _flat(policy, rollout.state)


def minibatches(batch: Batch, config: PolicyConfig, generator: torch.Generator) -> Iterator[tuple[Batch, bool]]:
    """Samples of each gradient step of all passes, each pass in an order of its own, and whether it is the last pass.

    A pass is put in order whole, which takes a tenth of the time of picking each step's samples.
    """
    size = config.steps_per_rollout // config.minibatches
    for number in range(config.epochs):
        order = torch.randperm(config.steps_per_rollout, generator=generator)
        for part in batch.pick(order.to(batch.returns.device)).split(size):
            yield part, number == config.epochs - 1


def _flat(policy: Policy, array: NDArray[np.generic]) -> Tensor:
    """(L, E, ...) -> (B, ...)."""
    return torch.from_numpy(array).flatten(0, 1).to(policy.device)


def _agent_first(policy: Policy, array: NDArray[np.generic]) -> Tensor:
    """(L, E, N, ...) -> (N, B, ...)."""
    return _flat(policy, array).transpose(0, 1).contiguous()


Floats = NDArray[np.floating]
Bools = NDArray[np.bool_]


def advantages(
    rewards: Floats,
    values: Floats,
    next_values: Floats,
    terminated: Bools,
    truncated: Bools,
    *,
    gamma: float,
    gae_lambda: float,
) -> Floats:
    """Advantages (L, E, N) of the actions of a rollout.

    A truncated episode is cut for bookkeeping only, so the value of its last state still counts. After termination
    there is nothing to come. Neither lets the next episode's rewards flow back.

    Args:
        rewards: (L, E, N).
        values: (L, E, N), of the states in which the actions were taken.
        next_values: (L, E, N), of the states they led to, before any reset.
        terminated, truncated: (L, E).
        gamma, gae_lambda: discount per step and the estimator's lambda.
    """
    going_on = (~terminated)[..., None]
    surprise = rewards + gamma * next_values * going_on - values
    carry = gamma * gae_lambda * (~(terminated | truncated))[..., None].astype(values.dtype)
    result = np.empty_like(values)
    later = np.zeros_like(values[0])
    for t in range(len(values) - 1, -1, -1):
        later = surprise[t] + carry[t] * later
        result[t] = later
    return result
