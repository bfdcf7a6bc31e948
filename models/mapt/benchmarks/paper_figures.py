"""Figures of the paper's experiments: scores, learning curves, and the paper's figures 2, 4 and 5."""

import tempfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from textwrap import wrap

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import PercentFormatter

from mapt.benchmarks.figures import draw_histograms, draw_time_series
from mapt.benchmarks.job import CellJob, path_name
from mapt.benchmarks.paper import TEACHER, UNTRAINED, PolicyResult
from mapt.benchmarks.paper_tables import PaperResults, Row
from mapt.benchmarks.recorded_dataset import RecordedDataset, record_episodes
from mapt.benchmarks.report import agent_names
from mapt.benchmarks.reward_analysis import Sample, analyse, draw_sample, episode_series
from mapt.plotting import GREY, draw_by_count, format_counts, outside_legend, panel_grid, save_figure
from mapt.rewards.checkpoints import CARD_FILE, WEIGHTS_FILE, load_reward_model
from mapt.rewards.model import RewardModel
from mapt.training.curves import draw_curves
from mapt.training.results import Group
from mapt.training.run_folder import load_policy
from mapt.training.settings import ImitationSettings

#: The model whose policies play the rollouts of figure 5; the first model of the plan if it has no such model.
_SHOWN_MODEL = "MAPT"
#: most characters in a line of a panel's title
_TITLE_WIDTH = 45


def draw_figures(results: PaperResults, models: Sequence[CellJob], folder: Path) -> list[tuple[str, Path]]:
    """Draw every figure for which there are results, as PNG files in `folder`; returns titles and paths.

    Args:
        models: the reward models that are trained, with their folders and datasets.
    """
    folder.mkdir(parents=True, exist_ok=True)
    return [*_scores(results, folder), *_learning_curves(results, folder), *_rewards(results, models, folder)]


def _scores(results: PaperResults, folder: Path) -> Iterator[tuple[str, Path]]:
    rows = [row for row in results.rows if row.pairs is not None and row.score is not None]
    shown = list(dict.fromkeys((row.task, row.policy) for row in rows))
    learned = (*results.plan.with_labels, *results.plan.models)
    if not shown:
        return
    figure, panels = panel_grid(len(shown), width=4.5, height=3.6)
    for axes, (task, policy) in zip(panels, shown, strict=True):
        # Settings of a policy can be longer than a panel is wide.
        lines = wrap(", ".join([f"{task}", *policy.split(",")]), _TITLE_WIDTH)
        axes.set_title("\n".join(lines), fontsize="medium")
        draw_scores(axes, [row for row in rows if (row.task, row.policy) == (task, policy)], learned)
    outside_legend(figure, panels[0])
    path = folder / "scores.png"
    save_figure(figure, path)
    yield "Normalised scores: interquartile mean over seeds and 95% interval", path


def draw_scores(axes: Axes, rows: Sequence[Row], models: Sequence[str]) -> None:
    """Draw the scores of each model over its number of labelled pairs, with their intervals.

    Args:
        rows: of one task and policy.
    """
    counts = sorted({row.pairs for row in rows if row.pairs is not None})
    for index, model in enumerate(models):
        found = [(row.pairs, score) for row in rows if row.reward == model and row.pairs and (score := row.score)]
        # One seed has no interval: a NaN draws no bar.
        bars = np.abs([[score.value - score.low, score.high - score.value] for _, score in found]).reshape(-1, 2).T
        # A model without results is in the legend, so that the first panel's legend is that of all panels.
        values = [score.value for _, score in found]
        draw_by_count(axes, [pairs for pairs, _ in found], values, bars, label=model, index=index, n_lines=len(models))
    axes.axhline(1, color=GREY, linestyle=":", label="true reward")
    format_counts(axes, counts)
    axes.yaxis.set_major_formatter(PercentFormatter(1))
    axes.grid(alpha=0.25)
    axes.set_xlabel("labelled pairs")
    axes.set_ylabel("score")


def _learning_curves(results: PaperResults, folder: Path) -> Iterator[tuple[str, Path]]:
    """One figure per policy and number of pairs, with a panel per task."""
    for policy in results.plan.policies:
        for pairs in sorted(results.plan.pairs):
            groups = _groups([one for one in results.policies if one.job.policy == policy], pairs)
            if any(group.labels is not None for group in groups):
                path = folder / f"curves-{path_name(policy)}-{pairs}.png"
                draw_curves(groups, path)
                yield f"Learning curves of {policy}, {pairs:,} pairs", path


