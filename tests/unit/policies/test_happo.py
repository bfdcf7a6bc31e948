"""HAPPO's sequential update against one written out agent by agent and sample by sample."""

import math

import pytest
import torch
from torch import nn

from learning.identity_task import IdentityTask
from mapt.policies import Learner, PolicyConfig
from mapt.policies.kernels import EPSILON
from mapt.policies.ppo import checked_rewards, prepare

pytestmark = pytest.mark.numerics

CONFIG = PolicyConfig.named(
    "happo", n_envs=4, rollout_steps=6, epochs=3, minibatches=1, hidden=[5], learning_rate=0.02, clip=0.05, device="cpu"
)


def log_density(net: nn.Module, log_std: torch.Tensor, seen: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
    distance = (action - net(seen)) / log_std.exp()
    return (-0.5 * distance**2 - log_std - 0.5 * math.log(2 * math.pi)).sum()


def test_every_agent_is_updated_with_the_factor_of_those_before_it() -> None:
    """One minibatch, so that its order does not matter, but several passes, so that ratios leave 1 and are clipped."""
    learner = Learner(IdentityTask(4), CONFIG)
    twin = Learner(IdentityTask(4), CONFIG)
    rollout = learner.collect()
    twin.collect()

    # The twin gives the batch and the networks at the start; its generator then gives the same order of agents.
    batch, _ = prepare(twin.policy, rollout, checked_rewards(rollout.rewards, rollout), CONFIG)
    order = torch.randperm(3, generator=twin._generator).tolist()
    start = {name: tensor.clone() for name, tensor in twin.policy.actor.state_dict().items()}
    n_samples = CONFIG.steps_per_rollout

    factor = [1.0] * n_samples
    expected: dict[int, dict[str, torch.Tensor]] = {}
    for agent in order:
        net = nn.Sequential(nn.Linear(2, 5), nn.Tanh(), nn.Linear(5, 1))
        for layer in (0, 2):
            net[layer].weight = nn.Parameter(start[f"network.{layer}.weight"][agent].T.clone())
            net[layer].bias = nn.Parameter(start[f"network.{layer}.bias"][agent, 0].clone())
        log_std = nn.Parameter(start["log_std"][agent, 0].clone())
        parameters = [*net.parameters(), log_std]
        adam = torch.optim.Adam(parameters, lr=CONFIG.learning_rate, eps=EPSILON)
        for _ in range(CONFIG.epochs):
            gain = torch.zeros(())
            for b in range(n_samples):
                now = log_density(net, log_std, batch.observations[agent, b], batch.actions[agent, b])
                ratio = torch.exp(now - batch.log_probs[agent, b])
                weighed = factor[b] * batch.advantages[agent, b]
                gain = gain + torch.min(ratio * weighed, ratio.clamp(0.95, 1.05) * weighed)
            adam.zero_grad()
            (-gain / n_samples).backward()
            nn.utils.clip_grad_norm_(parameters, CONFIG.max_gradient_norm)
            adam.step()
        for b in range(n_samples):
            now = log_density(net, log_std, batch.observations[agent, b], batch.actions[agent, b])
            factor[b] *= math.exp(now.item() - batch.log_probs[agent, b].item())
        expected[agent] = {"0.weight": net[0].weight.T, "2.weight": net[2].weight.T, "log_std": log_std[None]}
    assert max(factor) > 1.02

    metrics = learner.update(rollout, rollout.rewards)
    assert metrics["clip_fraction"] > 0
    actor = learner.policy.actor
    for agent in range(3):
        for name, tensor in expected[agent].items():
            ours = actor.get_parameter(name if name == "log_std" else f"network.{name}")[agent]
            torch.testing.assert_close(ours, tensor, atol=1e-5, rtol=1e-4)
