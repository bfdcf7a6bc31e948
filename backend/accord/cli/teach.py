"""accord teach: a scripted teacher for an experiment of a service that runs."""

import json
import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from safetensors.numpy import load

from accord.cli.client import Api
from accord.cli.options import Home, Parameters, TeacherName, Token, Url, load_settings, parse_settings, service_url
from accord.cli.output import out, say
from accord.domain.errors import Invalid
from accord.workers.runner import Stop
from mapt.errors import PreferenceError
from mapt.preferences.teachers import ScriptedTeacher, TeacherView, make_teacher


def teach(
    *,
    experiment: Annotated[str, typer.Option(help="Id of the experiment to label, exp_...")],
    token: Token,
    url: Url = None,
    teacher: TeacherName = "oracle",
    parameter: Parameters = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the teacher's chance.")] = 0,
    labels: Annotated[
        int | None,
        typer.Option(min=1, help="How many labels to give.  [default: what the experiment's budget still lacks]"),
    ] = None,
    home: Home = None,
) -> None:
    """Label an experiment by a program that knows the true reward. It uses the same API as everyone."""
    choice = parse_teacher(teacher, parameter or ())
    stop = Stop()
    stop.install()
    api = Api(url or service_url(load_settings(home)), token, stopped=lambda: stop.requested)
    counts = api.get(f"/experiments/{experiment}")["labels"]
    wanted = labels or max(0, counts["budget"] - counts["labels"])
    columns = (TextColumn("labels"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, console=out) as progress:
        bar = progress.add_task("labels", total=wanted)
        taught = teach_experiment(
            api,
            experiment,
            choice.teacher(seed),
            wanted,
            on_progress=lambda given: progress.update(bar, completed=given),
            stopped=lambda: stop.requested,
        )
    api.close()
    say(f"{taught.labels} labels given ({taught.reason}).")


#: the API gives at most so many queries at once
_MOST_QUERIES = 16
#: segments whose arrays are kept: a segment may be in several queries, most often in two soon after another
_KEPT_SEGMENTS = 256
#: points of the curve of true returns that make a running mean, as B-Pref's ten episodes
_RETURN_POINTS = 10
_IDLE_SECONDS = 0.25
#: reasons after which no query will ever come
_OVER = frozenset({"all_labelled", "experiment_over"})


@dataclass(frozen=True, slots=True)
class TeacherChoice:
    """Which scripted teacher, and with what parameters.

    Raises:
        Invalid: if there is no such teacher, or it has no such parameters.
    """

    name: str = "oracle"
    parameters: Mapping[str, Any] = field(default_factory=dict[str, Any])

    def __post_init__(self) -> None:
        self.teacher(0)

    @property
    def title(self) -> str:
        """Its name and parameters, for people."""
        told = ", ".join(f"{name}={json.dumps(value)}" for name, value in sorted(self.parameters.items()))
        return f"{self.name} ({told})" if told else self.name

    def teacher(self, seed: int) -> ScriptedTeacher:
        """A new one, whose chance is the seed's."""
        try:
            return make_teacher(self.name, **{"seed": seed, **self.parameters})
        except PreferenceError as error:
            raise Invalid(f"--teacher {self.name}: {error}.") from error


def parse_teacher(name: str, parameters: Sequence[str]) -> TeacherChoice:
    """A teacher from the command line, its parameters as KEY=VALUE.

    Raises:
        Invalid: as TeacherChoice, or if a parameter is no KEY=VALUE.
    """
    return TeacherChoice(name, parse_settings("--parameter", parameters, "mistake=0.1"))


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
    teacher: ScriptedTeacher,
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
        Invalid: if the experiment's segments lack what the teacher judges by.
    """
    sight, given = Sight(api, teacher), 0
    horizon_steps = api.get(f"/experiments/{experiment_id}")["task"]["horizon_steps"]
    while given < labels and not stopped():
        count = min(_MOST_QUERIES, labels - given)
        path = f"/experiments/{experiment_id}/queries/next"
        answer = api.post(path, count=count, returns=not sight.needs_arrays)
        if answer["items"]:
            if teacher.uses_episode_return:
                _tell_of_episodes(api, experiment_id, teacher, horizon_steps)
            given += _label(api, experiment_id, teacher, sight, answer["items"])
        on_progress(given)
        if not answer["items"]:
            if answer["reason"] in _OVER:
                return Taught(given, answer["reason"])
            time.sleep(_IDLE_SECONDS)
    return Taught(given, "done" if given >= labels else "stopped")


class Sight:
    """What a teacher sees of queries: their true rewards, or all arrays of their segments."""

    def __init__(self, api: Api, teacher: ScriptedTeacher) -> None:
        #: rewards come with the queries; whatever else a rule reads does not
        self.needs_arrays = teacher.rule.reads != ("rewards",)
        self._arrays = lru_cache(_KEPT_SEGMENTS)(lambda id: load(api.get_bytes(f"/segments/{id}/arrays")))

    def of(self, queries: Sequence[dict[str, Any]]) -> tuple[TeacherView, TeacherView]:
        """Segments 0 and segments 1 of these queries, whatever sides they were drawn on."""
        sides = [sorted((query["left"], query["right"]), key=lambda side: side["index"]) for query in queries]
        first, second = (TeacherView.stack([self._one(pair[index]) for pair in sides]) for index in (0, 1))
        return first, second

    def _one(self, side: dict[str, Any]) -> Mapping[str, NDArray[np.floating]]:
        if self.needs_arrays:
            return self._arrays(side["segment_id"])
        return {"rewards": np.array(side["true_rewards"], dtype=np.float64)}


def judge(teacher: ScriptedTeacher, sight: Sight, queries: Sequence[dict[str, Any]]) -> list[float | None]:
    """The teacher's labels in segment order; None to skip.

    Raises:
        Invalid: if the segments lack what the teacher judges by.
    """
    try:
        labels = teacher.judge(*sight.of(queries)).tolist()
    except PreferenceError as error:
        raise Invalid(f"This teacher cannot judge these segments: {error}.") from error
    return [None if math.isnan(label) else label for label in labels]


def _label(
    api: Api, experiment_id: str, teacher: ScriptedTeacher, sight: Sight, queries: Sequence[dict[str, Any]]
) -> int:
    """Judge and post these queries. Returns how many labels the service took."""
    described = teacher.parameters()
    batch = [
        {"query_id": query["id"], "label": label, "order": "segments", "teacher": described}
        for query, label in zip(queries, judge(teacher, sight, queries), strict=True)
    ]
    outcomes = api.post(f"/experiments/{experiment_id}/labels", {"labels": batch})["items"]
    # A query whose lease was lost meanwhile is refused, and comes again.
    return sum(1 for outcome in outcomes if outcome["ok"] and outcome["label"]["label"] is not None)


def _tell_of_episodes(api: Api, experiment_id: str, teacher: ScriptedTeacher, horizon_steps: int) -> None:
    """The running mean of true episode returns, as far as there is one yet."""
    series = api.get(f"/experiments/{experiment_id}/metrics", names=["true_return"])["series"]
    points = [point["value"] for curve in series for point in curve["points"]][-_RETURN_POINTS:]
    if points:
        teacher.set_episode_return(float(np.mean(points)), horizon_steps)
