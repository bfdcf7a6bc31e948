"""Scripted teachers at work over HTTP, as people are."""

from collections.abc import Generator
from itertools import combinations

import numpy as np
import pytest
from sqlalchemy import select as sql_select

from accord.cli.client import Api, Refused
from accord.cli.teach import TeacherChoice, teach_experiment
from accord.domain.enums import Role
from accord.services import collect, metrics, select
from accord.services.collect import NewSegment, load_arrays
from accord.store.tables import LabelRow, QueryRow, SegmentRow
from mapt.errors import PreferenceError
from mapt.preferences.teachers import RULES, TeacherView, make_teacher, teacher_names
from support.api_in_thread import ApiServer
from support.sample_experiments import AGENTS, NQ, NV, OBSERVATION, STEPS, SampleExperiment, create_sample

N_LABELS = 12


@pytest.fixture
def api_of_teacher(api: ApiServer) -> Generator[Api]:
    client = Api(api.url, api.tokens[Role.TEACHER])
    yield client
    client.close()


def moving_segment(rng: np.random.Generator) -> NewSegment:
    """Every rule has something to see in it."""
    return NewSegment(
        observations=rng.normal(size=(STEPS, AGENTS, OBSERVATION)),
        actions=rng.normal(size=(STEPS, AGENTS, 1)),
        rewards=rng.normal(5, 1, size=STEPS) + rng.normal(),
        qpos=np.zeros((STEPS, NQ)),
        qvel=np.zeros((STEPS, NV)),
        policy_iteration=0,
        policy_steps=0,
    )


@pytest.fixture
def sample(api: ApiServer) -> SampleExperiment:
    """An experiment with more queries than the labels it wants, over segments that all differ."""
    stores, rng = api.stores, np.random.default_rng(0)
    found = create_sample(
        stores.database, stores.blobs, segments=0, queries=0, label_budget=N_LABELS, render_clips=False
    )
    stored = [collect.store_arrays(stores.blobs, found.experiment.id, moving_segment(rng)) for _ in range(8)]
    with stores.database.transaction() as session:
        collect.collect(session, found.experiment.id, stored)
    with stores.database.transaction() as session:
        pairs = list(combinations([each.id for each in stored], 2))
        select.add_queries(session, found.experiment, pairs, "uniform")
    return found


def teach(
    api: Api, sample: SampleExperiment, name: str, *parameters: str, labels: int = N_LABELS, seed: int = 0
) -> int:
    teacher = TeacherChoice.parse(":".join((name, *parameters))).teacher(seed)
    taught = teach_experiment(
        api, sample.experiment.id, teacher, labels, on_progress=lambda _: None, stopped=lambda: False
    )
    return taught.labels


def labelled(api: ApiServer) -> list[tuple[LabelRow, TeacherView, TeacherView]]:
    """Labels in the order in which they were given, with what was seen of segments 0 and 1."""
    with api.stores.database.reading() as session:
        rows = session.execute(
            sql_select(LabelRow, QueryRow).join(QueryRow, QueryRow.id == LabelRow.query_id).order_by(LabelRow.revision)
        ).all()
        keys = dict(session.execute(sql_select(SegmentRow.id, SegmentRow.blob_key)).all())

    def seen(segment_id: str) -> TeacherView:
        return TeacherView.stack([load_arrays(api.stores.blobs, keys[segment_id])])

    return [(label, seen(query.segment_0_id), seen(query.segment_1_id)) for label, query in rows]


@pytest.mark.parametrize("name", ["oracle", *(name for name in RULES if name != "return")])
def test_every_rule_labels_over_rest_as_it_does_by_itself(
    api: ApiServer, api_of_teacher: Api, sample: SampleExperiment, name: str
) -> None:
    short = ("window_steps=2",) if hasattr(make_teacher(name).rule, "window_steps") else ()
    assert teach(api_of_teacher, sample, name, *short) == N_LABELS
    judge = TeacherChoice.parse(":".join((name, *short))).teacher(0).judge
    rows = labelled(api)
    assert [row.value for row, _, _ in rows] == [judge(first, second)[0] for _, first, second in rows]
    assert {0.0, 1.0} <= {row.value for row, _, _ in rows}


def test_name_and_parameters_arrive_in_the_labels_record(
    api: ApiServer, api_of_teacher: Api, sample: SampleExperiment
) -> None:
    teach(api_of_teacher, sample, "phase+mistake", "mistake=0.5", "column=3", "want=equal", seed=4)
    expected = make_teacher("phase+mistake", seed=4, mistake=0.5, column=3, want="equal").parameters()
    assert expected["name"] == "phase+mistake"
    assert [row.teacher for row, _, _ in labelled(api)] == [expected] * N_LABELS


@pytest.mark.parametrize("name", [*(name for name in teacher_names() if name not in RULES), "recency+equal"])
def test_every_habit_works_over_rest(api: ApiServer, api_of_teacher: Api, sample: SampleExperiment, name: str) -> None:
    short = ("window_steps=2",) if name.startswith("recency") else ()
    assert teach(api_of_teacher, sample, name, *short) == N_LABELS
    given = [row for row, _, _ in labelled(api) if row.state == "label"]
    assert {row.teacher["name"] for row in given} == {name}


def test_a_skip_is_no_label_and_another_query_takes_its_place(
    api: ApiServer, api_of_teacher: Api, sample: SampleExperiment
) -> None:
    with api.stores.database.transaction() as session:
        worst_six = sorted(session.scalars(sql_select(SegmentRow.true_return)))[5]
        # Episodes of a thousand steps, segments of five: half the mean return of so many steps is the sixth's.
        metrics.record(session, sample.experiment.id, 1, {"true_return": worst_six * 400})
    assert teach(api_of_teacher, sample, "skip", "skip=0.5000001") == N_LABELS
    rows = labelled(api)
    assert {row.state for row, _, _ in rows} == {"label", "skip"}
    for row, first, second in rows:
        assert (row.state == "skip") == (max(first.rewards.sum(), second.rewards.sum()) < worst_six + 1e-4)


def test_thresholds_follow_the_curve_of_true_returns(
    api: ApiServer, api_of_teacher: Api, sample: SampleExperiment
) -> None:
    with api.stores.database.transaction() as session:
        # A thousand steps with a return of a million: every segment of five is equal to every other.
        metrics.record(session, sample.experiment.id, 1, {"true_return": 1e6})
    teach(api_of_teacher, sample, "equal")
    assert {row.value for row, _, _ in labelled(api)} == {0.5}


def test_a_labeller_is_no_scripted_teacher(api: ApiServer, sample: SampleExperiment) -> None:
    client = Api(api.url, api.tokens[Role.LABELLER])
    for name in ("oracle", "phase"):
        with pytest.raises(Refused) as refused:
            teach(client, sample, name)
        assert refused.value.status == 403
    client.close()


def test_what_a_rule_cannot_see_is_named(api: ApiServer, api_of_teacher: Api, sample: SampleExperiment) -> None:
    with pytest.raises(PreferenceError, match="column 77"):
        teach(api_of_teacher, sample, "phase", "column=77")
    assert labelled(api) == []
