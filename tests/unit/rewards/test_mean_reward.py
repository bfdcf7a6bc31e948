"""Means of networks beside the networks that they are the means of."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from mapt.errors import DamagedCheckpoint, InvalidConfig, ModelMismatch
from mapt.rewards.checkpoints import load_reward_model, save_reward_model
from mapt.rewards.inspection import attention_maps, predict, segment_credits
from mapt.rewards.mapt import MAPT
from mapt.rewards.model import MeanReward
from mapt.rewards.relabelling import RewardStream, RolloutRelabeller
from support.tolerance import assert_float32_close
from unit.rewards.conftest import ACTION_DIM, N_AGENTS, OBSERVATION_DIM

pytestmark = pytest.mark.numerics

N_ENVS = 2


def test_scores_and_weights_are_means_and_the_shares_of_agents_sum_to_the_score(build, segments):
    networks = [build(seed, segment_steps=8) for seed in range(3)]
    arrays = [torch.as_tensor(each) for each in (segments.observations, segments.actions, segments.mask)]
    mean = MeanReward(networks)
    with torch.inference_mode():
        output, outputs = mean(*arrays), [network(*arrays) for network in networks]
        shares = mean.agent_shares(output.agent_rewards, output.weights, arrays[2])
    assert_float32_close(output.score, torch.stack([each.score for each in outputs]).mean(dim=0))
    assert_float32_close(output.weights, torch.stack([each.weights for each in outputs]).mean(dim=0))
    assert_float32_close(output.rewards, output.agent_rewards.mean(dim=2))
    assert_float32_close(mean.score(output.rewards, output.weights, arrays[2]), output.score)
    assert_float32_close(shares.sum(dim=1), output.score)
    assert not torch.allclose(outputs[0].weights, outputs[1].weights, atol=1e-4)
    for credit, score in zip(segment_credits(mean, segments), output.score.tolist(), strict=True):
        assert credit.score == pytest.approx(score, rel=1e-5)
        assert np.isfinite(credit.rewards).all()


def test_the_mean_of_equal_networks_is_the_network(build, segments):
    network = build()
    alone, mean = predict(network, segments), predict(MeanReward([network, build()]), segments)
    real = segments.mask
    assert_float32_close(mean.scores, alone.scores)
    assert_float32_close(mean.agent_rewards[real], alone.agent_rewards[real])
    assert_float32_close(
        attention_maps(MeanReward([network]), segments).agents, attention_maps(network, segments).agents
    )


@pytest.mark.parametrize("kind", ["value", "attended", "weighted"])
@pytest.mark.parametrize("variant", [{}, {"layers": 2}])
def test_rewards_for_the_policy_are_the_mean_of_each_networks_step_by_step_and_by_rollout(build, kind, variant):
    networks = [build(seed, **variant) for seed in range(2)]
    mean = MeanReward(networks)
    mean.set_reward_scale(0.3, 1.7)
    rng = np.random.default_rng(1)
    rollout = (
        rng.normal(size=(12, N_ENVS, N_AGENTS, OBSERVATION_DIM)).astype(np.float32),
        rng.normal(size=(12, N_ENVS, N_AGENTS, ACTION_DIM)).astype(np.float32),
        rng.random((12, N_ENVS)) < 0.2,
    )
    expected = np.mean([RolloutRelabeller(each, 5, N_ENVS, kind=kind).relabel(*rollout) for each in networks], axis=0)
    relabelled = RolloutRelabeller(mean, 5, N_ENVS, kind=kind).relabel(*rollout)
    assert_float32_close(relabelled, (expected - 0.3) / 1.7)
    stream = RewardStream(mean, 5, N_ENVS, kind=kind)
    assert_float32_close(np.stack([stream.step(*step) for step in zip(*rollout, strict=True)]), relabelled)


def test_a_mean_is_read_back_as_it_was_saved(build, segments):
    mean = MeanReward([build(seed) for seed in range(2)]).eval()
    mean.set_reward_scale(0.5, 2.0)
    saved = save_reward_model(mean, {"loss": 0.5})
    loaded = load_reward_model(saved.weights, saved.card).model
    assert [type(each) for each in loaded.networks] == [MAPT, MAPT]
    np.testing.assert_array_equal(predict(loaded, segments).scores, predict(mean, segments).scores)
    assert (loaded.reward_mean.item(), loaded.reward_deviation.item()) == (0.5, 2.0)
    assert save_reward_model(loaded, {"loss": 0.5}) == saved
    for networks in (1, 3, 0, "two"):
        with pytest.raises(DamagedCheckpoint):
            load_reward_model(saved.weights, json.dumps(json.loads(saved.card) | {"networks": networks}).encode())


def test_networks_with_other_settings_and_no_networks_are_refused(build):
    with pytest.raises(ModelMismatch):
        MeanReward([build(), build(tpa=False)])
    with pytest.raises(InvalidConfig):
        MeanReward([])


def test_a_mean_is_markov_if_every_network_is(build):
    markov = build()
    torch.nn.init.zeros_(markov.read_out.reward.weight)
    torch.nn.init.zeros_(markov.read_out.reward.bias)
    assert MeanReward([markov, markov]).is_markov
    assert not MeanReward([markov, build()]).is_markov
    assert replace(markov.config, layers=1) == MeanReward([markov]).config
