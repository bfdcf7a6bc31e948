"""What a demo runs: one plan for each seed, number of labels and reward model, and for the true reward beside them."""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from datetime import datetime
from typing import Any

from accord.cli.client import Api
from accord.cli.teach import TeacherChoice, teach_experiment
from accord.domain.errors import AccordError, Invalid, Unavailable

TRUE = "true"
PREFERENCES = "preferences"
#: More labels on the untrained team's few segments teach the reward those by heart: of 3,000, 600 before the first
#: version led to a return of 2,976, 100 to 4,167 (HalfCheetah-6x1, seed 2).
MOST_INITIAL_LABELS = 100


@dataclass(frozen=True, slots=True)
class RunPlan:
    """What to run: an experiment's settings, as the API takes them."""

    name: str
    task: str
    #: preferences or true
    reward_source: str
    seed: int
    total_steps: int
    label_budget: int
    initial_labels: int
    labels_per_version: int
    render_clips: bool
    reward_model: str = "MAPT"
    #: settings of the policy's learner
    policy: dict[str, Any] = field(default_factory=dict[str, Any])

    def differences(self, config: Mapping[str, Any]) -> list[str]:
        """In what an experiment's settings are not these, as sentences' ends."""
        own = {name: value for name, value in asdict(self).items() if name != "name"}
        return [f"{name} is {config[name]!r}, not {value!r}" for name, value in own.items() if config[name] != value]


