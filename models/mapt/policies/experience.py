"""From a rollout and its rewards to what an update reads."""

from collections.abc import Iterator

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mapt.policies.config import PolicyConfig
from mapt.policies.errors import InvalidRewards
from mapt.policies.gae import advantages
from mapt.policies.policy import Batch, Policy
from mapt.policies.rollout import Rollout


def checked_rewards(rewards: NDArray[np.floating], rollout: Rollout) -> NDArray[np.float32]:
    """Rewards (L, E, N) from those of the team (L, E) or of each agent (L, E, N).

    Raises:
        InvalidRewards: if the shape is another or a number is not finite.
    """
    shared, individual = rollout.rewards.shape, rollout.log_probs.shape
    if rewards.shape not in {shared, individual}:
        raise InvalidRewards(f"Rewards must have the shape {shared} or {individual}, got {rewards.shape}.")
    if not np.isfinite(rewards).all():
        raise InvalidRewards("Rewards must be finite numbers.")
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
