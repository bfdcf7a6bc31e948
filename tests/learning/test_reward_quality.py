"""MAPT is as accurate as a Markov MLP when the true reward is Markov.

Run by `make learn`. Prints the metrics of every model.
"""

import pytest

from mapt.benchmarks.evaluate import DatasetTeacher, evaluate_model, labelled_dataset
from mapt.benchmarks.job import network_of, training_of
from mapt.benchmarks.recorded_dataset import RecordedDataset, Recording, record_dataset
from mapt.preferences.dataset import PreferenceDataset
from mapt.rewards.trainer import TrainedReward, train_reward_model

N_PAIRS, N_TEST_PAIRS = 500, 4000
# Labels of a reward version and of the next one.
N_FIRST_LABELS, N_SECOND_LABELS = 1000, 1050
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


def evaluate_and_print(name: str, trained: TrainedReward, replay: RecordedDataset, seed: int) -> dict[str, float]:
    """Evaluate a model on test pairs; print and return its metrics."""
    metrics = dict(evaluate_model(trained.model, replay, "oracle", N_TEST_PAIRS, seed).metrics)
    figures = ", ".join(f"{key} {value:.3f}" for key, value in metrics.items())
    print(f"\nseed {seed}, {name}: {figures}; {trained.metrics['seconds']:.0f} s", end="")
    return metrics


def test_mapt_is_within_a_point_of_the_markov_mlp_at_500_labels(seeded_replay):
    seed, replay = seeded_replay
    pairs = oracle_pairs(replay, seed, N_PAIRS)
    metrics = {
        name: evaluate_and_print(name, train(pairs, name, replay, seed), replay, seed) for name in ("MA-MLP", "MAPT")
    }
    assert metrics["MAPT"]["accuracy"] > metrics["MA-MLP"]["accuracy"] - 0.01
    assert metrics["MAPT"]["step_correlation_late"] > 0.85


def test_a_warm_start_is_within_a_point_of_a_cold_start(seeded_replay):
    seed, replay = seeded_replay
    pairs = oracle_pairs(replay, seed, N_SECOND_LABELS)
    first = train(pairs.take(range(N_FIRST_LABELS)), "MAPT", replay, seed)
    metrics = {
        name: evaluate_and_print(name, train(pairs, "MAPT", replay, seed, initial=initial), replay, seed)
        for name, initial in (("warm", first.model), ("cold", None))
    }
    assert metrics["warm"]["accuracy"] > metrics["cold"]["accuracy"] - 0.01
