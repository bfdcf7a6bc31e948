"""A scripted teacher at work: next queries, judgement, labels, over the REST API."""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

from accord.cli.client import Api
from mapt.preferences.teachers import Evidence, OracleTeacher, Teacher

#: the API gives at most so many queries at once
_MOST_QUERIES = 16
_IDLE_SECONDS = 0.25
#: reasons after which no query will ever come
_OVER = frozenset({"all_labelled", "experiment_over"})


class TeacherName(StrEnum):
    """Scripted teachers by name."""

    ORACLE = "oracle"


def make_teacher(name: TeacherName) -> Teacher:
    """The teacher with this name."""
    return {TeacherName.ORACLE: OracleTeacher}[name]()


@dataclass(frozen=True, slots=True)
class Taught:
    """How a lesson went."""

    #: labels this teacher gave, skips not counted
    labels: int
    #: why it ended: done, or the API's reason
    reason: str


def teach_experiment(
    api: Api,
    experiment_id: str,
    name: TeacherName,
    labels: int,
    *,
    on_progress: Callable[[int], None],
    stopped: Callable[[], bool],
) -> Taught:
    """Label queries of one experiment until enough are labelled or there will be no more.

    Args:
        labels: how many labels to give.
        on_progress: called with the labels given so far, also while waiting.
        stopped: asked between calls; true ends the lesson.

    Raises:
        Refused, Unavailable: if the API does.
    """
    teacher, given = make_teacher(name), 0
    while given < labels and not stopped():
        count = min(_MOST_QUERIES, labels - given)
        answer = api.post(f"/experiments/{experiment_id}/queries/next", count=count, returns=True)
        if answer["items"]:
            given += _label(api, experiment_id, teacher, name, answer["items"])
        on_progress(given)
        if not answer["items"]:
            if answer["reason"] in _OVER:
                return Taught(given, answer["reason"])
            time.sleep(_IDLE_SECONDS)
    return Taught(given, "done" if given >= labels else "stopped")


def _label(api: Api, experiment_id: str, teacher: Teacher, name: TeacherName, queries: list[dict[str, Any]]) -> int:
    """Judge and post these queries. Returns how many labels the service took."""
    batch = [
        {"query_id": query["id"], "label": judge(teacher, query), "order": "segments", "teacher": {"name": name.value}}
        for query in queries
    ]
    outcomes = api.post(f"/experiments/{experiment_id}/labels", {"labels": batch})["items"]
    # A query whose lease was lost meanwhile is refused, and comes again.
    return sum(1 for outcome in outcomes if outcome["ok"] and outcome["label"]["label"] is not None)


def judge(teacher: Teacher, query: dict[str, Any]) -> float | None:
    """The teacher's label in segment order, whatever sides they were drawn on; None to skip."""
    sides = sorted((query["left"], query["right"]), key=lambda side: side["index"])
    first, second = (Evidence.stack([{"rewards": side["true_rewards"]}]) for side in sides)
    label = float(teacher.judge(first, second)[0])
    return None if math.isnan(label) else label
