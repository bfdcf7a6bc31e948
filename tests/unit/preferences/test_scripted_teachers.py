import json
import math
import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mapt.errors import InvalidTeacher, MissingArray, ShapeError, UnknownTeacher
from mapt.preferences.teachers import (
    PRESETS,
    RULES,
    BPrefParameters,
    OracleTeacher,
    Phase,
    Return,
    ScriptedTeacher,
    TeacherView,
    make_teacher,
    teacher_names,
)
from mapt.tasks import task_spec

MANY = 20_000


def view(rewards, mask=None):
    return TeacherView(np.array(rewards, dtype=np.float64), None if mask is None else np.array(mask))


def many_pairs(gap, n_pairs=MANY, base=10.0):
    """Pairs of one-step segments whose returns differ by `gap`."""
    return view(np.full((n_pairs, 1), base + gap)), view(np.full((n_pairs, 1), base))


def random_pairs(n_pairs, seed=0, mean=5.0, n_steps=6):
    rng = np.random.default_rng(seed)
    return tuple(view(rng.normal(mean, 1, size=(n_pairs, n_steps))) for _ in range(2))


def within_binomial_bounds(fraction, probability, n=MANY):
    return abs(fraction - probability) < 4 * math.sqrt(probability * (1 - probability) / n)


def test_oracle_prefers_the_higher_return():
    first, second = view([[1.0, 5.0], [0.0, 0.0], [2.0, 1.0]]), view([[3.0, 1.0], [1.0, 0.0], [1.0, 2.0]])
    for teacher in (OracleTeacher(), make_teacher("oracle")):
        labels = teacher.judge(first, second)
        assert labels.tolist() == [1.0, 0.0, 0.5]
        assert labels.dtype == np.float32


def test_oracle_label_is_the_index_of_the_worse_segment():
    first, second = random_pairs(50)
    worse = np.argmin([first.rewards.sum(1), second.rewards.sum(1)], axis=0)
    assert make_teacher("oracle").judge(first, second).tolist() == worse.tolist()


def test_oracle_ignores_padding():
    labels = OracleTeacher().judge(view([[1.0, 99.0]], [[True, False]]), view([[1.0, 1.0]]))
    assert labels.tolist() == [0.0]


def test_segments_of_a_pair_may_differ_in_length():
    assert OracleTeacher().judge(view([[1.0, 1.0, 1.0]]), view([[2.0]])).tolist() == [1.0]


def test_views_of_different_numbers_of_segments_are_refused():
    with pytest.raises(ShapeError):
        OracleTeacher().judge(view([[1.0]]), view([[1.0], [2.0]]))


@pytest.mark.parametrize("gap", [-2.0, -0.5, 0.0, 1.0])
@pytest.mark.parametrize("beta", [0.5, 1.0, 3.0])
def test_stochastic_teacher_follows_the_boltzmann_model(gap, beta):
    labels = make_teacher("stochastic", beta=beta).judge(*many_pairs(gap))
    assert set(labels.tolist()) <= {0.0, 1.0}
    assert within_binomial_bounds(labels.mean(), 1 / (1 + math.exp(-beta * gap)))


def test_large_differences_do_not_overflow():
    teacher = make_teacher("stochastic", beta=1e6)
    assert teacher.judge(*many_pairs(1e9, 10)).tolist() == [1.0] * 10
    assert teacher.judge(*many_pairs(-1e9, 10)).tolist() == [0.0] * 10


def test_mistakes_have_their_rate_in_both_directions():
    for gap, right in ((1.0, 1.0), (-1.0, 0.0)):
        labels = make_teacher("mistake").judge(*many_pairs(gap))
        assert within_binomial_bounds((labels != right).mean(), 0.1)


def test_mistakes_do_not_change_equal_labels():
    assert set(make_teacher("mistake", mistake=1.0).judge(*many_pairs(0.0, 20)).tolist()) == {0.5}


def test_mistakes_apply_after_boltzmann_noise():
    labels = make_teacher("stochastic", mistake=0.2).judge(*many_pairs(1.0))
    right = 1 / (1 + math.exp(-1))
    assert within_binomial_bounds(labels.mean(), 0.8 * right + 0.2 * (1 - right))


def test_myopic_teacher_does_not_discount_the_last_step():
    # 0.9 x 1.05 < 1: the later reward wins, wherever the padding starts.
    first, second = view([[0.0, 1.0, 0.0]], [[True, True, False]]), view([[0.0, 1.05, 0.0]])
    assert make_teacher("myopic").judge(first, second).tolist() == [1.0]
    assert make_teacher("oracle").judge(first, second).tolist() == [0.0]


