import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mapt.errors import ShapeError
from mapt.preferences.dataset import PreferenceDataset, SegmentArrays
from mapt.preferences.reliability import (
    EQUAL,
    LEFT,
    PRIOR_ACCURACY,
    PRIOR_EQUAL,
    RIGHT,
    LabellerAnswers,
    cross_fitted_logits,
    dawid_skene,
    estimate_reliability,
)

# Table 1 of Dawid and Skene (1979): 45 patients, as classified three times by observer 1 and once by observers 2 to 5.
ANAESTHETISTS = (
    "1111111 3334334 1122122 2223121 2223222 2223322 1222111 3333433 2222223 2322223 4444444 2223343 1111111 2223212 "
    "1211111 1112111 1111111 1111111 2222221 2221322 2222222 2222221 2223222 2212222 1111111 1111111 2322222 1111111 "
    "1111111 1121121 1111111 3333233 1111111 2222222 2223232 4334343 2212232 2323233 3333432 1111111 1111111 1212111 "
    "2322222 1211111 2222222"
)


def test_published_example_gives_the_published_estimates():
    answers = np.array([[int(answer) - 1 for answer in patient] for patient in ANAESTHETISTS.split()])
    votes = np.stack([np.bincount(row, minlength=4) / 7 for row in answers])
    found = dawid_skene(
        np.repeat(np.arange(45), 7),
        np.tile([0, 0, 0, 1, 2, 3, 4], 45),
        answers.reshape(-1),
        np.zeros((5, 4, 4)),
        start=votes,
    )
    assert found.class_probabilities == pytest.approx([0.40, 0.42, 0.11, 0.07], abs=0.005)
    # Table 2, observer 1; crowd-kit 1.4.2 gives the same.
    observer_1 = [[0.89, 0.11, 0, 0], [0.07, 0.88, 0.05, 0], [0, 0.34, 0.66, 0], [0, 0, 0.56, 0.44]]
    assert found.confusion[0] == pytest.approx(np.array(observer_1), abs=0.006)


def test_fixed_point_is_that_computed_by_hand():
    # Two observers who agree on two items and disagree on a third; pseudo-counts 2 and 1.
    prior = np.tile([[2.0, 1.0], [1.0, 2.0]], (2, 1, 1))
    items, observers, answers = np.array([0, 0, 1, 1, 2, 2]), np.array([0, 1] * 3), np.array([0, 0, 1, 1, 0, 1])
    found = dawid_skene(items, observers, answers, prior, class_probabilities=np.full(2, 0.5))
    # At the fixed point item 2 is undecided, and q = P(class 0 | item 0) = P(class 1 | item 1). Observer 0 answered 0
    # on items 0 and 2: their probability of the right answer is a = (2 + q + 1/2) / 4.5 in class 0, and
    # b = (2 + q) / 4.5 in class 1. Observer 1 mirrors this.
    q = 0.5
    for _ in range(200):
        a, b = (2.5 + q) / 4.5, (2 + q) / 4.5
        q = a * b / (a * b + (1 - a) * (1 - b))
    assert found.classes[:, 0] == pytest.approx([q, 1 - q, 0.5], abs=1e-4)
    expected = [[[a, 1 - a], [1 - b, b]], [[b, 1 - b], [1 - a, a]]]
    assert found.confusion == pytest.approx(np.array(expected), abs=1e-4)


def test_an_observer_without_observations_keeps_the_prior():
    prior = np.tile([[4.0, 1.0], [1.0, 4.0]], (3, 1, 1))
    found = dawid_skene(np.array([0, 0]), np.array([0, 1]), np.array([0, 0]), prior)
    assert found.confusion[2] == pytest.approx(np.array([[0.8, 0.2], [0.2, 0.8]]))


def crew(seed, people, n_pairs=500, overlap=0.2, ties=0.0):
    """Answers of `people`, who are functions from (better on the left, rng) to `LEFT`, `EQUAL` or `RIGHT`."""
    rng = np.random.default_rng(seed)
    better = rng.integers(0, 2, n_pairs)
    rows = [
        (pair, person)
        for pair in range(n_pairs)
        for person in rng.permutation(len(people))[: 2 if pair < overlap * n_pairs else 1]
    ]
    pairs, labellers = np.array(rows).T
    left = rng.integers(0, 2, len(pairs))
    shown = [people[person](left[i] == better[pair], rng) for i, (pair, person) in enumerate(rows)]
    prefers_left = 1 - np.array(shown) / 2
    return LabellerAnswers(
        pairs, np.where(left == 0, prefers_left, 1 - prefers_left).astype(np.float32), labellers, left
    )


