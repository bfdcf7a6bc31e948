from hypothesis import given
from hypothesis import strategies as st

from accord.services.experiment_config import ExperimentConfig
from accord.workers.pacing import Progress, cannot_begin, segments_to_hand_in, threshold, version_is_due, waits_for


def config(**changes) -> ExperimentConfig:
    fields = {"task": "HalfCheetah-6x1", "total_steps": 1000, "label_budget": 100, "initial_labels": 20}
    return ExperimentConfig(**{**fields, "labels_per_version": 30, **changes})


@st.composite
def configs(draw) -> ExperimentConfig:
    budget = draw(st.integers(2, 300))
    return config(
        label_budget=budget,
        initial_labels=draw(st.integers(2, budget)),
        labels_per_version=draw(st.integers(1, 80)),
    )


def test_versions_are_due_at_the_first_labels_then_at_every_step_then_at_the_whole_budget():
    thresholds = [threshold(config(), labels) for labels in (0, 19, 20, 49, 50, 99, 100, 130)]
    assert thresholds == [0, 0, 20, 20, 50, 80, 100, 100]


@given(configs(), st.integers(0, 2000), st.integers(0, 320), st.integers(0, 320))
def test_policy_and_reward_worker_never_wait_for_each_other(config, steps, labels, trained_on):
    trained_on = min(trained_on, labels)
    progress = Progress(steps, labels, trained_on or None)
    due = version_is_due(config, labels=labels, trained_on=trained_on, changed=labels - trained_on)
    if labels >= config.schedule.due(steps) and waits_for(config, progress):
        assert due


@given(configs(), st.integers(0, 2000))
def test_policy_goes_on_once_a_version_has_all_due_labels(config, steps):
    due = config.schedule.due(steps)
    assert waits_for(config, Progress(steps, due, due)) is None


def test_waiting_says_how_many_labels_are_missing():
    assert waits_for(config(), Progress(0, 12, None)) == "12 of 20 labels for the first reward version."


def test_free_pacing_waits_for_the_first_version_alone():
    free = config(pacing="free")
    assert waits_for(free, Progress(0, 0, None))
    assert waits_for(free, Progress(900, 20, 20)) is None
    assert waits_for(config(), Progress(900, 20, 20))


def test_missing_labels_that_cannot_come_are_not_waited_for():
    assert waits_for(config(), Progress(900, 50, 50))
    assert waits_for(config(), Progress(900, 50, 50, exhausted=True)) is None
    assert waits_for(config(), Progress(900, 50, 20, exhausted=True)), (
        "a version is due that knows those that are there"
    )


def test_an_experiment_whose_first_segments_make_too_few_pairs_cannot_begin():
    assert "initial_labels is 20" in str(cannot_begin(config(), Progress(0, 6, None, exhausted=True)))
    assert cannot_begin(config(), Progress(0, 6, None)) is None
    assert cannot_begin(config(), Progress(0, 20, None, exhausted=True)) is None
    assert cannot_begin(config(), Progress(0, 6, 6, exhausted=True)) is None


def test_true_reward_never_waits():
    assert waits_for(config(reward_source="true"), Progress(0, 0, None)) is None


def test_changed_labels_bring_a_version_when_there_are_enough_of_them():
    assert not version_is_due(config(), labels=50, trained_on=50, changed=29)
    assert version_is_due(config(), labels=50, trained_on=50, changed=30)
    assert version_is_due(config(), labels=100, trained_on=100, changed=1)
    assert not version_is_due(config(), labels=100, trained_on=100, changed=0)


@given(configs(), st.integers(1, 400), st.integers(1, 200))
def test_pool_holds_about_four_segments_a_label(config, rollout_steps, fitting):
    n_rollouts = -(-config.total_steps // rollout_steps)
    counts = [
        segments_to_hand_in(config, iteration=i, rollout_steps=rollout_steps, fitting=fitting)
        for i in range(n_rollouts)
    ]
    assert max(counts) <= fitting
    assert sum(counts) <= max(4 * config.label_budget, counts[0]) + 3 * n_rollouts


def test_first_rollout_gives_segments_for_the_first_queries():
    assert segments_to_hand_in(config(), iteration=0, rollout_steps=100, fitting=500) == 64
    assert segments_to_hand_in(config(initial_labels=90), iteration=0, rollout_steps=100, fitting=500) == 196
    assert segments_to_hand_in(config(), iteration=0, rollout_steps=100, fitting=10) == 10