@given(st.lists(st.floats(-5, 5), min_size=1, max_size=6), st.floats(0, 1))
def test_myopic_scores_equal_a_plain_loop(rewards, gamma):
    discounted = sum(gamma ** (len(rewards) - 1 - step) * reward for step, reward in enumerate(rewards))
    judge = make_teacher("myopic", gamma=gamma).judge
    assert judge(view([rewards]), view([[discounted - 1e-6]])).tolist() == [1.0]
    assert judge(view([rewards]), view([[discounted + 1e-6]])).tolist() == [0.0]


def test_pair_is_skipped_only_if_both_scores_are_below_the_threshold():
    teacher = make_teacher("skip", skip=0.1)
    teacher.set_episode_return(100.0, 20)
    # T = 2 of 20 steps: the threshold is 0.1 x 100 x 2 / 20 = 1.
    first = view([[0.5, 0.5], [0.5, 0.5], [0.0, 0.0]])
    second = view([[0.0, 0.0], [0.6, 0.5], [0.0, 1.0]])
    assert np.isnan(teacher.judge(first, second)).tolist() == [True, False, True]


def test_pair_is_equal_if_scores_differ_by_less_than_the_threshold():
    teacher = make_teacher("equal", equal=0.1)
    teacher.set_episode_return(100.0, 20)
    first, second = view([[4.0, 0.9], [4.0, 1.0], [0.0, 0.0]]), view([[4.0, 0.0]] * 3)
    assert teacher.judge(first, second).tolist() == [0.5, 1.0, 0.0]


def test_threshold_is_proportional_to_its_parameter_and_to_the_episode_return():
    teacher = make_teacher("equal", equal=0.5)
    teacher.set_episode_return(8.0, 1)
    assert teacher.judge(view([[13.9], [14.1]]), view([[10.0], [10.0]])).tolist() == [0.5, 1.0]
    teacher.set_episode_return(8.0, 1)
    assert teacher.judge(view([[13.9], [14.1]]), view([[10.0], [10.0]])).tolist() == [0.5, 1.0]


def test_equal_overrides_mistakes_and_skip_overrides_both():
    teacher = make_teacher("equal", equal=0.1, mistake=1.0)
    teacher.set_episode_return(10.0, 1)
    assert teacher.judge(view([[5.0], [5.0]]), view([[5.5], [7.0]])).tolist() == [0.5, 1.0]
    teacher = make_teacher("equal", equal=10.0, skip=0.1, mistake=1.0)
    teacher.set_episode_return(10.0, 1)
    assert np.isnan(teacher.judge(view([[0.9]]), view([[1.0]]))).all()


def test_skip_and_equal_compare_undiscounted_returns():
    early, late = view([[2.0, 0.0], [2.0, 0.0]]), view([[0.0, 0.1], [0.0, 1.9]])
    skipping = make_teacher("myopic", gamma=0.0, skip=1.0)
    skipping.set_episode_return(1.0, 2)
    # A return of 2 is above the threshold of 1, although its discounted return is 0.
    assert skipping.judge(early, late).tolist() == [0.0, 0.0]
    equalling = make_teacher("myopic", gamma=0.0, equal=1.0)
    equalling.set_episode_return(1.0, 2)
    # The returns differ by 1.9 and 0.1, the discounted returns by 0.1 and 1.9; the threshold is 1.
    assert equalling.judge(early, late).tolist() == [0.0, 0.5]


def test_a_myopic_teacher_with_thresholds_labels_as_b_pref():
    first, second = random_pairs(500, mean=1.0)
    teacher = make_teacher("myopic", gamma=0.7, skip=0.9, equal=0.2)
    teacher.set_episode_return(1.0, 1)
    labels = teacher.judge(first, second)
    skip, equal = 0.9 * 6, 0.2 * 6
    expected = []
    for rewards in zip(first.rewards, second.rewards, strict=True):
        returns = [sum(each) for each in rewards]
        # B-Pref multiplies all steps but the last by gamma, then all but the last two, ...
        discounted = [sum(reward * 0.7 ** (5 - step) for step, reward in enumerate(each)) for each in rewards]
        label = float(discounted[0] > discounted[1])
        label = 0.5 if abs(returns[0] - returns[1]) < equal else label
        expected.append(np.nan if max(returns) <= skip else label)
    assert {0.0, 0.5, 1.0} <= set(labels.tolist())
    assert np.isnan(labels).any()
    np.testing.assert_array_equal(labels, expected)


