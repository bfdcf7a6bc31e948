"""Weighting labels by the estimated reliability of their labellers recovers what a few bad labellers cost.

Run by `make learn`. Eight scripted people label 500 pairs, a fifth of them twice: four are good, two guess, one prefers
the left clip, and one answers the opposite. Prints what is estimated of each, and the quality of the reward models.
"""

from collections.abc import Sequence

import numpy as np
import pytest

from mapt.benchmarks.evaluate import DatasetTeacher, evaluate_model, training_pairs
from mapt.benchmarks.job import network_of, training_of
from mapt.benchmarks.recorded_dataset import RecordedDataset, Recording, record_dataset
from mapt.preferences.dataset import PreferenceDataset
from mapt.preferences.reliability import EQUAL, LabellerAnswers, cross_fitted_logits, estimate_reliability
from mapt.rewards.trainer import train_reward_model

N_PAIRS, N_TEST_PAIRS, OVERLAP_SHARE = 500, 4000, 0.2
GOOD = "mistake:mistake=0.05"
CREW = (GOOD, GOOD, GOOD, GOOD, "careless", "careless", "left", "opposite")
N_GOOD = CREW.count(GOOD)
SEEDS = (0, 1, 2, 3, 4)

pytestmark = pytest.mark.learn


@pytest.fixture(scope="module", params=SEEDS)
def seeded_segments(request, tmp_path_factory):
    recording = Recording("HalfCheetah-6x1", policy_steps=400_000, segment_steps=50, segments=3000, seed=request.param)
    return request.param, record_dataset(recording, tmp_path_factory.mktemp("crew") / "segments")


def crew_answers(crew: Sequence[str], pairs: np.ndarray, recorded: RecordedDataset, seed: int) -> LabellerAnswers:
    """Every pair gets one label, and the first `OVERLAP_SHARE` of them a second one, from another labeller."""
    rng = np.random.default_rng([seed, 77])
    rows = [
        (pair, person)
        for pair in range(len(pairs))
        for person in rng.permutation(len(crew))[: 2 if pair < OVERLAP_SHARE * len(pairs) else 1]
    ]
    numbers, labellers = np.array(rows).T
    left = rng.integers(0, 2, len(rows))
    labels = np.zeros(len(rows), np.float32)
    for person, name in enumerate(crew):
        own = labellers == person
        labels[own] = DatasetTeacher(name, recorded, 1000 * seed + person).labels(pairs[numbers[own]], left[own])
    return LabellerAnswers(numbers, labels, labellers, left)


def compared(answers: LabellerAnswers, pairs: np.ndarray, recorded: RecordedDataset) -> PreferenceDataset:
    """One row for each label; labels of a pair share its id, and so its side of the hold-out."""
    used, positions = np.unique(pairs[answers.pairs], return_inverse=True)
    return PreferenceDataset(recorded.subset(used), positions.reshape(-1, 2), answers.labels, answers.pairs)


def accuracy(name: str, dataset: PreferenceDataset, recorded: RecordedDataset, seed: int) -> float:
    """Train on the pairs; print and return the accuracy on fresh pairs."""
    network = network_of("MA-MLP", "small", recorded.source.layout)
    trained = train_reward_model(dataset, network, training_of("MA-MLP", "small", seed, "cpu"))
    metrics = evaluate_model(trained.model, recorded, "oracle", N_TEST_PAIRS, seed).metrics
    figures = ", ".join(f"{key} {metrics[key]:.3f}" for key in ("accuracy", "step_correlation"))
    print(f"\nseed {seed}, {name}: {figures}; {trained.metrics['seconds']:.0f} s", end="", flush=True)
    return metrics["accuracy"]


def test_weighted_labels_of_a_crew_train_as_good_a_reward_as_those_of_good_labellers(seeded_segments):
    seed, recorded = seeded_segments
    pairs = training_pairs(len(recorded), N_PAIRS, seed)
    answers = crew_answers(CREW, pairs, recorded, seed)
    dataset = compared(answers, pairs, recorded)
    logits = np.zeros(N_PAIRS)
    logits[answers.pairs] = cross_fitted_logits(dataset)
    found = estimate_reliability(answers, len(CREW), logits)
    for person, name in enumerate(CREW):
        given = answers.shown[answers.labellers == person]
        print(
            f"\nseed {seed}, {name}: {len(given)} labels, accuracy {found.accuracy[person]:.2f}, weights of left and "
            f"right {found.answer_weights[person, 0]:.2f} and {found.answer_weights[person, 2]:.2f}, left share "
            f"{(given == 0).sum() / (given != EQUAL).sum():.2f}",
            end="",
        )
    reached = {
        name: accuracy(name, each, recorded, seed)
        for name, each in (
            ("unweighted", dataset),
            ("weighted", dataset.weighted(found.weights)),
            ("bad ones excluded", dataset.take(np.flatnonzero(answers.labellers < N_GOOD))),
            ("eight good ones", compared(crew_answers([GOOD] * 8, pairs, recorded, seed), pairs, recorded)),
        )
    }
    assert found.accuracy[-1] < 0.4
    assert found.accuracy[:N_GOOD].min() > found.accuracy[N_GOOD:].max()
    assert reached["weighted"] > reached["unweighted"] - 0.01
    assert reached["weighted"] > reached["eight good ones"] - 0.03
