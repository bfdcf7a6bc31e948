"""The numbers of a report, each where its right value is plain."""

import numpy as np
import pytest
import torch

from mapt.preferences.dataset import SegmentArrays
from mapt.rewards.model import RewardModel, build_reward_model
from mapt.studies.attention_maps import attention_maps
from mapt.studies.diagnosis import (
    STATE_ACTIONS,
    breadth,
    diagnose,
    draw_sample,
    weight_concentration,
)
from mapt.studies.pairs import split_replay
from mapt.studies.quality import predict
from mapt.studies.replay import Replay
from mapt.studies.variants import network_of

WITH_AGENTS, WITH_STEPS = {"MAPT", "MAPT-TPA", "MAPT*"}, {"MAPT", "MAPT-CPA", "MAPT*", "MAPT*-CPA", "MA-Transformer"}


def drawn_model(name: str, replay: Replay) -> RewardModel:
    """A small model whose every parameter was drawn, so that no path is silent."""
    model = build_reward_model(network_of(f"{name}:hidden_dim=8", "small", replay.source.layout)).eval()
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.copy_(0.5 * torch.randn(parameter.shape, generator=generator))
    return model


@pytest.mark.parametrize("name", ["MAPT", "MAPT-TPA", "MAPT-CPA", "MAPT*", "MA-MLP", "MA-LSTM", "MA-Transformer"])
def test_attention_is_seen_where_a_model_has_it(replay, name):
    model, segments = drawn_model(name, replay), replay.segments(range(5))
    maps = attention_maps(model, segments)
    assert (maps.agents is not None) == (name in WITH_AGENTS)
    assert (maps.steps is not None) == (name in WITH_STEPS)
    if maps.agents is not None:
        assert maps.agents.shape == (5, 6, 2, 2)
        np.testing.assert_allclose(maps.agents.sum(axis=-1), 1, atol=1e-5)
    if maps.steps is not None:
        # Eq. 6: the weight of a step is the mean of what the steps give it.
        np.testing.assert_allclose(maps.steps.mean(axis=1), predict(model, segments).weights, atol=1e-5)


def test_looking_at_attention_leaves_no_hook(replay):
    model = drawn_model("MAPT", replay)
    attention_maps(model, replay.segments(range(2)))
    assert all(not module._forward_hooks for module in model.modules())


def test_padding_is_never_attended_to(replay):
    whole = replay.segments(range(4))
    mask = np.arange(6) < np.array([6, 3, 2, 5])[:, None]
    maps = attention_maps(drawn_model("MAPT", replay), SegmentArrays(whole.observations, whole.actions, mask))
    assert maps.steps is not None
    assert (maps.steps.transpose(0, 2, 1)[~mask] == 0).all()


def test_concentration_is_0_for_equal_weights_and_1_for_a_single_step():
    mask = np.array([[True] * 4, [True, True, True, False]])
    equal, single = mask / mask.sum(axis=1, keepdims=True), np.eye(4)[[2, 0]]
    assert weight_concentration(equal, mask) == pytest.approx(0.0)
    assert weight_concentration(single, mask) == pytest.approx(1.0)


def test_breadth_is_half_for_rewards_spread_evenly_and_less_for_heaped_ones():
    even = np.linspace(0, 1, 10_001)
    assert breadth(even) == pytest.approx(0.5, abs=0.01)
    assert breadth(np.tan((even - 0.5) * 3)) < 0.2
    assert np.isnan(breadth(np.ones(10)))


def test_a_sample_has_the_papers_number_of_state_actions_at_most(replay):
    sample = draw_sample(replay, "oracle", 50, None)
    assert len(sample.indices) == len(replay)
    assert sample.mask.sum() <= STATE_ACTIONS
    np.testing.assert_array_equal(sample.labels == 1, np.subtract(*sample.returns[sample.pairs].T) > 0)
    shown = sample.returns[sample.shown]
    assert shown[0] < shown[1] < shown[2]


def test_a_sample_may_be_of_fresh_segments_alone(replay):
    sample = draw_sample(replay, "oracle", 50, fresh_of_seed=3)
    np.testing.assert_array_equal(sample.indices, split_replay(len(replay), 3).test)


def test_the_past_has_no_share_in_a_markov_model_and_all_of_it_without_a_markov_path(replay):
    sample = draw_sample(replay, "oracle", 50, None)
    share = {
        name: diagnose(name, drawn_model(name, replay), sample).metrics["past_share"]
        for name in ("MA-MLP", "MAPT", "MAPT:markov_path=false")
    }
    assert share["MA-MLP"] == pytest.approx(0.0, abs=1e-9)
    assert share["MAPT"] > 0.01
    assert share["MAPT:markov_path=false"] == 1.0


def test_agents_of_a_joint_reward_do_not_differ(replay):
    sample = draw_sample(replay, "oracle", 50, None)
    joint = diagnose("joint", drawn_model("MA-Transformer:markov_path=false", replay), sample)
    own = diagnose("own", drawn_model("MA-MLP", replay), sample)
    assert joint.metrics["spread_across_agents"] == pytest.approx(0.0, abs=1e-5)
    assert own.metrics["spread_across_agents"] > 0.1
    assert own.agent_attention is None