def good(on_left, rng):
    return LEFT if on_left == (rng.random() < 0.95) else RIGHT


def careless(on_left, rng):
    return rng.choice([LEFT, RIGHT])


def left_biased(on_left, rng):
    return LEFT if rng.random() < 0.5 else good(on_left, rng)


def opposite(on_left, rng):
    return RIGHT if on_left else LEFT


def always_equal(on_left, rng):
    return EQUAL


def model_logits(answers, accuracy, seed=0, n_pairs=500):
    """A model that predicts the better segments of `crew` with this accuracy."""
    better = np.random.default_rng(seed).integers(0, 2, n_pairs)
    rng = np.random.default_rng(1)
    return np.where(rng.random(n_pairs) < accuracy, 1 - 2 * better, 2 * better - 1) * rng.uniform(0.1, 2, n_pairs)


EIGHT = [good] * 4 + [careless] * 2 + [left_biased, opposite]


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("with_model", [False, True])
def test_careless_biased_and_opposite_labellers_are_told_from_good_ones(seed, with_model):
    answers = crew(seed, EIGHT)
    found = estimate_reliability(answers, 8, model_logits(answers, 0.85, seed) if with_model else None)
    strict = found.answer_weights[:, [LEFT, RIGHT]]
    assert strict[:4].mean() > 0.75
    assert strict[7].max() < 0.2
    # The left-biased labeller's "right" is as good as that of others; their "left" is not.
    assert strict[6, 1] - strict[6, 0] > 0.2
    if with_model:
        # The twenty to thirty pairs that each of them shares with others do not always tell guessing from labelling.
        assert strict[4:6].max() < strict[:4].min()
        assert found.accuracy[7] < 0.35


def test_labellers_who_share_no_pair_are_compared_through_the_model():
    answers = crew(0, [good, good, careless, opposite], overlap=0)
    alone, helped = (estimate_reliability(answers, 4, logits) for logits in (None, model_logits(answers, 0.8)))
    assert np.ptp(alone.answer_weights) < 0.25
    assert helped.answer_weights[2:].max() < helped.answer_weights[:2].min()


def test_known_answers_measure_labellers_who_share_no_pair():
    answers = crew(0, [good, careless], n_pairs=200, overlap=0)
    known = np.full(200, np.nan)
    known[::2] = 1 - np.random.default_rng(0).integers(0, 2, 200)[::2]
    # `crew` draws the number of the better segment first.
    found = estimate_reliability(answers, 2, known=known)
    assert found.accuracy[0] > 0.85
    assert found.accuracy[1] < 0.75
    assert found.answer_weights[1].max() < 0.6


def test_pairs_without_a_prediction_are_left_to_the_labels():
    answers = crew(0, EIGHT, n_pairs=100)
    nothing = estimate_reliability(answers, 8, np.full(100, np.nan), np.full(100, np.nan))
    assert nothing.weights == pytest.approx(estimate_reliability(answers, 8).weights)


def test_one_labeller_has_weight_1():
    answers = crew(0, [careless])
    assert (estimate_reliability(answers, 1, model_logits(answers, 0.9)).weights == 1).all()


def test_labellers_without_evidence_have_weight_1():
    # Two labellers with one label each, on different pairs.
    answers = LabellerAnswers(np.array([0, 1]), np.array([1, 0], np.float32), np.array([0, 1]), np.array([0, 1]))
    found = estimate_reliability(answers, 2)
    assert found.weights == pytest.approx([1, 1], abs=0.15)
    assert found.accuracy == pytest.approx([PRIOR_ACCURACY] * 2, abs=0.05)


def test_equal_answers_of_who_gives_only_these_count_for_little():
    answers = crew(0, [good, good, good, always_equal])
    found = estimate_reliability(answers, 4, model_logits(answers, 0.85))
    assert found.answer_weights[3, EQUAL] < 0.2
    assert found.answer_weights[:3, EQUAL] == pytest.approx(found.answer_weights[:3, [LEFT, RIGHT]].mean(axis=1))
    assert found.confusion[:, :, EQUAL].sum(axis=1)[3] > 2 * PRIOR_EQUAL


