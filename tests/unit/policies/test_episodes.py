"""Evaluation over whole episodes."""

import numpy as np
from numpy.typing import NDArray

from learning.identity_task import IdentityTask
from mapt.policies import Learner, PolicyConfig, evaluate, play
from mapt.tasks import TaskStep, make_task
from mapt.tasks.protocol import WrappedTask
from mapt.training.evaluation import Evaluation


def learner() -> Learner:
    return Learner(IdentityTask(4), PolicyConfig(n_envs=4, rollout_steps=8, minibatches=1, hidden=(8,)))


def test_returns_are_of_whole_episodes() -> None:
    returns = evaluate(learner(), IdentityTask(3, horizon_steps=8), episodes=7)
    assert returns.shape == (7,)
    # The actor starts near zero, whose reward is 2/3 a step.
    assert np.abs(returns - 8 * 2 / 3).max() < 2.5


def test_lengths_are_the_steps_of_each_episode() -> None:
    played = play(learner(), IdentityTask(3, horizon_steps=5), episodes=7)
    assert played.lengths.tolist() == [5] * 7
    assert played.returns.shape == (7,)


class Scoring(WrappedTask):
    """Environment i succeeds in step i of its episode, from 1, and in no other."""

    def step(self, actions: NDArray[np.floating]) -> TaskStep:
        step = super().step(actions)
        self._steps += 1
        step.success = self._steps == np.arange(self.n_envs)
        self._steps[step.truncated] = 0
        return step

    def reset(self, seed: int) -> tuple[NDArray[np.floating], NDArray[np.floating]]:
        self._steps = np.zeros(self.n_envs, dtype=int)
        return super().reset(seed)


def test_an_episode_succeeds_if_one_of_its_steps_does() -> None:
    played = play(learner(), Scoring(IdentityTask(6, horizon_steps=4)), episodes=12)
    assert played.successes is not None
    # The last step of an episode counts, the first of the next one does not count for it.
    assert played.successes.tolist() == [False, True, True, True, True, False] * 2
    evaluation = Evaluation.of(played)
    assert evaluation.summary()["success"] == 8 / 12
    assert "success 67%" in evaluation.describe()
    assert Evaluation.from_dict(evaluation.to_dict()) == evaluation  # type: ignore[arg-type]


def test_success_is_left_out_where_a_task_does_not_count_it() -> None:
    played = play(learner(), IdentityTask(2, horizon_steps=4), episodes=2)
    assert played.successes is None
    evaluation = Evaluation.of(played)
    assert "success" not in evaluation.summary()
    assert Evaluation.from_dict(evaluation.to_dict()) == evaluation  # type: ignore[arg-type]


def test_returns_are_sums_of_the_tasks_rewards() -> None:
    policy = Learner(make_task("HalfCheetah-6x1", 2), PolicyConfig(n_envs=2, hidden=(8,), minibatches=1))
    task = make_task("HalfCheetah-6x1", 2)
    returns = evaluate(policy, task, episodes=2, seed=5)
    observations, _ = task.reset(5)
    total = np.zeros(2)
    for _ in range(1000):
        step = task.step(policy.policy.act(observations))
        total, observations = total + step.reward, step.observations
    np.testing.assert_allclose(returns, total)


def test_same_seed_gives_the_same_returns_with_sampled_actions() -> None:
    policy = learner().policy
    first, again, other = (evaluate(policy, IdentityTask(4), 8, deterministic=False, seed=seed) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, other)
