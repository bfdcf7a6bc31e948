"""The output of `mapt report`: metrics and figures of trained reward models as HTML and JSON."""

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
from mapt.benchmarks.recorded_dataset import RecordedDataset
from mapt.benchmarks.reward_analysis import RewardAnalysis, Sample, analyse, draw_sample, rollout_series
from mapt.errors import UnknownTask
from mapt.io import atomic_write
from mapt.plotting import save_figure
from mapt.rewards.data import check_fit
from mapt.rewards.model import RewardModel
from mapt.tasks import task_spec

#: Rows of the page's table: metric, description, format.
_ROWS: tuple[tuple[str, str, str], ...] = (
    ("accuracy", "accuracy against the teacher's labels", ".2%"),
    ("loss", "cross-entropy (nats)", ".4f"),
    ("ece", "expected calibration error", ".3f"),
    ("rank_correlation", "rank correlation of scores with true returns of segments", ".3f"),
    ("rank_correlation_late", "the same over the newest fifth of the segments", ".3f"),
    ("rank_correlation_teacher", "rank correlation of scores with the teacher's scores", ".3f"),
    ("step_correlation", "correlation of learned and true step rewards", ".3f"),
    ("step_correlation_within", "the same after subtracting each segment's mean", ".3f"),
    ("window_correlation_within", "the same for the sums over windows of ten steps", ".3f"),
    ("breadth", "interquartile range / 99% range of the rewards (small: most are nearly equal)", ".3f"),
    ("true_breadth", "the same for the true reward", ".3f"),
    ("spread_across_agents", "standard deviation between agents / that of all rewards", ".3f"),
    ("past_share", "fraction of the rewards' variance that depends on the past", ".3f"),
    ("weight_concentration", "concentration of the step weights (0: uniform)", ".3f"),
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


@dataclass(frozen=True, slots=True)
class ReportFigure:
    """A figure that was written to a file."""

    path: Path
    title: str
    #: how to read the figure
    caption: str


@dataclass(frozen=True, slots=True)
class ReportPlan:
    """Settings of a report."""

    #: see `DatasetTeacher`
    teacher: str
    #: pairs that the teacher labels
    n_pairs: int
    #: see `draw_sample`
    held_out_seed: int | None


def make_report(models: dict[str, RewardModel], dataset: RecordedDataset, plan: ReportPlan, folder: Path) -> list[Path]:
    """Evaluate models on the CPU and write report.html, report.json and the figures to `folder`; return the paths.

    Raises:
        ModelMismatch: if a model is for segments of other dimensions.
        UnknownTeacher, InvalidTeacher, InvalidConfig: if the plan is invalid for this dataset.
    """
    for model in models.values():
        check_fit(model.config, dataset.source)
    folder.mkdir(parents=True, exist_ok=True)
    sample = draw_sample(dataset, plan.teacher, plan.n_pairs, plan.held_out_seed)
    analyses = [analyse(name, model, sample) for name, model in models.items()]
    figures = _draw(models, analyses, sample, dataset, folder)
    about = {
        "task": str(dataset.origin.get("task", "")),
        "dataset": dataset.fingerprint(),
        "teacher": plan.teacher,
        "pairs": plan.n_pairs,
        "segments": len(sample.indices),
        "held_out_seed": plan.held_out_seed,
    }
    source = (
        "of the dataset" if plan.held_out_seed is None else f"held out by `mapt table` for seed {plan.held_out_seed}"
    )
    facts = [
        f"{len(sample.indices):,} segments of {dataset.source.n_steps} steps, {source}.",
        f"{plan.n_pairs:,} pairs of these segments, labelled by the teacher {plan.teacher}.",
        f"Dataset {about['dataset'][:12]}.",
    ]
    page, numbers = folder / "report.html", folder / "report.json"
    write_page(page, f"Reward models on {about['task'] or 'a recorded dataset'}", facts, analyses, figures)
    write_numbers(numbers, about, analyses)
    return [page, numbers, *(figure.path for figure in figures)]


def _draw(
    models: dict[str, RewardModel],
    analyses: list[RewardAnalysis],
    sample: Sample,
    dataset: RecordedDataset,
    folder: Path,
) -> list[ReportFigure]:
    agents = agent_names(dataset)
    series = rollout_series(dataset, models)
    drawn: list[tuple[str, Figure | None, str, str]] = [
        (
            "histograms",
            draw_histograms(analyses, sample, agents),
            "Rewards of state-action pairs",
            "One line per agent. A reward that hardly distinguishes actions has a narrow peak.",
        ),
        (
            "time-series",
            draw_time_series(series.learned, series.true, series.title, series.breaks),
            "Learned and true reward along a rollout",
            "Both are standardised, since a learned reward has no fixed scale.",
        ),
        (
            "ranks",
            draw_ranks(analyses, sample),
            "Segments and steps",
            "Top: each dot is a segment, coloured by when it was recorded. Bottom: density of steps.",
        ),
        (
            "calibration",
            draw_calibration(analyses),
            "Calibration",
            "80% of the pairs predicted with probability 80% should be labelled that way. Each pair counts twice.",
        ),
        (
            "agents",
            draw_agents(analyses, sample, agents),
            "Agents",
            "Top: median, middle 50% and middle 90% of each agent's rewards. Bottom: correlation of rewards between "
            "agents over steps.",
        ),
        (
            "step-attention",
            draw_step_attention(analyses, sample),
            "Temporal attention",
            "Top: step weights times T (1 is uniform), with the true reward in grey. Bottom: the attention matrix; the "
            "step weights are its mean over query steps. Segments of low, medium and high return.",
        ),
        (
            "agent-attention",
            draw_agent_attention(analyses, agents),
            "Attention between agents",
            "Mean over steps. A model whose rewards depend only on the current step (see the table) does not use it.",
        ),
    ]
    figures = []
    for name, figure, title, caption in drawn:
        if figure is not None:
            path = folder / f"{name}.png"
            save_figure(figure, path)
            figures.append(ReportFigure(path, title, caption))
    return figures


def agent_names(dataset: RecordedDataset) -> list[str]:
    """Names of the task's agents; numbered names if the task is unknown."""
    n_agents = dataset.source.n_agents
    try:
        names = task_spec(str(dataset.origin.get("task"))).agent_names
    except UnknownTask:
        names = ()
    return list(names) if len(names) == n_agents else [f"agent {n}" for n in range(n_agents)]


def write_page(
    path: Path, title: str, facts: Sequence[str], analyses: Sequence[RewardAnalysis], figures: Sequence[ReportFigure]
) -> None:
    """Write the HTML page with the figures embedded."""
    parts = [
        f"<!doctype html><html lang=en><meta charset=utf-8><title>{escape(title)}</title>",
        "<meta name=viewport content='width=device-width, initial-scale=1'>",
        f"<style>{_STYLE}</style><h1>{escape(title)}</h1>",
        f"<p class=quiet>{'<br>'.join(escape(fact) for fact in facts)}</p>",
        _table(analyses),
    ]
    for figure in figures:
        encoded = base64.b64encode(figure.path.read_bytes()).decode()
        parts.append(
            f"<h2>{escape(figure.title)}</h2><p>{escape(figure.caption)}</p>"
            f"<img alt='{escape(figure.title, quote=True)}' src='data:image/png;base64,{encoded}'>"
        )
    atomic_write(path, ("\n".join(parts) + "\n").encode())


def write_numbers(path: Path, about: Mapping[str, object], analyses: Sequence[RewardAnalysis]) -> None:
    """Write every number as JSON."""
    document = {
        **about,
        "models": [
            {
                "name": analysis.name,
                "network": dict(analysis.network),
                "metrics": dict(analysis.metrics),
                "calibration": [asdict(each) for each in analysis.calibration],
                "agent_attention": None if analysis.agent_attention is None else analysis.agent_attention.tolist(),
            }
            for analysis in analyses
        ],
    }
    atomic_write(path, (json.dumps(document, indent=1, allow_nan=False) + "\n").encode())


def _table(analyses: Sequence[RewardAnalysis]) -> str:
    head = "".join(f"<th>{escape(analysis.name)}" for analysis in analyses)
    rows = [
        f"<tr><td>{escape(what)}" + "".join(f"<td>{_number(each.metrics.get(name), form)}" for each in analyses)
        for name, what, form in _ROWS
    ]
    return f"<table><tr><th>{head}{''.join(rows)}</table>"


def _number(value: float | None, form: str) -> str:
    return "" if value is None else format(value, form)
