"""A report on trained reward models: numbers, pictures, and a page that shows them."""

from dataclasses import dataclass
from pathlib import Path

from matplotlib.figure import Figure

from mapt.rewards.model import RewardModel
from mapt.rewards.segment_reader import check_fit
from mapt.studies.attention_figures import draw_agent_attention, draw_step_attention
from mapt.studies.diagnosis import Diagnosis, Sample, diagnose, draw_sample
from mapt.studies.replay import Replay
from mapt.studies.report_page import Picture, write_numbers, write_page
from mapt.studies.reward_figures import (
    draw_agents,
    draw_calibration,
    draw_histograms,
    draw_ranks,
    draw_time_series,
)
from mapt.studies.rollout_series import rollout_series
from mapt.tasks import UnknownTask, task_spec


@dataclass(frozen=True, slots=True)
class ReportPlan:
    """What a report is on."""

    #: see `Judge`
    teacher: str
    #: that the teacher labels
    n_pairs: int
    #: see `draw_sample`
    fresh_of_seed: int | None


def make_report(models: dict[str, RewardModel], replay: Replay, plan: ReportPlan, folder: Path) -> list[Path]:
    """Diagnose models, on the CPU, and write report.html, report.json and the pictures into `folder`.

    Raises:
        ModelMismatch: if a model is for segments of other dimensions.
        UnknownTeacher, InvalidTeacher, InvalidStudy: if the plan does not fit.
    """
    for model in models.values():
        check_fit(model.config, replay.source)
    folder.mkdir(parents=True, exist_ok=True)
    sample = draw_sample(replay, plan.teacher, plan.n_pairs, plan.fresh_of_seed)
    diagnoses = [diagnose(name, model, sample) for name, model in models.items()]
    pictures = _draw(models, diagnoses, sample, replay, folder)
    about = {
        "task": str(replay.origin.get("task", "")),
        "replay": replay.fingerprint(),
        "teacher": plan.teacher,
        "pairs": plan.n_pairs,
        "segments": len(sample.indices),
        "fresh_of_seed": plan.fresh_of_seed,
    }
    which = (
        "of the replay"
        if plan.fresh_of_seed is None
        else f"that no table's cell of seed {plan.fresh_of_seed} learns from"
    )
    facts = [
        f"{len(sample.indices):,} segments of {replay.source.n_steps} steps {which}.",
        f"{plan.n_pairs:,} pairs of them labelled by the teacher {plan.teacher}.",
        f"Replay {about['replay'][:12]}.",
    ]
    page, numbers = folder / "report.html", folder / "report.json"
    write_page(page, f"Reward models on {about['task'] or 'a replay'}", facts, diagnoses, pictures)
    write_numbers(numbers, about, diagnoses)
    return [page, numbers, *(picture.path for picture in pictures)]


def _draw(
    models: dict[str, RewardModel], diagnoses: list[Diagnosis], sample: Sample, replay: Replay, folder: Path
) -> list[Picture]:
    agents = agent_names(replay)
    series = rollout_series(replay, models)
    drawn: list[tuple[str, Figure | None, str, str]] = [
        (
            "histograms",
            draw_histograms(diagnoses, sample, agents),
            "Rewards of state-action pairs",
            "One line for each agent. A reward that tells few actions apart piles up in the middle.",
        ),
        (
            "time-series",
            draw_time_series(series.learned, series.true, series.what, series.breaks),
            "Learned and true reward along a rollout",
            "Both have mean 0 and deviation 1 here: the scale of a learned reward is free.",
        ),
        (
            "ranks",
            draw_ranks(diagnoses, sample),
            "Segments and steps",
            "Above, a dot is a segment, and its colour when it was played; below, steps, the darker the more.",
        ),
        (
            "calibration",
            draw_calibration(diagnoses),
            "Calibration",
            "Of the predictions of 80%, eight in ten should be labelled so. Every pair counts in both orders.",
        ),
        (
            "agents",
            draw_agents(diagnoses, sample, agents),
            "Agents",
            "Above, median, middle half and middle nine tenths of each agent's rewards; below, how agents' rewards go "
            "together from step to step.",
        ),
        (
            "step-attention",
            draw_step_attention(diagnoses, sample),
            "Which steps count",
            "Weights of steps times T (1 where all weigh the same), with the true reward in grey, over the attention "
            "that they are the mean of. Segments of poor, middling and good return.",
        ),
        (
            "agent-attention",
            draw_agent_attention(diagnoses, agents),
            "Who looks at whom",
            "Mean over steps. A model whose variance is all the Markov path's (see the table) makes no use of it.",
        ),
    ]
    pictures = []
    for name, figure, title, text in drawn:
        if figure is not None:
            figure.savefig(folder / f"{name}.png", dpi=120)
            pictures.append(Picture(folder / f"{name}.png", title, text))
    return pictures


def agent_names(replay: Replay) -> list[str]:
    """Of the replay's task; numbers where it is none of ours."""
    n_agents = replay.source.n_agents
    try:
        names = task_spec(str(replay.origin.get("task"))).agent_names
    except UnknownTask:
        names = ()
    return list(names) if len(names) == n_agents else [f"agent {n}" for n in range(n_agents)]
