"""Updates of the learner: inputs, invalid rewards, and changes of the reward function."""

import dataclasses

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from learning.identity_task import IdentityTask
from mapt.device import torch_threads
from mapt.errors import InvalidConfig, InvalidRollout
from mapt.policies import Learner, PolicyConfig
from mapt.policies.ppo import make_batch
from mapt.tasks import TaskStep

CONFIG = PolicyConfig(n_envs=16, rollout_steps=16, minibatches=2, epochs=4, hidden=(16,), device="cpu")


def learner(config: PolicyConfig = CONFIG) -> Learner:
    return Learner(IdentityTask(config.n_envs), config)


def weights(trained: Learner) -> torch.Tensor:
    return torch.cat([parameter.detach().ravel() for parameter in trained.policy.actor.parameters()])


def test_steps_count_environment_steps() -> None:
    trained = learner()
    trained.collect()
    trained.collect()
    assert trained.steps == 2 * 16 * 16


def test_weights_do_not_depend_on_the_number_of_cores() -> None:
    """torch starts one thread per core, and orthogonal weights of 64 x 64 differ with the number of threads."""

    def learned(n_cores: int) -> torch.Tensor:
        with torch_threads(n_cores):
            trained = learner(dataclasses.replace(CONFIG, hidden=(64, 64)))
            rollout = trained.collect()
            trained.update(rollout, rollout.rewards)
        return weights(trained)

    torch.testing.assert_close(learned(1), learned(2), rtol=0, atol=0)


def test_learner_does_not_read_the_true_reward() -> None:
    """Two learners given the same rewards learn the same, though the true rewards of one are NaN."""
    plain, other = learner(), learner()
    rollout, other_rollout = plain.collect(), other.collect()
    rewards = rollout.rewards
    plain.update(rollout, rewards)
    without_rewards = dataclasses.replace(other_rollout, rewards=np.full_like(rollout.rewards, np.nan))
    other.update(without_rewards, rewards)
    torch.testing.assert_close(weights(plain), weights(other), rtol=0, atol=0)


def test_shared_reward_equals_the_same_reward_for_each_agent() -> None:
    shared, each = learner(), learner()
    rollout = shared.collect()
    each.collect()
    shared.update(rollout, rollout.rewards)
    each.update(rollout, np.repeat(rollout.rewards[..., None], 3, axis=-1))
    torch.testing.assert_close(weights(shared), weights(each), rtol=0, atol=0)


def test_probability_ratios_of_the_first_step_are_one() -> None:
    trained = learner(dataclasses.replace(CONFIG, epochs=1, minibatches=1))
    for _ in range(3):
        rollout = trained.collect()
        metrics = trained.update(rollout, rollout.rewards)
        assert metrics["kl"] == pytest.approx(0.0, abs=1e-6)
        assert metrics["clip_fraction"] == 0.0


@pytest.mark.parametrize("factor", [1e-3, 1e3])
def test_actor_does_not_depend_on_the_scale_of_the_reward(factor: float) -> None:
    plain, scaled = learner(), learner()
    for _ in range(3):
        rollout = plain.collect()
        scaled.collect()
        plain.update(rollout, rollout.rewards)
        scaled.update(rollout, rollout.rewards * factor)
        torch.testing.assert_close(weights(plain), weights(scaled), rtol=1e-2, atol=1e-3)


class TerminatingTask(IdentityTask):
    """Episodes terminate where those of IdentityTask are truncated."""

    def step(self, actions: NDArray[np.floating]) -> TaskStep:
        step = super().step(actions)
        step.terminated, step.truncated = step.truncated, step.terminated
        return step