def test_without_episode_returns_thresholds_follow_the_segments():
    first, second = random_pairs(400)
    informed, uninformed = make_teacher("equal", equal=0.02), make_teacher("equal", equal=0.02)
    informed.set_episode_return(5.0, 1)
    same = informed.judge(first, second) == uninformed.judge(first, second)
    assert same.mean() > 0.98
    assert 0.05 < (uninformed.judge(first, second) == 0.5).mean() < 0.5


@pytest.mark.parametrize("mean", [-50.0, 0.0])
def test_skip_and_equal_work_with_returns_that_are_not_positive(mean):
    first, second = random_pairs(2000, mean=mean)
    skipping, equalling = make_teacher("skip", skip=0.1), make_teacher("equal", equal=0.1)
    if mean < 0:
        # Both below m - 0.9 s: 18.4 % of a normal distribution, squared.
        assert np.isnan(skipping.judge(first, second)).mean() == pytest.approx(0.034, abs=0.02)
        # |difference| < 0.1 s, where a difference has standard deviation sqrt(2) s.
        assert (equalling.judge(first, second) == 0.5).mean() == pytest.approx(0.056, abs=0.025)
    assert 0 < np.isnan(skipping.judge(first, second)).mean() < 0.5


def test_thresholds_of_negative_returns_do_not_depend_on_a_constant_offset():
    rewards = [np.random.default_rng(side).normal(-3, 1, size=(300, 4)) for side in (0, 1)]
    labels = [
        make_teacher("skip", skip=0.3, equal=0.2).judge(*(view(each - shift) for each in rewards))
        for shift in (0.0, 100.0)
    ]
    np.testing.assert_array_equal(*labels)


def test_statistics_follow_the_last_pairs():
    teacher = make_teacher("equal", equal=0.1)
    teacher.judge(*random_pairs(500, mean=1000.0))
    before = (teacher.judge(*random_pairs(1, mean=5.0)) == 0.5).mean()
    for seed in range(10):
        labels = teacher.judge(*random_pairs(200, seed=seed, mean=5.0))
    assert before == 1.0
    assert (labels == 0.5).mean() < 0.9


@pytest.mark.parametrize("name", [*teacher_names(), "best-second+mistake", "phase+stochastic", "recency+skip"])
def test_labels_do_not_depend_on_the_batch_size(name):
    rng = np.random.default_rng(3)

    def random_view():
        shape = (700, 8)
        rewards, observations = rng.normal(1, 2, size=shape), rng.normal(size=(*shape, 6, 9))
        # states of two ants and a board, whose orientation is level
        qpos, qvel = rng.normal(size=(*shape, 37)), rng.normal(size=(*shape, 34))
        qpos[..., -4:] = [1.0, 0.0, 0.0, 0.0]
        return TeacherView(rewards, None, observations, rng.normal(size=(*shape, 6, 1)), qpos, qvel)

    first, second = random_view(), random_view()
    whole = make_teacher(name, seed=5).judge(first, second)
    teacher, parts = make_teacher(name, seed=5), np.split(np.arange(700), [1, 2, 40, 600])
    np.testing.assert_array_equal(
        whole, np.concatenate([teacher.judge(first.take(part), second.take(part)) for part in parts])
    )


def test_labels_are_reproducible_from_the_seed():
    pairs = many_pairs(0.0, 100)
    labels = [make_teacher("stochastic", seed=seed).judge(*pairs).tolist() for seed in (0, 0, 1)]
    assert labels[0] == labels[1] != labels[2]


def test_boltzmann_noise_of_a_rule_does_not_depend_on_the_unit_of_its_scores():
    first, second = random_pairs(MANY)
    labels = [
        make_teacher("recency+stochastic", window_steps=2).judge(
            *(view(each.rewards * unit) for each in (first, second))
        )
        for unit in (1.0, 1000.0)
    ]
    np.testing.assert_array_equal(*labels)
    right = make_teacher("recency", window_steps=2).judge(first, second)
    assert 0.6 < (labels[0] == right).mean() < 0.8


def test_mistakes_of_a_rule_have_their_rate():
    first, second = random_pairs(MANY)
    mistaken, right = (
        make_teacher(name, window_steps=2).judge(first, second) for name in ("best-second+mistake", "best-second")
    )
    assert within_binomial_bounds((mistaken != right).mean(), 0.1)


def test_teacher_names_list_presets_before_rules():
    assert teacher_names() == (*PRESETS, *list(RULES)[1:])
    assert len(set(teacher_names())) == len(teacher_names())


