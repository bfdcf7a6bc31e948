"""Teachers look at a replay a thousand segments at a time, and give as many labels as were asked for."""

import numpy as np
import pytest

from mapt.preferences.teachers import InvalidTeacher, UnknownTeacher
from mapt.studies.errors import TooFewLabels
from mapt.studies.judging import Judge, labelled_dataset
from mapt.studies.pairs import training_pairs
from unit.studies.tiny_replay import write_replay


def test_the_oracle_judges_by_the_true_return(replay):
    pairs = training_pairs(len(replay), 200, seed=0)
    better = np.subtract(*replay.returns[pairs].T) > 0
    judge = Judge("oracle", replay, seed=0)
    np.testing.assert_array_equal(judge.labels(pairs) == 1, better)
    np.testing.assert_allclose(judge.scores(np.arange(10)), replay.returns[:10])


def test_a_myopic_teacher_scores_late_steps_higher(replay):
    scores = Judge("myopic", replay, seed=0).scores(np.arange(5))
    fading = 0.9 ** np.arange(replay.source.n_steps)[::-1]
    np.testing.assert_allclose(scores, (replay.rewards[:5] * fading).sum(axis=1))


def test_labels_without_chance_follow_the_scores(replay):
    pairs = training_pairs(len(replay), 200, seed=0)
    for name in ("oracle", "myopic", "smoothness"):
        judge = Judge(name, replay, seed=0)
        scores = judge.scores(np.arange(len(replay)))
        np.testing.assert_array_equal(judge.labels(pairs), 0.5 + 0.5 * np.sign(np.subtract(*scores[pairs].T)))


def test_parameters_in_the_name_change_the_teacher(replay):
    pairs = training_pairs(len(replay), 400, seed=0)
    usual, careless = (Judge(name, replay, seed=0) for name in ("oracle", "mistake:mistake=0.4"))
    assert careless.parameters()["mistake"] == 0.4
    assert 0.3 < (usual.labels(pairs) != careless.labels(pairs)).mean() < 0.5


def test_a_teacher_says_the_same_of_many_pairs_at_once_as_of_few(replay):
    pairs = training_pairs(len(replay), 1600, seed=0)
    at_once = Judge("stochastic", replay, seed=3).labels(pairs)
    one_by_one = Judge("stochastic", replay, seed=3)
    np.testing.assert_array_equal(
        at_once, np.concatenate([one_by_one.labels(part) for part in pairs.reshape(8, -1, 2)])
    )


def test_skipped_pairs_are_replaced(replay):
    skipping = "skip:skip=1.2"
    dataset = labelled_dataset(Judge(skipping, replay, seed=0), replay, 150, seed=0)
    assert len(dataset) == 150
    assert np.isfinite(dataset.labels).all()
    asked = Judge(skipping, replay, seed=0).labels(training_pairs(len(replay), 150, seed=0))
    assert np.isnan(asked).any()


def test_labels_belong_to_the_segments_they_were_given_for(replay):
    dataset = labelled_dataset(Judge("oracle", replay, seed=0), replay, 100, seed=0)
    returns = dataset.segments.take(np.arange(len(dataset.segments))).observations[..., 0].mean(axis=2).sum(axis=1)
    np.testing.assert_array_equal(dataset.labels == 1, np.subtract(*returns[dataset.pairs].T) > 0)


def test_a_teacher_that_skips_everything_is_given_up(tmp_path):
    replay = write_replay(tmp_path / "small")
    with pytest.raises(TooFewLabels, match="skip:skip=1000"):
        labelled_dataset(Judge("skip:skip=1000", replay, seed=0), replay, 10, seed=0)


@pytest.mark.parametrize(("name", "error"), [("nobody", UnknownTeacher), ("oracle:age=3", InvalidTeacher)])
def test_an_unknown_teacher_or_parameter_is_refused(replay, name, error):
    with pytest.raises(error):
        Judge(name, replay, seed=0)