def _groups(results: Sequence[PolicyResult], pairs: int) -> list[Group]:
    """Policies that trained in the task, without labels or on this number of pairs, by task and reward."""
    found: dict[tuple[str, str, str, int | None], list[PolicyResult]] = {}
    for one in results:
        if one.job.reward != UNTRAINED and one.job.pairs in (None, pairs) and not _offline(one):
            found.setdefault((one.job.task, one.job.policy, one.job.reward, one.job.pairs), []).append(one)
    return [
        Group(*key, differs="", runs=tuple(one.run for one in members if one.run is not None))
        for key, members in found.items()
    ]


def _offline(result: PolicyResult) -> bool:
    """Whether the policy trained on data alone, so that its curve is not by environment steps."""
    reward = result.job.run.settings.reward
    return isinstance(reward, ImitationSettings) and reward.offline


def _rewards(results: PaperResults, models: Sequence[CellJob], folder: Path) -> Iterator[tuple[str, Path]]:
    """Figures of the rewards of one seed, the first that has models, for each task and number of pairs."""
    for task in results.plan.tasks:
        for pairs in sorted(results.plan.pairs):
            found = [job for job in models if (job.settings.task, job.settings.labels) == (task, pairs)]
            if not found:
                continue
            seed = next(seed for seed in results.plan.seeds if any(job.settings.seed == seed for job in found))
            found = [job for job in found if job.settings.seed == seed]
            loaded = {job.settings.model: _load(job) for job in found}
            dataset = RecordedDataset.open(found[0].dataset)
            name = f"{path_name(task)}-{pairs}.png"
            sample = draw_sample(dataset, TEACHER, results.plan.test_pairs, seed)
            title = f"{task}, {pairs:,} pairs, seed {seed}"
            yield _draw_distributions(loaded, sample, agent_names(dataset), title, folder / f"rewards-{name}")
            for policy in results.plan.policies:
                played = _shown_policy(results, task, policy, pairs, seed)
                if played is not None:
                    path = folder / f"rollout-{path_name(policy)}-{name}"
                    yield _draw_rollout(played, loaded, dataset.source.n_steps, path)


def _load(job: CellJob) -> RewardModel:
    assert job.model is not None  # every model of these experiments is saved
    return load_reward_model(job.model / WEIGHTS_FILE, job.model / CARD_FILE).model


def _draw_distributions(
    models: Mapping[str, RewardModel], sample: Sample, agents: Sequence[str], title: str, path: Path
) -> tuple[str, Path]:
    """The paper's figures 2 and 4."""
    analyses = [analyse(name, model, sample) for name, model in models.items()]
    save_figure(draw_histograms(analyses, sample, agents), path)
    return f"Rewards of held-out state-action pairs (the paper's figures 2 and 4): {title}", path


def _shown_policy(results: PaperResults, task: str, policy: str, pairs: int, seed: int) -> PolicyResult | None:
    """The policy whose rollout is drawn; None if it is not trained."""
    models = results.plan.models
    wanted = (task, policy, _SHOWN_MODEL if _SHOWN_MODEL in models else models[0], pairs, seed)
    jobs = ((one, one.job) for one in results.policies)
    return next((one for one, job in jobs if (job.task, job.policy, job.reward, job.pairs, job.seed) == wanted), None)


def _draw_rollout(
    played: PolicyResult, models: dict[str, RewardModel], segment_steps: int, path: Path
) -> tuple[str, Path]:
    """The paper's figure 5: learned and true rewards along an episode of a policy that was trained on MAPT."""
    job = played.job
    policy = load_policy(job.run.folder, "cpu").policy
    with tempfile.TemporaryDirectory() as temporary:
        episodes = Path(temporary) / "episodes"
        record_episodes(job.task, policy, episodes, job.seed)
        series = episode_series(RecordedDataset.open(episodes), segment_steps, models, f"the policy of {job.name}")
    save_figure(draw_time_series(series.learned, series.true, series.title, series.breaks), path)
    return f"Learned and true reward along a rollout (the paper's figure 5): {job.name}", path