@pytest.mark.parametrize("name", [*teacher_names(), "phase+mistake", "return+equal"])
def test_parameters_are_json_and_make_the_same_teacher(name):
    changes = {"seed": 7, "equal": 0.25}
    parameters = make_teacher(name, **changes).parameters()
    assert json.loads(json.dumps(parameters, allow_nan=False)) == parameters
    assert (parameters["name"], parameters["seed"], parameters["equal"]) == (name, 7, 0.25)
    arguments = {key: value for key, value in parameters.items() if key not in {"name", "rule"}}
    assert make_teacher(name, **arguments).parameters() == parameters


def test_parameters_of_a_rule_with_a_preset():
    assert make_teacher("phase+mistake", column=3).parameters() == {
        "name": "phase+mistake",
        "rule": "phase",
        "seed": 0,
        "beta": None,
        "gamma": 1.0,
        "mistake": 0.1,
        "skip": 0.0,
        "equal": 0.0,
        "column": 3,
        "first_agent": 0,
        "second_agent": -1,
        "want": "opposite",
    }


@pytest.mark.parametrize("name", ["", "nobody", "phase+", "+mistake", "mistake+phase", "phase+phase", "oracle+mistake"])
def test_unknown_name_is_refused_with_the_known_ones(name):
    with pytest.raises(UnknownTeacher) as refused:
        make_teacher(name)
    assert (refused.value.name, refused.value.known) == (name, teacher_names())


@pytest.mark.parametrize(
    ("name", "parameters"),
    [
        ("oracle", {"window_steps": 3}),
        ("phase", {"colour": 3}),
        ("phase", {"want": "sideways"}),
        ("phase", {"column": 1.5}),
        ("phase", {"column": True}),
        ("phase", {"column": "1"}),
        ("smoothness", {"columns": 3}),
        ("smoothness", {"columns": [1.5]}),
        ("recency", {"above_mean": None}),
        ("recency", {"above_mean": math.nan}),
        ("recency", {"window_steps": 0}),
        ("recency", {"window_steps": math.inf}),
        ("oracle", {"seed": "a"}),
        ("oracle", {"seed": -1}),
        ("oracle", {"name": "mistake"}),
        ("oracle", {"beta": 0}),
        ("oracle", {"beta": math.inf}),
        ("oracle", {"beta": math.nan}),
        ("oracle", {"gamma": 1.1}),
        ("oracle", {"mistake": -0.1}),
        ("oracle", {"skip": -1}),
        ("oracle", {"equal": math.inf}),
        ("phase", {"gamma": 0.9}),
        ("phase+myopic", {}),
    ],
)
def test_invalid_parameters_are_refused(name, parameters):
    with pytest.raises(InvalidTeacher):
        make_teacher(name, **parameters)


def test_numbers_and_lists_are_converted_to_the_type_of_the_parameter():
    assert make_teacher("recency", window_steps=4.0, above_mean=1).parameters()["window_steps"] == 4
    assert make_teacher("recency", window_steps=np.int64(4)).parameters()["window_steps"] == 4
    assert make_teacher("smoothness", columns=[1, 2]).parameters()["columns"] == [1, 2]


def test_teacher_can_be_made_from_a_rule_and_parameters():
    teacher = ScriptedTeacher(Phase(column=0), BPrefParameters(mistake=1.0), np.random.default_rng(0))
    assert teacher.parameters()["mistake"] == 1.0
    assert ScriptedTeacher(Return(), BPrefParameters(), np.random.default_rng(0)).judge(
        *many_pairs(1.0, 2)
    ).tolist() == [1, 1]


@pytest.mark.parametrize(("mean", "length"), [(math.nan, 10), (1.0, 0), (1.0, math.inf)])
def test_invalid_episode_returns_are_refused(mean, length):
    with pytest.raises(InvalidTeacher):
        make_teacher("skip").set_episode_return(mean, length)


def test_careless_teacher_guesses_on_its_share_of_the_pairs():
    labels = make_teacher("careless", guess=0.6).judge(*many_pairs(5.0))
    assert within_binomial_bounds((labels == 0).mean(), 0.3)
    assert set(labels.tolist()) == {0, 1}