def test_constant_reward_makes_a_state_worth_the_steps_until_termination() -> None:
    """The last step of an episode is worth its own reward, the first of eight the most, and none is negative."""
    config = dataclasses.replace(CONFIG, gamma=0.9, gae_lambda=1.0)
    trained = Learner(TerminatingTask(16, horizon_steps=8), config)
    rollout = trained.collect()
    batch, _ = make_batch(trained.policy, rollout, np.ones(rollout.log_probs.shape, np.float32), config, config.gamma)
    returns = trained.policy.critic.statistics.denormalise(batch.returns).reshape(rollout.log_probs.shape)
    ended = torch.as_tensor(rollout.terminated)
    torch.testing.assert_close(returns[ended], torch.ones_like(returns[ended]), rtol=1e-4, atol=1e-4)
    assert returns.min() > 1 - 1e-4
    assert returns.max() == pytest.approx((1 - 0.9**8) / (1 - 0.9), rel=1e-3)


@pytest.mark.parametrize("announced", [True, False])
def test_values_are_rescaled_when_a_change_of_the_reward_is_announced(announced: bool) -> None:
    """If r becomes 50 r - 8, infinite discounted sums v become 50 v - 8 / (1 - gamma)."""
    config = dataclasses.replace(CONFIG, gamma=0.9)
    trained = learner(config)
    for _ in range(10):
        rollout = trained.collect()
        trained.update(rollout, rollout.rewards)
    rewards = rollout.rewards  # pyright: ignore[reportPossiblyUnboundVariable]
    # With this learning rate, values change only by rescaling.
    frozen = dataclasses.replace(config, learning_rate=1e-12)
    state, trained = trained.state_dict(), learner(frozen)
    trained.load_state_dict(state)
    inputs = torch.randn(32, 3, generator=torch.Generator().manual_seed(0))

    def values() -> torch.Tensor:
        critic = trained.policy.critic
        return critic.statistics.denormalise(critic(inputs, inputs)).detach()

    before = values()
    if announced:
        trained.reward_changed()
    trained.update(trained.collect(), 50.0 * rewards - 8.0)

    expected = 50.0 * before - 8.0 / (1.0 - 0.9) if announced else before
    torch.testing.assert_close(values(), expected, rtol=1e-3, atol=1e-2)


def test_change_from_a_constant_reward_gives_finite_metrics_and_weights() -> None:
    trained = learner()
    rollout = trained.collect()
    trained.update(rollout, np.zeros_like(rollout.rewards))
    trained.reward_changed()
    rollout = trained.collect()
    metrics = trained.update(rollout, rollout.rewards)
    assert all(np.isfinite(value) for value in metrics.values())
    assert torch.isfinite(weights(trained)).all()


def test_learning_rate_anneals_to_a_tenth() -> None:
    trained = learner(dataclasses.replace(CONFIG, learning_rate=1e-3, anneal_steps=512))
    rates = []
    for _ in range(4):
        rollout = trained.collect()
        rates.append(trained.update(rollout, rollout.rewards)["learning_rate"])
    assert rates == pytest.approx([5.5e-4, 1e-4, 1e-4, 1e-4])


def test_update_uses_the_discount_of_its_steps() -> None:
    """The first update comes after 256 steps."""

    def first_update(**settings: float) -> dict[str, float]:
        trained = learner(dataclasses.replace(CONFIG, **settings))
        rollout = trained.collect()
        return trained.update(rollout, rollout.rewards)

    rising = {"initial_gamma": 0.9, "gamma": 0.99}
    assert first_update(**rising, gamma_steps=256) == first_update(gamma=0.99)
    middle = PolicyConfig(**rising, gamma_steps=512).gamma_at(256)
    assert first_update(**rising, gamma_steps=512) == first_update(gamma=middle) != first_update(gamma=0.99)


def test_policy_starts_anew_once_when_the_restart_is_due() -> None:
    config = dataclasses.replace(CONFIG, learning_rate=1e-3, restart_steps=500, anneal_steps=512)
    trained, initial = learner(config), weights(learner(config))
    rates, restarted = [], []
    for _ in range(4):
        rollout = trained.collect()
        restarted.append(torch.equal(weights(trained), initial))
        rates.append(trained.update(rollout, rollout.rewards)["learning_rate"])
    # A rollout has 256 steps, so that two rollouts reach 500 steps; the first one has the initial weights anyway.
    assert restarted == [True, False, True, False]
    assert rates == pytest.approx([5.5e-4, 1e-4, 5.5e-4, 1e-4])
    assert trained.steps == 4 * config.steps_per_rollout


