"""Scores of a policy's segments by scripted teachers."""

import numpy as np
import pytest

from mapt.errors import DamagedRun, InvalidTeacher
from mapt.policies.learner import Learner, untrained_policy
from mapt.preferences.teachers import make_teacher
from mapt.tasks import make_task, task_spec
from mapt.training.evaluation import evaluate_policy
from mapt.training.run_folder import RunFolder
from mapt.training.teacher_scores import (
    TeacherScores,
    preference_rate,
    read_teacher_scores,
    score_policy,
    write_teacher_scores,
)
from support.short_tasks import SHORTEST_NAME


@pytest.fixture
def policy(settings):
    return untrained_policy(task_spec(SHORTEST_NAME), settings().policy)


def score(policy, teacher: str, segment_steps: int, **options):
    return score_policy(
        policy, SHORTEST_NAME, make_teacher(teacher), agent_obsk=1, segment_steps=segment_steps, episodes=4, **options
    )


@pytest.mark.parametrize("deterministic", [True, False])
def test_the_oracles_scores_of_whole_episodes_are_their_returns(policy, deterministic):
    playing = {"seed": 2, "deterministic": deterministic}
    returns = evaluate_policy(policy, SHORTEST_NAME, agent_obsk=1, episodes=4, **playing).returns
    scores = score(policy, "oracle", task_spec(SHORTEST_NAME).horizon_steps, **playing)
    # Segments come in random order.
    np.testing.assert_allclose(np.sort(scores), np.sort(returns), rtol=1e-12)


def test_as_many_segments_as_fit_are_scored_and_the_same_seed_gives_the_same_scores(policy):
    first = score(policy, "phase", 8)
    assert len(first) == 4 * (task_spec(SHORTEST_NAME).horizon_steps // 8)
    np.testing.assert_array_equal(first, score(policy, "phase", 8))
    assert (first != score(policy, "phase", 8, seed=1)).any()


def test_errors_of_a_teacher_do_not_change_its_scores(policy):
    np.testing.assert_array_equal(score(policy, "phase", 8), score(policy, "phase+mistake", 8))


def test_no_segment_fits_into_shorter_episodes(policy):
    assert score(policy, "phase", 1000).shape == (0,)


def test_the_untrained_policy_is_the_one_that_a_learner_starts_with(settings, policy):
    task = make_task(SHORTEST_NAME, 4)
    learner = Learner(task, settings().policy)
    for name, weights in learner.policy.state_dict().items():
        np.testing.assert_array_equal(weights.numpy(), policy.state_dict()[name].numpy())
    task.close()


def test_the_preference_rate_is_the_fraction_of_pairs_and_ties_are_half():
    rate = preference_rate(np.array([1.0, 2.0]), np.array([0.0, 1.0, 1.0, 3.0]))
    # 1.0 beats one of four and ties with two, 2.0 beats three.
    assert rate == (1 + 2 / 2 + 3) / 8
    assert preference_rate(np.array([2.0, 3.0]), np.array([1.0])) == 1.0


def test_scores_by_another_teacher_are_kept(tmp_path):
    folder = RunFolder(tmp_path)
    assert read_teacher_scores(folder) == {}
    scores = [TeacherScores(96, 50, np.array([0.1]), np.array([value, 0.1 + 0.2])) for value in (0.5, 0.6, 0.7)]
    for teacher, each in zip(("phase", "recency", "phase"), scores, strict=True):
        write_teacher_scores(folder, teacher, each)
    found = read_teacher_scores(folder)
    assert {teacher: each.final.tolist() for teacher, each in found.items()} == {
        "phase": [0.7, 0.1 + 0.2],
        "recency": [0.6, 0.1 + 0.2],
    }
    assert (found["phase"].steps, found["phase"].segment_steps) == (96, 50)
    folder.teacher_scores.write_text('{"phase": {"steps": 96}}')
    with pytest.raises(DamagedRun) as caught:
        read_teacher_scores(folder)
    assert caught.value.path == folder.teacher_scores


def test_a_rule_about_joints_scores_no_skirmish(settings):
    policy = untrained_policy(task_spec("3m"), settings().policy)
    with pytest.raises(InvalidTeacher, match="3m have none"):
        score_policy(policy, "3m", make_teacher("phase"), agent_obsk=1, segment_steps=10, episodes=2)
    scores = score_policy(policy, "3m", make_teacher("oracle"), agent_obsk=1, segment_steps=10, episodes=2)
    assert len(scores) >= 2
