"""A report on trained reward models: numbers, pictures, and a page that shows them."""

import base64
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from html import escape
from pathlib import Path

from matplotlib.figure import Figure

from mapt.benchmarks.figures import (
    draw_agent_attention,
    draw_agents,
    draw_calibration,
    draw_histograms,
    draw_ranks,
    draw_step_attention,
    draw_time_series,
)
from mapt.benchmarks.recorded_dataset import Replay
from mapt.benchmarks.reward_analysis import Diagnosis, Sample, diagnose, draw_sample, rollout_series
from mapt.errors import UnknownTask
from mapt.rewards.data import check_fit
from mapt.rewards.model import RewardModel
from mapt.tasks import task_spec


@dataclass(frozen=True, slots=True)
class Picture:
    """A figure of the report, already written."""

    path: Path
    title: str
    #: how to read it
    text: str


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
        UnknownTeacher, InvalidTeacher, InvalidConfig: if the plan does not fit.
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


#: lines of the page's table: metric, what it is, format
_LINES: tuple[tuple[str, str, str], ...] = (
    ("accuracy", "pairs whose better segment is told as the teacher labels it", ".2%"),
    ("loss", "cross-entropy, nats", ".4f"),
    ("ece", "expected calibration error", ".3f"),
    ("rank_correlation", "rank correlation of scores and true returns of segments", ".3f"),
    ("rank_correlation_late", "the same over the newest fifth", ".3f"),
    ("rank_correlation_teacher", "rank correlation of scores with what the teacher judges by", ".3f"),
    ("step_correlation", "correlation of r-hat and true reward of steps", ".3f"),
    ("step_correlation_within", "the same within segments, their means taken away", ".3f"),
    ("breadth", "middle half of the rewards in their range (small: most are alike)", ".3f"),
    ("true_breadth", "the same of the true reward", ".3f"),
    ("spread_across_agents", "deviation among the agents of a step, in deviations of all rewards", ".3f"),
    ("past_share", "variance of r-hat that is not the Markov path's, in r-hat's", ".3f"),
    ("weight_concentration", "concentration of the weights of steps (0: all weigh the same)", ".3f"),
    ("parameters", "parameters", ",.0f"),
)
_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; color: #1b1f24; max-width: 1080px; margin: 2rem auto; padding: 0 1rem; }
h1 { font-size: 1.5rem; } h2 { font-size: 1.15rem; margin-top: 2.4rem; }
p { max-width: 46rem; } .quiet { color: #59636e; }
table { border-collapse: collapse; } th, td { padding: .3rem 0; border-bottom: 1px solid #d8dee4; }
th { text-align: left; }
td + td, th + th { text-align: right; padding-left: 1.6rem; font-variant-numeric: tabular-nums; }
img { max-width: 100%; height: auto; }
@media (prefers-color-scheme: dark) {
  body { background: #14171a; color: #e6e9ec; } .quiet { color: #9aa4ae; } th, td { border-color: #31373d; }
  img { background: #fff; border-radius: 4px; }
}
"""


def write_page(
    path: Path, title: str, facts: Sequence[str], diagnoses: Sequence[Diagnosis], pictures: Sequence[Picture]
) -> None:
    """Write the page; pictures are inside it."""
    parts = [
        f"<!doctype html><html lang=en><meta charset=utf-8><title>{escape(title)}</title>",
        "<meta name=viewport content='width=device-width, initial-scale=1'>",
        f"<style>{_STYLE}</style><h1>{escape(title)}</h1>",
        f"<p class=quiet>{'<br>'.join(escape(fact) for fact in facts)}</p>",
        _table(diagnoses),
    ]
    for picture in pictures:
        encoded = base64.b64encode(picture.path.read_bytes()).decode()
        parts.append(
            f"<h2>{escape(picture.title)}</h2><p>{escape(picture.text)}</p>"
            f"<img alt='{escape(picture.title, quote=True)}' src='data:image/png;base64,{encoded}'>"
        )
    path.write_text("\n".join(parts) + "\n")


def write_numbers(path: Path, about: Mapping[str, object], diagnoses: Sequence[Diagnosis]) -> None:
    """Write every number as JSON."""
    document = {
        **about,
        "models": [
            {
                "name": diagnosis.name,
                "network": dict(diagnosis.network),
                "metrics": dict(diagnosis.metrics),
                "calibration": [asdict(each) for each in diagnosis.calibration],
                "agent_attention": None if diagnosis.agent_attention is None else diagnosis.agent_attention.tolist(),
            }
            for diagnosis in diagnoses
        ],
    }
    path.write_text(json.dumps(document, indent=1, allow_nan=False) + "\n")


def _table(diagnoses: Sequence[Diagnosis]) -> str:
    head = "".join(f"<th>{escape(diagnosis.name)}" for diagnosis in diagnoses)
    rows = [
        f"<tr><td>{escape(what)}" + "".join(f"<td>{_number(each.metrics.get(name), form)}" for each in diagnoses)
        for name, what, form in _LINES
    ]
    return f"<table><tr><th>{head}{''.join(rows)}</table>"


def _number(value: float | None, form: str) -> str:
    return "" if value is None else format(value, form)
