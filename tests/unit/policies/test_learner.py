"""One update of the learner: what it reads, what it refuses, how it follows a reward that changes."""

import dataclasses

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from learning.identity_task import IdentityTask
from mapt.errors import InvalidConfig, InvalidRollout
from mapt.policies import Learner, PolicyConfig
from mapt.policies.device import torch_threads
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


def test_what_is_learned_does_not_depend_on_the_cores_of_the_machine() -> None:
    """Torch begins with a thread for each; orthogonal weights of 64 x 64 differ with their number."""

    def learned(n_cores: int) -> torch.Tensor:
        with torch_threads(n_cores):
            trained = learner(dataclasses.replace(CONFIG, hidden=(64, 64)))
            rollout = trained.collect()
            trained.update(rollout, rollout.rewards)
        return weights(trained)

    torch.testing.assert_close(learned(1), learned(2), rtol=0, atol=0)


def test_the_true_reward_is_never_read() -> None:
    """Two learners given the same rewards learn the same, though one's rollouts say otherwise."""
    honest, lied_to = learner(), learner()
    rollout, other = honest.collect(), lied_to.collect()
    rewards = rollout.rewards
    honest.update(rollout, rewards)
    lied_to.update(dataclasses.replace(other, rewards=np.full_like(other.rewards, np.nan)), rewards)
    torch.testing.assert_close(weights(honest), weights(lied_to), rtol=0, atol=0)


def test_a_shared_reward_is_the_same_as_giving_it_to_each() -> None:
    shared, each = learner(), learner()
    rollout = shared.collect()
    each.collect()
    shared.update(rollout, rollout.rewards)
    each.update(rollout, np.repeat(rollout.rewards[..., None], 3, axis=-1))
    torch.testing.assert_close(weights(shared), weights(each), rtol=0, atol=0)


def test_the_first_pass_sees_the_policy_that_acted() -> None:
    trained = learner(dataclasses.replace(CONFIG, epochs=1, minibatches=1))
    for _ in range(3):
        rollout = trained.collect()
        metrics = trained.update(rollout, rollout.rewards)
        assert metrics["kl"] == pytest.approx(0.0, abs=1e-6)
        assert metrics["clip_fraction"] == 0.0


@pytest.mark.parametrize("factor", [1e-3, 1e3])
def test_the_scale_of_the_reward_does_not_matter_to_the_actor(factor: float) -> None:
    plain, scaled = learner(), learner()
    for _ in range(3):
        rollout = plain.collect()
        scaled.collect()
        plain.update(rollout, rollout.rewards)
        scaled.update(rollout, rollout.rewards * factor)
        torch.testing.assert_close(weights(plain), weights(scaled), rtol=1e-2, atol=1e-3)


@pytest.mark.parametrize("told", [True, False])
def test_only_a_learner_that_is_told_moves_its_values_with_the_reward(told: bool) -> None:
    """If r becomes 50 r - 8, endless discounted sums v become 50 v - 8 / (1 - gamma)."""
    config = dataclasses.replace(CONFIG, gamma=0.9)
    trained = learner(config)
    for _ in range(10):
        rollout = trained.collect()
        trained.update(rollout, rollout.rewards)
    rewards = rollout.rewards  # pyright: ignore[reportPossiblyUnboundVariable]
    # From here on nothing is learned: values can only move with the reward's units.
    still = dataclasses.replace(config, learning_rate=1e-12)
    state, trained = trained.state_dict(), learner(still)
    trained.load_state_dict(state)
    inputs = torch.randn(32, 3, generator=torch.Generator().manual_seed(0))

    def values() -> torch.Tensor:
        critic = trained.policy.critic
        return critic.statistics.denormalise(critic(inputs, inputs)).detach()

    before = values()
    if told:
        trained.reward_changed()
    trained.update(trained.collect(), 50.0 * rewards - 8.0)

    expected = 50.0 * before - 8.0 / (1.0 - 0.9) if told else before
    torch.testing.assert_close(values(), expected, rtol=1e-3, atol=1e-2)


def test_a_constant_reward_changes_to_a_live_one_without_harm() -> None:
    trained = learner()
    rollout = trained.collect()
    trained.update(rollout, np.zeros_like(rollout.rewards))
    trained.reward_changed()
    rollout = trained.collect()
    metrics = trained.update(rollout, rollout.rewards)
    assert all(np.isfinite(value) for value in metrics.values())
    assert torch.isfinite(weights(trained)).all()


def test_the_learning_rate_falls_to_a_tenth_and_stays() -> None:
    trained = learner(dataclasses.replace(CONFIG, learning_rate=1e-3, anneal_steps=512))
    rates = []
    for _ in range(4):
        rollout = trained.collect()
        rates.append(trained.update(rollout, rollout.rewards)["learning_rate"])
    assert rates == pytest.approx([5.5e-4, 1e-4, 1e-4, 1e-4])


@pytest.mark.parametrize("shape", [(16,), (15, 16), (16, 16, 2), (16, 16, 1)])
def test_rewards_of_another_shape_are_refused(shape: tuple[int, ...]) -> None:
    trained = learner()
    rollout = trained.collect()
    with pytest.raises(InvalidRollout, match=r"\(16, 16\) or \(16, 16, 3\)"):
        trained.update(rollout, np.zeros(shape))


def test_rewards_that_are_no_numbers_are_refused_and_change_nothing() -> None:
    trained = learner()
    rollout = trained.collect()
    before = trained.state_dict()
    rewards = rollout.rewards.copy()
    rewards[3, 3] = np.nan
    with pytest.raises(InvalidRollout, match="finite"):
        trained.update(rollout, rewards)
    for name, tensor in trained.state_dict().items():
        assert torch.equal(tensor, before[name]), name


def test_a_task_of_another_size_is_refused() -> None:
    with pytest.raises(InvalidConfig, match="3 environments"):
        Learner(IdentityTask(3), CONFIG)


class TerminatingTask(IdentityTask):
    """Every episode ends for good where it would have been cut."""

    def step(self, actions: NDArray[np.floating]) -> TaskStep:
        step = super().step(actions)
        step.terminated, step.truncated = step.truncated, step.terminated
        return step


@pytest.mark.parametrize("algorithm", ["mappo", "happo", "mat", "mat_dec"])
@pytest.mark.parametrize("task_type", [IdentityTask, TerminatingTask])
def test_only_what_is_cut_has_a_value_to_come(algorithm: str, task_type: type[IdentityTask]) -> None:
    """Rewards of 1 in episodes of one step: returns are 1 if they end, and rise to 1 / (1 - gamma) if they are cut."""
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
