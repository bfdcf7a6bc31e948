"""`PreferenceLoop` and the service give the same segments, pairs, labels and curves for the same order of steps.

The test runs the workers of the service in the order of the loop. In a running service the order varies: the query
planner may run before or after the policy's next rollout, and then samples other pairs.
"""

from typing import Any

import numpy as np
import pytest
from safetensors.numpy import load

from accord.services import experiments, label
from accord.workers.model_store import read_reward_model
from accord.workers.reward_worker import RewardWorker, reward_settings
from integration.workers.worker_harness import TINY, WorkerHarness
from mapt.policies import Learner
from mapt.preferences.teachers import OracleTeacher
from mapt.rewards import novelty
from mapt.tasks import make_task
from mapt.training.preference_loop import PreferenceLoop, Segment
from support.policy_training import teacher_view

pytestmark = pytest.mark.slow

CURVES = ("learned_return", "policy_loss", "value_loss", "true_reward_correlation", "labels", "reward_version")


def label_open_queries(harness: WorkerHarness, teacher: OracleTeacher, segments: dict[str, Segment]) -> None:
    """Label every open query, as a teacher does over the REST API."""
    queries = harness.rows("SELECT id, segment_0_id, segment_1_id FROM queries WHERE status = 'open' ORDER BY number")
    if not queries:
        return
    sides = [teacher_view([segments[query[side]] for query in queries]) for side in (1, 2)]
    with harness.database.transaction() as session:
        for (query_id, *_), value in zip(queries, teacher.judge(*sides).tolist(), strict=True):
            label.put_label(session, harness.teacher, query_id, value)


def stored_segments(harness: WorkerHarness) -> dict[str, Segment]:
    """The stored segments by id, in order of creation."""
    rows = harness.rows("SELECT id, blob_key FROM segments ORDER BY policy_steps, id")
    return {id: Segment(**load(harness.context.blobs.read(key))) for id, key in rows}


def run_service(harness: WorkerHarness, id: str) -> None:
    """Run the workers in the order of `PreferenceLoop.run`: queries, labels, reward model, rollout, policy."""
    worker, teacher = RewardWorker(harness.context), OracleTeacher()
    with harness.training(id) as run:
        run.step()  # the first rollout
        while not run.ended:
            while worker.planner.work():
                label_open_queries(harness, teacher, stored_segments(harness))
            while worker.work():
                pass
            run.step()


def run_loop(harness: WorkerHarness, id: str) -> PreferenceLoop:
    with harness.database.reading() as session:
        config = experiments.config_of(experiments.get(session, id))
    policy = config.policy_config(harness.context.settings.torch_threads)
    task = make_task(config.task, policy.n_envs, n_threads=policy.n_threads)
    loop = PreferenceLoop(
        Learner(task, policy),
        OracleTeacher(),
        config.schedule,
        reward_settings(config),
        selector=config.query_selection,
        control_share=config.control_share,
    )
    loop.run()
    task.close()
    return loop


@pytest.mark.parametrize(
    "settings",
    [
        {},
        {"query_selection": "uniform", "novelty_weight": 1.0},
        {"query_selection": "disagreement_k_center", "ensemble_members": 2, "credit": "individual"},
    ],
    ids=["recent", "uniform", "disagreement_k_center"],
)
def test_the_loop_and_the_service_give_the_same_results(
    harness: WorkerHarness, settings: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(novelty, "UPDATES", 5)
    policy = {**TINY["policy"], "hidden": [16]}
    id = harness.create_experiment(**settings, label_budget=20, lookahead_queries=2, seed=3, policy=policy)
    run_service(harness, id)
    loop = run_loop(harness, id)

    stored = stored_segments(harness)
    assert len(stored) == len(loop.segments)
    for from_loop, from_service in zip(loop.segments, stored.values(), strict=True):
        for name in ("observations", "actions", "rewards", "qpos", "qvel"):
            np.testing.assert_array_equal(getattr(from_loop, name), getattr(from_service, name))

    number = {id: index for index, id in enumerate(stored)}
    labelled = harness.rows(
        "SELECT q.segment_0_id, q.segment_1_id, l.value FROM queries q JOIN labels l ON l.query_id = q.id"
        " ORDER BY q.number"
    )
    assert [(number[first], number[second], value) for first, second, value in labelled] == [
        (query.segment_0, query.segment_1, query.label) for query in loop.queries
    ]

    versions = harness.rows("SELECT label_count, blob_key FROM reward_versions ORDER BY number")
    assert [count for count, _ in versions] == [version.labels for version in loop.versions]
    assert len(versions) > 2
    for (_, key), version in zip(versions, loop.versions, strict=True):
        weights = read_reward_model(harness.context.blobs, key).state_dict()
        assert all(np.array_equal(weights[name], tensor) for name, tensor in version.model.state_dict().items())

    for name in CURVES:
        assert harness.curve(id, name) == {int(each["steps"]): each[name] for each in loop.history}