@pytest.mark.parametrize("preferred", [1.0, -1.0])
def test_left_biased_teacher_prefers_the_left_segment_on_its_share_of_the_pairs(preferred):
    pairs, sides = many_pairs(preferred), np.arange(MANY) % 2
    labels = make_teacher("left", left=0.4).judge(*pairs, left_segments=sides)
    better = 0 if preferred > 0 else 1
    on_left, on_right = labels[sides == better], labels[sides != better]
    assert set(on_left.tolist()) == {1.0 - better}
    assert within_binomial_bounds((on_right == better).mean(), 0.4, MANY // 2)


def test_without_sides_segment_0_is_on_the_left():
    pairs = random_pairs(200)
    first = make_teacher("left", seed=3).judge(*pairs)
    assert first.tolist() == make_teacher("left", seed=3).judge(*pairs, left_segments=np.zeros(200, int)).tolist()


def test_opposite_teacher_reverses_every_strict_label():
    pairs = random_pairs(50)
    assert (make_teacher("opposite").judge(*pairs) == 1 - make_teacher("oracle").judge(*pairs)).all()


@pytest.mark.parametrize("name", ["stochastic", "mistake"])
def test_inattention_leaves_the_other_labels_as_they_are(name):
    pairs = random_pairs(500)
    usual, inattentive = make_teacher(name, seed=5).judge(*pairs), make_teacher(name, seed=5, guess=0.2).judge(*pairs)
    assert 0.02 < (usual != inattentive).mean() < 0.2


def test_slight_teacher_prefers_the_same_segment_slightly_where_scores_are_close():
    first, second = random_pairs(2000, mean=2.0)
    oracle, slight = (make_teacher(name).judge(first, second) for name in ("oracle", "slight"))
    assert set(slight.tolist()) == {0.0, 0.25, 0.75, 1.0}
    assert ((slight > 0.5) == (oracle > 0.5)).all()
    gap = np.abs(first.rewards.sum(1) - second.rewards.sum(1))
    weak = (slight == 0.25) | (slight == 0.75)
    assert gap[weak].mean() < gap[~weak].mean()
    assert make_teacher("slight", slight=1e3).judge(first, second).tolist() == (0.25 + oracle / 2).tolist()
    # The threshold is a fraction of the running mean return, about 12 here.
    assert gap[weak].max() < 0.3 * 12 * 1.2


def test_equal_returns_stay_equal_for_a_slight_teacher():
    first, second = many_pairs(0.0, 5)
    assert make_teacher("slight").judge(first, second).tolist() == [0.5] * 5
    assert make_teacher("slight", equal=0.3).judge(*many_pairs(0.1, 5)).tolist() == [0.5] * 5


def test_parameters_of_earlier_teachers_do_not_name_slight():
    assert "slight" not in make_teacher("oracle").parameters()
    assert make_teacher("slight").parameters()["slight"] == 0.3


def test_a_rule_about_joints_refuses_a_task_whose_agents_choose_among_actions() -> None:
    for name in ("oracle", "slight", "recency", "best-second+mistake"):
        make_teacher(name).check_task("3m", discrete_actions=True)
    for name in ("phase", "smoothness", "low-effort+mistake", "never-falls"):
        make_teacher(name).check_task("HalfCheetah-6x1", discrete_actions=False)
        with pytest.raises(InvalidTeacher, match=re.escape(f"{name} judges how the joints of a robot move")) as caught:
            make_teacher(name).check_task("3m", discrete_actions=True)
        assert "best-second" in str(caught.value)
        assert "return" not in str(caught.value)


def test_a_rule_is_refused_where_the_task_lacks_what_it_reads() -> None:
    cheetah = task_spec("HalfCheetah-6x1")
    for name in teacher_names():
        if name not in ("carry", "attack"):
            make_teacher(name).check_spec(cheetah)
    make_teacher("carry").check_spec(task_spec("Porters-2x8"))
    make_teacher("attack").check_spec(task_spec("Football-3-vs-1"))
    for name, prefix in (("attack", "Football-"), ("carry", "Porters-")):
        with pytest.raises(
            InvalidTeacher, match=f"{name} judges tasks whose names begin with {prefix}, not HalfCheetah.* phase"
        ):
            make_teacher(name).check_spec(cheetah)
    with pytest.raises(InvalidTeacher, match=r"phase judges how .* Teachers for it: .*recency, attack"):
        make_teacher("phase").check_spec(task_spec("Football-3-vs-1"))
    assert make_teacher("attack+mistake").name == "attack+mistake"
    assert ScriptedTeacher(Phase(), BPrefParameters(), np.random.default_rng(0)).name == "Phase"
    for teacher in (make_teacher("phase", column=99), make_teacher("phase", first_agent=6)):
        with pytest.raises(MissingArray):
            teacher.check_spec(cheetah)
