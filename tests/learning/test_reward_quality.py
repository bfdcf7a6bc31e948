"""MAPT beside a Markov MLP on a true reward that is Markov: attention must cost nothing there.

Run by `make learn`; prints the figures it judges by.
"""

import pytest

from mapt.benchmarks.evaluate import DatasetTeacher, evaluate_model, labelled_dataset
from mapt.benchmarks.job import network_of, training_of
from mapt.benchmarks.recorded_dataset import RecordedDataset, Recording, record_dataset
from mapt.preferences.dataset import PreferenceDataset
from mapt.rewards.trainer import TrainedReward, train_reward_model

N_PAIRS, N_TEST_PAIRS = 500, 4000
# A version trained on so many labels, and the one after it.
N_BEFORE, N_AFTER = 1000, 1050
SEEDS = (0, 1, 2)

pytestmark = pytest.mark.learn


@pytest.fixture(scope="module", params=SEEDS)
def seeded_replay(request, tmp_path_factory):
    recording = Recording("HalfCheetah-6x1", policy_steps=600_000, segment_steps=50, segments=4000, seed=request.param)
    return request.param, record_dataset(recording, tmp_path_factory.mktemp("replay") / "segments")


def oracle_pairs(replay: RecordedDataset, seed: int, n_pairs: int) -> PreferenceDataset:
    return labelled_dataset(DatasetTeacher("oracle", replay, seed), replay, n_pairs, seed)


def train(pairs: PreferenceDataset, model: str, replay: RecordedDataset, seed: int, **options: object) -> TrainedReward:
    network = network_of(model, "small", replay.source.layout)
    return train_reward_model(pairs, network, training_of(model, "small", seed, "cpu"), **options)


def fresh_metrics(name: str, trained: TrainedReward, replay: RecordedDataset, seed: int) -> dict[str, float]:
    metrics = dict(evaluate_model(trained.model, replay, "oracle", N_TEST_PAIRS, seed).metrics)
    figures = ", ".join(f"{key} {value:.3f}" for key, value in metrics.items())
    print(f"\nseed {seed}, {name}: {figures}; {trained.metrics['seconds']:.0f} s", end="")
    return metrics


def test_mapt_is_within_a_point_of_the_markov_mlp_at_500_labels(seeded_replay):
    seed, replay = seeded_replay
    pairs = oracle_pairs(replay, seed, N_PAIRS)
    quality = {name: fresh_metrics(name, train(pairs, name, replay, seed), replay, seed) for name in ("MA-MLP", "MAPT")}
    assert quality["MAPT"]["accuracy"] > quality["MA-MLP"]["accuracy"] - 0.01
    assert quality["MAPT"]["step_correlation_late"] > 0.85


def test_a_warm_start_with_new_labels_loses_nothing_against_a_fresh_one(seeded_replay):
    seed, replay = seeded_replay
    pairs = oracle_pairs(replay, seed, N_AFTER)
    before = train(pairs.take(range(N_BEFORE)), "MAPT", replay, seed)
    quality = {
        name: fresh_metrics(name, train(pairs, "MAPT", replay, seed, initial=initial), replay, seed)
        for name, initial in (("warm", before.model), ("fresh", None))
    }
    assert quality["warm"]["accuracy"] > quality["fresh"]["accuracy"] - 0.01