@settings(max_examples=5, deadline=None)
@given(st.integers(0, 1000), st.permutations(range(8)))
def test_numbering_labellers_or_pairs_otherwise_changes_nothing(seed, order):
    answers = crew(seed, EIGHT, n_pairs=120)
    before = estimate_reliability(answers, 8)
    pair_order = np.random.default_rng(seed).permutation(120)
    renamed = LabellerAnswers(
        pair_order[answers.pairs], answers.labels, np.array(order)[answers.labellers], answers.left_segments
    )
    after = estimate_reliability(renamed, 8)
    assert after.confusion[order] == pytest.approx(before.confusion, abs=1e-4)
    assert after.weights == pytest.approx(before.weights, abs=1e-3)


@settings(max_examples=5, deadline=None)
@given(st.integers(0, 1000), st.data())
def test_swapping_the_segments_of_a_pair_changes_nothing(seed, data):
    answers = crew(seed, EIGHT, n_pairs=120)
    swapped = np.random.default_rng(data.draw(st.integers(0, 9))).random(120) < 0.5
    at = swapped[answers.pairs]
    mirrored = LabellerAnswers(
        answers.pairs,
        np.where(at, 1 - answers.labels, answers.labels),
        answers.labellers,
        np.where(at, 1 - answers.left_segments, answers.left_segments),
    )
    before, after = (estimate_reliability(each, 8) for each in (answers, mirrored))
    assert after.answer_weights == pytest.approx(before.answer_weights, abs=1e-3)


@settings(max_examples=5, deadline=None)
@given(st.integers(0, 1000))
def test_weights_lie_between_0_and_1_and_the_highest_is_1(seed):
    found = estimate_reliability(crew(seed, EIGHT, n_pairs=60), 8)
    assert found.answer_weights.min() >= 0
    assert found.answer_weights.max() == pytest.approx(1)
    assert found.confusion.sum(axis=2) == pytest.approx(np.ones((8, 2)))


def test_arrays_of_different_lengths_are_refused():
    with pytest.raises(ShapeError) as refused:
        LabellerAnswers(np.zeros(3, int), np.zeros(2, np.float32), np.zeros(3, int), np.zeros(3, int))
    assert refused.value.name == "labels"


def test_slight_preferences_are_strict_answers():
    answers = LabellerAnswers(
        np.arange(4), np.array([0.75, 0.25, 0.75, 0.5], np.float32), np.zeros(4, int), np.array([0, 0, 1, 1])
    )
    assert answers.shown.tolist() == [LEFT, RIGHT, RIGHT, EQUAL]


def linear_pairs(n_pairs=300):
    """Pairs of padded segments; the one with the higher mean of one observation is preferred."""
    rng = np.random.default_rng(0)
    observations = rng.normal(size=(200, 6, 2, 3)).astype(np.float32) + rng.normal(size=(200, 1, 1, 1)).astype(
        np.float32
    )
    mask = np.arange(6) < rng.integers(3, 7, 200)[:, None]
    observations[~mask] = 0
    segments = SegmentArrays(observations, np.zeros((200, 6, 2, 1), np.float32), mask)
    pairs = np.stack([rng.permutation(200)[:2] for _ in range(n_pairs)])
    score = observations[..., 0].sum(axis=(1, 2)) / mask.sum(axis=1)
    return PreferenceDataset(segments, pairs, (score[pairs[:, 0]] > score[pairs[:, 1]]).astype(np.float32))


def test_linear_model_predicts_pairs_it_was_not_trained_on():
    dataset = linear_pairs()
    logits = cross_fitted_logits(dataset)
    assert ((logits > 0) == (dataset.labels > 0.5)).mean() > 0.85


def test_prediction_of_a_pair_does_not_depend_on_its_label():
    dataset = linear_pairs()
    # Every label of the pair: two rows with one id.
    twice = dataset.joined(dataset.take([7]))
    changed = PreferenceDataset(
        twice.segments, twice.pairs, np.where(twice.ids == 7, 1 - twice.labels, twice.labels), twice.ids
    )
    before, after = cross_fitted_logits(twice), cross_fitted_logits(changed)
    assert before[[7, -1]].tolist() == after[[7, -1]].tolist()
    assert not math.isclose(before[8], after[8]) or not np.allclose(before, after)


def test_slight_answers_are_the_answers_of_their_side():
    labels = np.array([1, 0.75, 0.5, 0.25, 0], dtype=np.float32)
    pairs, nobody = np.arange(5), np.zeros(5, np.int64)
    assert LabellerAnswers(pairs, labels, nobody, nobody).shown.tolist() == [LEFT, LEFT, EQUAL, RIGHT, RIGHT]
    on_right = LabellerAnswers(pairs, labels, nobody, np.ones(5, np.int64))
    assert on_right.shown.tolist() == [RIGHT, RIGHT, EQUAL, LEFT, LEFT]
