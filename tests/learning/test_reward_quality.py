"""MAPT beside a Markov MLP on a true reward that is Markov: attention must cost nothing there.

Run by `make learn`; prints the figures it judges by.
"""

import pytest

from learning.reward_study import labelled_pairs, markov_config, measure, record_replay, small_config
from mapt.rewards.train_config import TrainConfig
from mapt.rewards.trainer import train_reward_model

REPLAY_STEPS = 600_000
N_PAIRS = 500
SEEDS = (0, 1)

pytestmark = pytest.mark.learn


@pytest.fixture(scope="module", params=SEEDS)
def seeded_replay(request):
    return request.param, record_replay(REPLAY_STEPS, request.param)


def test_mapt_is_within_a_point_of_the_markov_mlp_at_500_labels(seeded_replay):
    seed, replay = seeded_replay
    pairs = labelled_pairs(replay, N_PAIRS, seed)
    settings = TrainConfig(seed=seed, device="cpu")
    quality = {}
    for name, config in (("Markov MLP", markov_config(replay)), ("MAPT small", small_config(replay))):
        trained = train_reward_model(pairs, config, settings)
        quality[name] = measure(trained.model, replay, seed)
        print(f"\nseed {seed}, {name}: {quality[name]}; {trained.metrics['seconds']:.0f} s", end="")
    assert quality["MAPT small"].accuracy > quality["Markov MLP"].accuracy - 0.01
    assert quality["MAPT small"].step_correlation_late > 0.85


def test_a_warm_start_with_new_labels_loses_nothing_against_a_fresh_one(seeded_replay):
    seed, replay = seeded_replay
    settings, config = TrainConfig(seed=seed, device="cpu"), small_config(replay)
    pairs = labelled_pairs(replay, N_PAIRS, seed)
    before = train_reward_model(pairs.take(range(N_PAIRS - 50)), config, settings)
    quality = {}
    for name, initial in (("warm", before.model), ("fresh", None)):
        trained = train_reward_model(pairs, config, settings, initial=initial)
        quality[name] = measure(trained.model, replay, seed)
        print(f"\nseed {seed}, {name}: {quality[name]}; {trained.metrics['seconds']:.0f} s", end="")
    assert quality["warm"].accuracy > quality["fresh"].accuracy - 0.01