def test_learning_rate_falls_above_the_target_kl_and_rises_below_it() -> None:
    trained = learner(dataclasses.replace(CONFIG, learning_rate=1e-2))

    def rates(target_kl: float) -> list[float]:
        trained.config = dataclasses.replace(trained.config, target_kl=target_kl)
        metrics = []
        for _ in range(4):
            rollout = trained.collect()
            metrics.append(trained.update(rollout, rollout.rewards)["learning_rate"])
        return metrics

    assert rates(0.0) == pytest.approx([1e-2] * 4)
    # A rate is set before the update whose divergence changes the next one.
    assert rates(1e-6) == pytest.approx([1e-2 / 1.2**n for n in (0, 1, 2, 3)])
    assert rates(100.0) == pytest.approx([1e-2 / 1.2**n for n in (4, 3, 2, 1)])
    assert rates(100.0) == pytest.approx([1e-2] * 4)


@pytest.mark.parametrize("algorithm", ["mappo", "happo", "mat", "mat_dec"])
def test_standard_deviation_stays_at_its_minimum(algorithm: str) -> None:
    """Noise lowers the reward of IdentityTask, so that the standard deviation shrinks unless it is limited."""
    config = dataclasses.replace(CONFIG, algorithm=algorithm, width=16, learning_rate=2e-2)
    limited = dataclasses.replace(config, initial_log_std=-0.5, min_log_std=-0.5)
    deviations = []
    for each in (config, limited):
        trained = learner(each)
        for _ in range(4):
            rollout = trained.collect()
            metrics = trained.update(rollout, rollout.rewards)
        deviations.append(metrics["action_std"])  # pyright: ignore[reportPossiblyUnboundVariable]
    assert deviations[0] < np.exp(-0.5) - 0.01
    assert deviations[1] >= np.exp(-0.5) - 1e-6


@pytest.mark.parametrize("shape", [(16,), (15, 16), (16, 16, 2), (16, 16, 1)])
def test_rewards_of_another_shape_are_invalid(shape: tuple[int, ...]) -> None:
    trained = learner()
    rollout = trained.collect()
    with pytest.raises(InvalidRollout):
        trained.update(rollout, np.zeros(shape))


def test_rewards_that_are_not_finite_are_invalid_and_change_nothing() -> None:
    trained = learner()
    rollout = trained.collect()
    before = trained.state_dict()
    rewards = rollout.rewards.copy()
    rewards[3, 3] = np.nan
    with pytest.raises(InvalidRollout):
        trained.update(rollout, rewards)
    for name, tensor in trained.state_dict().items():
        assert torch.equal(tensor, before[name]), name


def test_task_must_have_the_configured_number_of_environments() -> None:
    with pytest.raises(InvalidConfig) as error:
        Learner(IdentityTask(3), CONFIG)
    assert error.value.field == "n_envs"


@pytest.mark.parametrize("algorithm", ["mappo", "happo", "mat", "mat_dec"])
@pytest.mark.parametrize("task_type", [IdentityTask, TerminatingTask])
def test_values_are_bootstrapped_after_truncation_only(algorithm: str, task_type: type[IdentityTask]) -> None:
    """Rewards of 1 in episodes of one step: returns are 1 after termination, 1 / (1 - gamma) after truncation."""
    config = dataclasses.replace(CONFIG, gamma=0.5, algorithm=algorithm, width=16, learning_rate=5e-3)
    trained = Learner(task_type(16, horizon_steps=1), config)
    means = []
    for _ in range(12):
        rollout = trained.collect()
        means.append(trained.update(rollout, np.ones_like(rollout.rewards))["return_mean"])
    if task_type is TerminatingTask:
        assert means == pytest.approx([1.0] * 12, abs=1e-5)
    else:
        assert means[-1] == pytest.approx(2.0, abs=0.3)
