"""O-MAPL's losses against slow loops, and a preference problem that it solves."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from learning.identity_task import IdentityTask
from mapt.errors import InvalidConfig
from mapt.imitation.cloning import CloningTrainer
from mapt.imitation.config import CloningConfig, OMaplConfig
from mapt.imitation.demonstrations import Demonstrations
from mapt.imitation.omapl import Mixing, OMaplTrainer, PairBatch, implied_rewards, label_loss, mix, soft_value_loss
from mapt.policies import Learner, Policy, PolicyConfig, evaluate
from mapt.preferences.dataset import PreferenceDataset, SegmentArrays

N_STEPS = 4
CONFIG = OMaplConfig(batch=64, learning_rate=3e-3, gamma=0.5, tau=0.05, hidden=32, temperature=0.1, regularisation=0.05)


def untrained(algorithm: str = "mappo") -> Policy:
    config = PolicyConfig.named(algorithm, n_envs=4, rollout_steps=8, minibatches=1, hidden=[32], width=8)
    return Learner(IdentityTask(4), config).policy


def random_pairs(n_pairs: int = 600) -> tuple[SegmentArrays, PreferenceDataset]:
    """Pairs of segments of random actions; the one whose actions are closer to what the agents observe is preferred."""
    rng = np.random.default_rng(0)
    lead = (2 * n_pairs, N_STEPS, 3, 1)
    numbers = rng.uniform(-1, 1, lead).astype(np.float32)
    actions = rng.uniform(-1, 1, lead).astype(np.float32)
    observations = np.concatenate([numbers, np.full_like(numbers, 0.5)], -1)
    segments = SegmentArrays(observations, actions, np.ones(lead[:2], bool))
    returns = -np.square(actions - numbers).sum(axis=(1, 2, 3))
    pairs = np.arange(2 * n_pairs).reshape(-1, 2)
    return segments, PreferenceDataset(
        segments, pairs, (returns[pairs[:, 0]] > returns[pairs[:, 1]]).astype(np.float32)
    )


def batch_of(lengths: list[int], labels: list[float]) -> PairBatch:
    real = torch.arange(N_STEPS) < torch.tensor(lengths)[:, None]
    followed = torch.zeros_like(real)
    followed[:, :-1] = real[:, 1:]
    ends = real & ~followed
    ends[:, -1] = False
    nothing = torch.zeros(0)
    return PairBatch(nothing, nothing, real, followed, ends, torch.tensor(labels), torch.tensor([1.0, 0.5]))


@pytest.mark.numerics
def test_rewards_and_the_loss_of_labels_equal_a_loop():
    """Segments 0 and 3 end before the last step; of the others, the last reward is unknown."""
    lengths, labels, gamma, regularisation = [3, 4, 4, 2], [1.0, 0.5], 0.9, 0.3
    batch = batch_of(lengths, labels)
    q, v = torch.randn(4, N_STEPS), torch.randn(4, N_STEPS)
    rewards = implied_rewards(q, v, batch, gamma)
    expected: list[list[float]] = []
    for row, length in enumerate(lengths):
        own = []
        for t in range(N_STEPS):
            if t + 1 < length:
                own.append(float(q[row, t] - gamma * v[row, t + 1]))
            elif t + 1 == length < N_STEPS:
                own.append(float(q[row, t]))
            else:
                own.append(0.0)
        expected.append(own)
    torch.testing.assert_close(rewards, torch.tensor(expected))

    losses = []
    for pair, (label, weight) in enumerate(zip(labels, (1.0, 0.5), strict=True)):
        p = 1 / (1 + math.exp(sum(expected[pair + 2]) - sum(expected[pair])))
        p = weight * p + (1 - weight) / 2
        losses.append(-label * math.log(p) - (1 - label) * math.log(1 - p))
    known = 3 + 3 + 3 + 2
    square = sum(reward**2 for own in expected for reward in own) / known
    found = label_loss(rewards, batch, regularisation)
    assert float(found) == pytest.approx(np.mean(losses) + regularisation * square, rel=1e-5)


@pytest.mark.numerics
def test_the_loss_of_values_is_extreme_v_and_its_minimum_the_soft_maximum():
    z = torch.randn(6, dtype=torch.float64)
    expected = np.mean([math.exp(each) - each - 1 for each in z.tolist()])
    assert float(soft_value_loss(z)) == pytest.approx(expected * math.exp(-float(z.max())), rel=1e-9)
    q, beta = torch.randn(50, dtype=torch.float64), 0.5
    soft_maximum = (beta * ((q / beta).logsumexp(0) - math.log(50))).requires_grad_()
    (slope,) = torch.autograd.grad(soft_value_loss((q - soft_maximum) / beta), soft_maximum)
    assert float(slope) == pytest.approx(0.0, abs=1e-9)
    assert torch.isfinite(soft_value_loss(torch.tensor([1e4, -1e4])))


def test_the_teams_value_grows_with_every_agents_value():
    mixing = Mixing(IdentityTask(1).spec, 8)
    observations, values = torch.randn(3, 5, 2), torch.randn(3, 5)
    weights, offset = mixing(observations)
    assert (weights > 0).all()
    expected = [sum(weights[n, b] * values[n, b] for n in range(3)) + offset[b] for b in range(5)]
    torch.testing.assert_close(mix(values, (weights, offset)), torch.stack(expected))


@pytest.mark.slow
def test_preferences_teach_a_policy_without_a_reward():
    """Random actions: their mean, which cloning finds, has a return of 5.3 of 8; the labels say which are better."""
    segments, pairs = random_pairs()
    policy, cloned = untrained(), untrained()
    trainer = OMaplTrainer(policy, pairs, CONFIG, seed=0)
    metrics = [trainer.step() for _ in range(250)]
    assert np.mean([float(each["label_accuracy"]) for each in metrics[-20:]]) > 0.8
    data = Demonstrations.from_segments(segments.observations, segments.actions, segments.mask)
    cloning = CloningTrainer(cloned, data, CloningConfig(batch=64, learning_rate=3e-3), seed=0)
    for _ in range(250):
        cloning.step()
    taught_return, cloning_return = (evaluate(each, IdentityTask(16), 64).mean() for each in (policy, cloned))
    assert cloning_return < 6.0
    assert taught_return > cloning_return + 0.7


def test_training_resumes_exactly():
    _, pairs = random_pairs(20)
    whole, resumed = untrained(), untrained()
    config = replace(CONFIG, batch=4)
    trainer = OMaplTrainer(whole, pairs, config, seed=1)
    for _ in range(3):
        trainer.step()
    again = OMaplTrainer(resumed, pairs, config, seed=2)
    again.load_state_dict(trainer.state_dict())
    resumed.load_state_dict(whole.state_dict())
    assert trainer.step() == again.step()
    for one, other in zip(whole.parameters(), resumed.parameters(), strict=True):
        assert torch.equal(one, other)


def test_a_policy_without_an_actor_per_agent_is_refused():
    with pytest.raises(InvalidConfig):
        OMaplTrainer(untrained("mat"), random_pairs(4)[1], OMaplConfig(), seed=0)
