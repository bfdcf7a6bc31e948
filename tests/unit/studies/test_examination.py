"""A model that knows the true reward passes; its opposite fails; calibration tells how sure they may be."""

import numpy as np
import pytest

from mapt.studies.examination import examine
from mapt.studies.pairs import split_replay
from mapt.studies.quality import Predictions, predict, preference_quality, reward_quality
from unit.studies.tiny_replay import KnowingModel


def test_a_model_that_knows_the_reward_is_right(replay):
    examined = examine(KnowingModel(), replay, "oracle", 500, seed=0)
    metrics = examined.metrics
    for name in ("accuracy", "label_accuracy", "rank_correlation", "rank_correlation_teacher", "step_correlation"):
        assert metrics[name] == pytest.approx(1.0)
    assert metrics["step_correlation_within"] == pytest.approx(1.0)
    assert set(examined.pairs.ravel()) <= set(split_replay(len(replay), 0).test)


def test_its_opposite_is_wrong(replay):
    metrics = examine(KnowingModel(-1.0), replay, "oracle", 500, seed=0).metrics
    assert metrics["accuracy"] == metrics["label_accuracy"] == 0
    assert metrics["rank_correlation"] == pytest.approx(-1.0)
    assert metrics["loss"] > np.log(2)


def test_mistakes_count_against_labels_and_not_against_judgement(replay):
    metrics = examine(KnowingModel(), replay, "mistake:mistake=0.2", 2000, seed=0).metrics
    assert metrics["accuracy"] == 1.0
    assert 0.77 < metrics["label_accuracy"] < 0.83


def test_another_seed_examines_on_other_segments(replay):
    first, second = (examine(KnowingModel(), replay, "oracle", 50, seed) for seed in (0, 1))
    assert not np.array_equal(first.pairs, second.pairs)


def test_skipped_pairs_are_left_out():
    logits, labels = np.array([2.0, -2.0, 5.0]), np.array([1.0, 0.0, np.nan])
    quality = preference_quality(logits, labels)
    assert quality["accuracy"] == 1.0
    assert quality["loss"] == pytest.approx(np.log1p(np.exp(-2.0)))


def test_padding_does_not_change_the_quality_of_rewards():
    rng = np.random.default_rng(0)
    true, learned = rng.normal(size=(2, 20, 5))
    scores = rng.normal(size=20).astype(np.float32)
    mask = np.arange(5) < rng.integers(2, 6, size=20)[:, None]

    def quality(padding: float) -> dict[str, float]:
        filled = np.where(mask, learned, padding).astype(np.float32)[..., None]
        return reward_quality(Predictions(scores, filled, filled[..., 0]), np.where(mask, true, padding), mask)

    assert quality(0.0) == pytest.approx(quality(1e3))


def test_within_segments_only_the_course_counts():
    rng = np.random.default_rng(1)
    course, level = rng.normal(size=(30, 8)), 100 * rng.normal(size=(30, 1))
    true, learned = course + level, course - level
    predictions = Predictions(learned.sum(axis=1).astype(np.float32), learned[..., None].astype(np.float32), learned)
    quality = reward_quality(predictions, true, np.ones((30, 8), np.bool_))
    assert quality["step_correlation"] < -0.9
    assert quality["step_correlation_within"] == pytest.approx(1.0, abs=1e-4)


def test_predictions_do_not_depend_on_how_many_segments_go_at_once(replay):
    whole, single = predict(KnowingModel(), replay.segments(range(80))), predict(KnowingModel(), replay.segments([79]))
    np.testing.assert_array_equal(whole.scores[79:], single.scores)
    assert whole.agent_rewards.shape == (80, 6, 2)
