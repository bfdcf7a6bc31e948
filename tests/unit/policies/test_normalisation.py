"""Running statistics against the whole sample."""

import pytest
import torch

from learning.identity_task import IdentityTask
from mapt.policies import PolicyConfig
from mapt.policies.mat import EncoderCritic
from mapt.policies.networks import Critic, StateCritic
from mapt.policies.normalisation import INPUT_LIMIT, InputNormaliser, ReturnStatistics

pytestmark = pytest.mark.numerics

SPEC = IdentityTask(1).spec


def samples(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed))


def test_batches_in_turn_give_the_statistics_of_the_whole() -> None:
    inputs = samples(2, 300, 4) * 5 + 100
    normaliser = InputNormaliser(2, 1, 4, over=1)
    for part in inputs.split([1, 99, 200], dim=1):
        normaliser.absorb(part)
    torch.testing.assert_close(normaliser.mean, inputs.double().mean(1, keepdim=True))
    normalised = normaliser(inputs)
    torch.testing.assert_close(normalised.mean(1), torch.zeros(2, 4), atol=1e-4, rtol=0)
    torch.testing.assert_close(normalised.std(1, correction=0), torch.ones(2, 4), atol=1e-4, rtol=0)


def test_a_constant_input_passes_as_it_is() -> None:
    inputs = samples(1, 50, 2)
    inputs[..., 1] = 1.0
    normaliser = InputNormaliser(1, 1, 2, over=1)
    normaliser.absorb(inputs)
    torch.testing.assert_close(normaliser(inputs)[..., 1], inputs[..., 1])


def test_inputs_far_out_are_cut() -> None:
    normaliser = InputNormaliser(1, 1, 1, over=1)
    normaliser.absorb(samples(1, 50, 1))
    assert normaliser(torch.full((1, 1, 1), 1e6)).item() == INPUT_LIMIT


def test_the_first_returns_alone_set_the_statistics() -> None:
    returns = samples(500, 3) * torch.tensor([1.0, 10.0, 1000.0]) + 7
    statistics = ReturnStatistics(3, rate=0.1)
    statistics.absorb(returns)
    torch.testing.assert_close(statistics.mean, returns.mean(0))
    torch.testing.assert_close(statistics.std, returns.std(0, correction=0), rtol=1e-3, atol=0)


def test_statistics_forget_old_returns() -> None:
    statistics = ReturnStatistics(1, rate=0.2)
    statistics.absorb(samples(100, 1) * 1000)
    for seed in range(120):
        statistics.absorb(samples(100, 1, seed=seed) + 5)
    assert statistics.mean.item() == pytest.approx(5, abs=0.1)
    assert statistics.std.item() == pytest.approx(1, abs=0.1)


def test_a_transform_moves_the_statistics_as_it_would_the_returns() -> None:
    returns = samples(200, 2) * 3 + 1
    moved, direct = ReturnStatistics(2, rate=0.3), ReturnStatistics(2, rate=0.3)
    moved.absorb(returns)
    moved.transform(4.0, -20.0)
    direct.absorb(returns * 4.0 - 20.0)
    for statistics in (moved, direct):
        statistics.absorb(returns)
    torch.testing.assert_close(moved.mean, direct.mean)
    torch.testing.assert_close(moved.std, direct.std, rtol=1e-4, atol=0)


@pytest.fixture(params=[StateCritic, EncoderCritic])
def critic(request: pytest.FixtureRequest) -> Critic:
    torch.manual_seed(0)
    return request.param(SPEC, PolicyConfig(value_statistics_rate=0.5, width=8))


def values(critic: Critic, n: int = 64) -> torch.Tensor:
    """Of some moments (n, N), in units of the reward."""
    observations = torch.stack([samples(n, SPEC.observation_dim)] * SPEC.n_agents)
    return critic.statistics.denormalise(critic(observations, critic.normalised(samples(n, SPEC.state_dim)))).detach()


def test_new_statistics_leave_every_value_as_it_was(critic: Critic) -> None:
    torch.nn.init.normal_(critic.last_layer().weight)
    critic.absorb_returns(samples(256, SPEC.n_agents) * 3 + 4)
    before = values(critic)
    critic.absorb_returns(samples(256, SPEC.n_agents) * 300 - 40)
    torch.testing.assert_close(values(critic), before, rtol=1e-4, atol=1e-3)
    assert critic.statistics.std.min() > 150


def test_a_critic_that_has_learned_nothing_starts_from_the_mean_return(critic: Critic) -> None:
    returns = samples(256, SPEC.n_agents) * 300 - 40
    torch.testing.assert_close(values(critic), torch.zeros(64, SPEC.n_agents))
    critic.absorb_returns(returns)
    torch.testing.assert_close(values(critic), critic.statistics.mean.expand(64, SPEC.n_agents))
    torch.testing.assert_close(critic.statistics.mean.mean(), returns.mean())