@dataclass(frozen=True, slots=True)
class Grid:
    """Every combination of the lists, on one task."""

    task: str
    total_steps: int
    seeds: Sequence[int]
    labels: Sequence[int]
    reward_models: Sequence[str]
    #: labels before the first version; None for a fifth of them, at most `MOST_INITIAL_LABELS`
    initial_labels: int | None = None
    #: labels for each further version; None for a tenth of them
    labels_per_version: int | None = None
    render_clips: bool = False
    #: train on the true reward too, once for each seed
    baseline: bool = True
    policy: Mapping[str, Any] = field(default_factory=dict[str, Any])

    def plans(self, teacher: str) -> list[RunPlan]:
        """Seed after seed, so that what is there when a long demo is ended can be compared.

        Args:
            teacher: how the teacher is called in the names of the runs.
        """
        return [plan for seed in self.seeds for plan in self._of_seed(seed, teacher)]

    def _of_seed(self, seed: int, teacher: str) -> list[RunPlan]:
        learned = [
            self._plan(
                f"{self.task} seed {seed}, {model}, {labels} labels of {teacher}",
                seed,
                PREFERENCES,
                label_budget=labels,
                initial_labels=self.initial_labels or max(2, min(labels // 5, MOST_INITIAL_LABELS)),
                labels_per_version=self.labels_per_version or max(1, labels // 10),
                render_clips=self.render_clips,
                reward_model=model,
            )
            for labels in self.labels
            for model in self.reward_models
        ]
        # Nothing about labels, so that the same run serves demos that differ in them.
        nothing = {"label_budget": 0, "initial_labels": 0, "labels_per_version": 1, "render_clips": False}
        true = [self._plan(f"{self.task} seed {seed}, true reward", seed, TRUE, **nothing)] if self.baseline else []
        return [*true, *learned]

    def _plan(self, name: str, seed: int, source: str, **settings: Any) -> RunPlan:
        return RunPlan(
            name=name,
            task=self.task,
            reward_source=source,
            seed=seed,
            total_steps=self.total_steps,
            policy=dict(self.policy),
            **settings,
        )


_POLL_SECONDS = 0.5
_SHOWN_SECONDS = 1.0
_CURVES = ("true_return", "true_return_untrained", "true_return_final", "true_return_final_std", "learned_return")


class RunFailed(AccordError):
    """An experiment of the demo did not come to its end."""

    code = "run_failed"


@dataclass(frozen=True, slots=True)
class RunState:
    """How far it is, for the progress bar."""

    steps: int
    labels: int
    version: int
    true_return: float | None
    detail: str


@dataclass(frozen=True, slots=True)
class RunResult:
    """What came of it."""

    plan: RunPlan
    experiment_id: str
    #: from its creation to its end, breaks of the demo included
    seconds: float
    steps: int
    labels: int
    #: true returns of whole episodes with mean actions
    untrained: float
    final: float
    final_std: float
    #: curve name -> [[step, value], ...]
    curves: dict[str, list[list[float]]]
    #: per reward version: number, policy_steps, label_count and its metrics
    versions: list[dict[str, Any]]
    #: the teacher's name and parameters; empty where there was none
    teacher: dict[str, Any] = field(default_factory=dict[str, Any])

    def to_dict(self) -> dict[str, Any]:
        """Plain values, fit for JSON."""
        return asdict(self)


@dataclass(frozen=True, slots=True)
class Lesson:
    """Who asks and who labels."""

    #: with a researcher's token
    researcher: Api
    #: with a teacher's
    teacher: Api
    choice: TeacherChoice
    #: true ends the run
    stopped: Callable[[], bool]
    #: raises when the service is gone
    check: Callable[[], None]

    def close(self) -> None:
        self.researcher.close()
        self.teacher.close()


def experiments_by_name(api: Api) -> dict[str, dict[str, Any]]:
    """Every experiment of the service."""
    found: dict[str, dict[str, Any]] = {}
    page: dict[str, Any] = {"next_cursor": ""}
    while (cursor := page["next_cursor"]) is not None:
        page = api.get("/experiments", limit=100, **({"cursor": cursor} if cursor else {}))
        found |= {experiment["name"]: experiment for experiment in page["items"]}
    return found


def check_known(plans: Sequence[RunPlan], known: Mapping[str, dict[str, Any]]) -> None:
    """Whether the service's experiments of these names are these plans'.

    Raises:
        Invalid: if one has other settings.
    """
    for plan in plans:
        experiment = known.get(plan.name)
        if experiment and (differences := plan.differences(experiment["config"])):
            raise Invalid(
                f"There is a run {plan.name!r} already, of which {'; '.join(differences)}. "
                "Choose another folder with --output, or the same settings to go on."
            )


def pause_others(api: Api, plans: Sequence[RunPlan], known: Mapping[str, dict[str, Any]]) -> None:
    """Pause running experiments that are no plan's: without a teacher, they would keep a worker waiting."""
    names = {plan.name for plan in plans}
    for name, experiment in known.items():
        if experiment["status"] == "running" and name not in names:
            api.post(f"/experiments/{experiment['id']}/pause")


def run_experiment(
    lesson: Lesson, plan: RunPlan, known: Mapping[str, dict[str, Any]], show: Callable[[RunState], None]
) -> RunResult:
    """Create the experiment, or go on with the known one of its name; teach it, and wait for its end.

    Raises:
        RunFailed: if it failed, or was stopped.
        Refused, Unavailable: if the service says so, or is gone.
    """
    experiment_id = _begin(lesson.researcher, plan, known.get(plan.name))
    shown_at = 0.0

    def refresh(_: int = 0) -> None:
        nonlocal shown_at
        lesson.check()
        if time.monotonic() - shown_at >= _SHOWN_SECONDS:
            shown_at = time.monotonic()
            show(_state(lesson.researcher, experiment_id))

    teacher = lesson.choice.teacher(plan.seed) if plan.reward_source == PREFERENCES else None
    if teacher is not None:
        given = lesson.researcher.get(f"/experiments/{experiment_id}")["labels"]["labels"]
        teach_experiment(
            lesson.teacher,
            experiment_id,
            teacher,
            plan.label_budget - given,
            on_progress=refresh,
            stopped=lesson.stopped,
        )
    while (experiment := lesson.researcher.get(f"/experiments/{experiment_id}"))["status"] == "running":
        if lesson.stopped():
            raise Unavailable("Stopped before the experiment was over. The same command goes on with it.")
        refresh()
        time.sleep(_POLL_SECONDS)
    if experiment["status"] != "finished":
        raise RunFailed(f"{plan.name} is {experiment['status']}: {experiment['phase_detail']}")
    show(_state(lesson.researcher, experiment_id))
    found = _result(lesson.researcher, plan, experiment)
    return found if teacher is None else replace(found, teacher=teacher.parameters())


def _begin(api: Api, plan: RunPlan, known: dict[str, Any] | None) -> str:
    if known is None:
        return api.post("/experiments", asdict(plan))["id"]
    if known["status"] in {"paused", "failed"}:
        api.post(f"/experiments/{known['id']}/resume")
    return known["id"]


def _state(api: Api, experiment_id: str) -> RunState:
    experiment = api.get(f"/experiments/{experiment_id}")
    curve = _curves(api, experiment_id, ("true_return",)).get("true_return", [])
    return RunState(
        steps=experiment["steps"],
        labels=experiment["labels"]["labels"],
        version=experiment["reward_version"] or 0,
        true_return=curve[-1][1] if curve else None,
        detail=experiment["phase_detail"] or experiment["phase"],
    )


def _result(api: Api, plan: RunPlan, experiment: dict[str, Any]) -> RunResult:
    id = experiment["id"]
    curves = _curves(api, id, _CURVES)
    keys = ("number", "policy_steps", "label_count", "metrics")
    versions = [{key: item[key] for key in keys} for item in api.get(f"/experiments/{id}/reward-versions")["items"]]
    return RunResult(
        plan=plan,
        experiment_id=id,
        seconds=(_time(experiment["ended_at"]) - _time(experiment["created_at"])).total_seconds(),
        steps=experiment["steps"],
        labels=experiment["labels"]["labels"],
        untrained=curves["true_return_untrained"][-1][1],
        final=curves["true_return_final"][-1][1],
        final_std=curves["true_return_final_std"][-1][1],
        curves={name: points for name, points in curves.items() if len(points) > 1 or name == "true_return"},
        versions=versions,
    )


def _time(text: str) -> datetime:
    return datetime.fromisoformat(text)


def _curves(api: Api, experiment_id: str, names: tuple[str, ...]) -> dict[str, list[list[float]]]:
    found = api.get(f"/experiments/{experiment_id}/metrics", names=list(names))["series"]
    return {curve["name"]: [[point["step"], point["value"]] for point in curve["points"]] for curve in found}
