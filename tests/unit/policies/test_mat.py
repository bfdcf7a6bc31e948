"""The transformer: autoregressive sampling equals one masked pass, and each agent sees only preceding actions."""

import dataclasses

import pytest
import torch

from mapt.policies import PolicyConfig
from mapt.policies.mat import Encoder, MultiAgentTransformer
from mapt.tasks import TaskSpec, task_spec

pytestmark = pytest.mark.numerics

CHEETAH = task_spec("HalfCheetah-6x1")
CHOICES = dataclasses.replace(CHEETAH, action_dim=5, agent_action_dims=(), discrete_actions=True)
B = 9


def policy(spec: TaskSpec, layers: int = 2, heads: int = 2) -> MultiAgentTransformer:
    """A policy with weights so large that every input affects the outputs."""
    torch.manual_seed(0)
    net = MultiAgentTransformer(spec, PolicyConfig(algorithm="mat", width=16, layers=layers, heads=heads))
    with torch.no_grad():
        for parameter in net.parameters():
            parameter.add_(0.3 * torch.randn_like(parameter))
    return net


@dataclasses.dataclass
class Sample:
    """Observations (N, B, C), sampled actions (N, B, A), their log-probabilities, and the available actions."""

    observations: torch.Tensor
    actions: torch.Tensor
    log_probs: torch.Tensor
    available: torch.Tensor | None

    def evaluate(self, net: MultiAgentTransformer) -> tuple[torch.Tensor, torch.Tensor]:
        """Log-probabilities (N, B) in one pass over all agents, and values (B, N)."""
        log_probs, _, values = net.evaluate_actions(self.observations, torch.zeros(B, 1), self.actions, self.available)
        return log_probs, values


def sample(net: MultiAgentTransformer) -> Sample:
    """Actions sampled agent by agent for random observations."""
    torch.manual_seed(1)
    spec, available = net.spec, None
    if spec.discrete_actions:
        available = torch.rand(spec.n_agents, B, spec.action_dim) < 0.5
        available[..., 1] = True
    observations = torch.randn(spec.n_agents, B, spec.observation_dim)
    noise = net.noise((), B, torch.Generator().manual_seed(2))
    with torch.no_grad():
        actions, log_probs = net.sample(observations, noise, available)
    return Sample(observations, actions, log_probs, available)


@pytest.mark.parametrize("spec", [CHEETAH, CHOICES], ids=["continuous", "discrete"])
@pytest.mark.parametrize(("layers", "heads"), [(1, 1), (3, 4)])
def test_sampling_agent_by_agent_equals_one_masked_pass(spec: TaskSpec, layers: int, heads: int) -> None:
    net = policy(spec, layers, heads)
    sampled = sample(net)
    log_probs, _ = sampled.evaluate(net)
    torch.testing.assert_close(log_probs, sampled.log_probs, atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("spec", [CHEETAH, CHOICES], ids=["continuous", "discrete"])
def test_agents_see_only_the_actions_of_preceding_agents(spec: TaskSpec) -> None:
    net = policy(spec)
    sampled = dataclasses.replace(sample(net), available=None)
    changed = sampled.actions.clone()
    changed[3] = changed[3].roll(1, -1) if spec.discrete_actions else changed[3] + 1.0
    before, _ = sampled.evaluate(net)
    after, _ = dataclasses.replace(sampled, actions=changed).evaluate(net)
    assert torch.equal(before[:3], after[:3])
    assert not torch.isclose(before[4:], after[4:], atol=1e-4).all(dim=1).any()


def test_every_agents_observation_affects_all_agents() -> None:
    net = policy(CHEETAH)
    sampled = sample(net)
    observations = sampled.observations.clone()
    observations[5] += 1.0
    before = sampled.evaluate(net)
    after = dataclasses.replace(sampled, observations=observations).evaluate(net)
    assert not torch.isclose(before[0], after[0], atol=1e-4).all(dim=1).any()
    assert not torch.isclose(before[1], after[1], atol=1e-4).all(dim=0).any()


def test_encoder_is_equivariant_to_permutations_of_the_agents() -> None:
    torch.manual_seed(0)
    encoder = Encoder(4, PolicyConfig(width=16, layers=2, heads=2))
    observations, order = torch.randn(B, 6, 4), torch.randperm(6)
    torch.testing.assert_close(encoder(observations[:, order]), encoder(observations)[:, order], atol=1e-5, rtol=1e-5)


def test_unavailable_actions_are_never_sampled() -> None:
    net = policy(CHOICES)
    with torch.no_grad():
        # Action 4 is by far the most likely one.
        net.decoder.head[-1].get_parameter("bias")[4] = 100.0
    sampled = sample(net)
    assert sampled.available is not None
    assert not (sampled.actions.bool() & ~sampled.available).any()
    assert (sampled.actions[..., 4].bool() == sampled.available[..., 4]).all()
