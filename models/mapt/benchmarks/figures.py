"""Figures of reward models: the accuracy table as a plot, and the figures of `mapt report`."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter
from numpy.typing import NDArray

from mapt.benchmarks.reward_analysis import SHOWN_RANKS, RewardAnalysis, Sample
from mapt.benchmarks.tables import Summary
from mapt.plotting import (
    GREY,
    draw_by_count,
    format_counts,
    line_style,
    outside_legend,
    panel_grid,
    save_figure,
    standardise,
    write_values,
)
from mapt.rewards.metrics import correlation

_BINS: list[float] = np.linspace(-4, 4, 81).tolist()
_PANEL_WIDTH, _PANEL_HEIGHT = 3.6, 2.9
_IMAGE_SIZE = 3.3
#: Maximum number of points of a scatter plot; more would hide each other.
_MAX_POINTS = 20_000
_PERCENTILES = (5, 25, 50, 75, 95)
#: Colours span at least this fraction of a uniform attention weight, so that noise looks like noise.
_MIN_COLOUR_RANGE = 0.25


def draw_table(summary: Summary, path: Path) -> None:
    """Plot the test error by number of labels, one panel per teacher, and write the figure to `path`.

    The error axis is logarithmic, since most models are mostly right.
    """
    teachers = summary.plan.teachers
    figure, panels = panel_grid(len(teachers), width=4.5, height=3.6)
    for axes, teacher in zip(panels, teachers, strict=True):
        _draw_teacher(axes, summary, teacher)
    outside_legend(figure, figure.axes[0])
    figure.suptitle(f"{summary.plan.task}: mean and standard deviation over seeds", fontsize="medium")
    save_figure(figure, path)


def _draw_teacher(axes: Axes, summary: Summary, teacher: str) -> None:
    # A logarithmic axis has no 0: half a pair stands for no error.
    minimum = 0.5 / summary.plan.test_pairs
    models, counts = summary.plan.models, sorted(summary.plan.labels)
    for index, model in enumerate(models):
        lines = [summary.line(teacher, labels, model) for labels in counts]
        found = [(line.labels, line.metrics["accuracy"]) for line in lines if "accuracy" in line.metrics]
        if not found:
            continue
        errors = [100 * max(1 - accuracy.mean, minimum) for _, accuracy in found]
        deviations = [100 * accuracy.std for _, accuracy in found]
        draw_by_count(
            axes, [labels for labels, _ in found], errors, deviations, label=model, index=index, n_lines=len(models)
        )
    format_counts(axes, counts)
    if axes.has_data():
        axes.set_yscale("log")
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.yaxis.set_minor_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.grid(alpha=0.25, which="both")
    axes.set_title(teacher)
    axes.set_xlabel("labels")
    axes.set_ylabel("test error (%)")


def draw_histograms(analyses: Sequence[RewardAnalysis], sample: Sample, agents: Sequence[str]) -> Figure:
    """The paper's figures 2 and 4: histograms of standardised rewards, one line per agent, one panel per model."""
    figure, panels = panel_grid(len(analyses) + 1, _PANEL_WIDTH, _PANEL_HEIGHT)
    mask = sample.mask
    true = standardise(sample.rewards[mask])
    panels[0].hist(true, _BINS, density=True, color=GREY, histtype="stepfilled", alpha=0.8)
    panels[0].set_title("true team reward")
    for axes, analysis in zip(panels[1:], analyses, strict=True):
        learned = standardise(analysis.predictions.agent_rewards[mask])
        for n, agent in enumerate(agents):
            axes.hist(
                learned[:, n],
                _BINS,
                density=True,
                histtype="step",
                color=line_style(n).colour,
                linestyle=("solid", "dashed")[n % 2],
                linewidth=1.4,
                label=agent,
            )
        axes.set_title(analysis.name)
    for axes in panels:
        axes.set_xlabel("standardised reward")
        axes.set_yticks([])
        axes.set_xlim(_BINS[0], _BINS[-1])
    panels[0].set_ylabel("density")
    outside_legend(figure, panels[-1])
    figure.suptitle(f"Rewards of {mask.sum():,} state-action pairs")
    return figure


def draw_time_series(
    learned: dict[str, NDArray[np.floating]], true: NDArray[np.floating], title: str, breaks: Sequence[int] = ()
) -> Figure:
    """The paper's figure 5: standardised team rewards along a rollout.

    Args:
        learned: (L,) by model.
        true: (L,).
        title: describes the rollout.
        breaks: first steps of the segments after the first one.
    """
    figure = Figure(figsize=(10, 0.8 + 1.7 * len(learned)), layout="constrained")
    panels = figure.subplots(len(learned), 1, squeeze=False, sharex=True).flat
    for index, (axes, (name, rewards)) in enumerate(zip(panels, learned.items(), strict=True)):
        axes.plot(standardise(true), color="black", linewidth=1.0, label="true")
        axes.plot(standardise(rewards), color=line_style(index).colour, linewidth=1.2, label=name)
        for step in breaks:
            axes.axvline(step - 0.5, color=GREY, linestyle=":")
        axes.set_title(f"{name}: correlation {correlation(rewards, true):.2f}", fontsize=10, loc="left")
        axes.legend(loc="upper right", ncols=2, frameon=False, fontsize=8)
        axes.set_xlim(0, len(true) - 1)
        low, high = axes.get_ylim()
        axes.set_ylim(low, high + 0.25 * (high - low))
    figure.axes[-1].set_xlabel("step")
    figure.supylabel("standardised reward", fontsize=10)
    figure.suptitle(title)
    return figure


def draw_ranks(analyses: Sequence[RewardAnalysis], sample: Sample) -> Figure:
    """Scores against true returns of segments, and learned against true rewards of steps."""
    figure = Figure(figsize=(1.0 + _PANEL_WIDTH * len(analyses), 2 * _PANEL_HEIGHT + 0.4), layout="constrained")
    panels = figure.subplots(2, len(analyses), squeeze=False)
    rng, mask = np.random.default_rng(0), sample.mask
    steps = rng.permutation(int(mask.sum()))[:_MAX_POINTS]
    age = np.arange(len(sample.indices)) / len(sample.indices)
    dots = None
    for column, analysis in enumerate(analyses):
        top, bottom = panels[0, column], panels[1, column]
        dots = top.scatter(
            sample.returns, analysis.predictions.scores, s=5, c=age, cmap="viridis", vmin=0, vmax=1, lw=0
        )
        top.set_title(f"{analysis.name}\nrank correlation {analysis.metrics.get('rank_correlation', np.nan):.3f}")
        top.set_xlabel("true return of a segment")
        learned, true = analysis.predictions.rewards[mask][steps], sample.rewards[mask][steps]
        bottom.hexbin(true, learned, gridsize=50, bins="log", mincnt=1, cmap="Blues", linewidths=0.1)
        bottom.set_title(f"correlation {analysis.metrics.get('step_correlation', np.nan):.3f}")
        bottom.set_xlabel("true reward of a step")
    panels[0, 0].set_ylabel("score")
    panels[1, 0].set_ylabel("learned team reward")
    if dots is not None:
        bar = figure.colorbar(dots, ax=panels[0, :], ticks=[0, 1], aspect=30)
        bar.set_ticklabels(["first", "last"])
        bar.set_label("order of recording")
    return figure


def draw_calibration(analyses: Sequence[RewardAnalysis]) -> Figure:
    """Observed against predicted preference probability, and the number of predictions in each bin."""
    figure = Figure(figsize=(6.4, 7.6), layout="constrained")
    curve, counts = figure.subplots(2, 1, sharex=True, height_ratios=(3.5, 1))
    curve.plot([0, 1], [0, 1], color=GREY, linestyle=":", label="calibrated")
    for index, analysis in enumerate(analyses):
        style, bins = line_style(index), analysis.calibration
        ece = analysis.metrics.get("ece", np.nan)
        predicted = [each.predicted for each in bins]
        curve.plot(
            predicted,
            [each.observed for each in bins],
            color=style.colour,
            marker=style.marker,
            markersize=5,
            label=f"{analysis.name}: ECE {ece:.3f}",
        )
        counts.plot(predicted, [each.count for each in bins], color=style.colour, marker=style.marker, markersize=4)
    curve.set_ylabel("observed frequency")
    curve.legend(frameon=False, loc="upper left")
    counts.set_yscale("log")
    counts.set_ylabel("predictions")
    counts.set_xlabel("predicted probability that a segment is preferred")
    for axes in (curve, counts):
        axes.grid(alpha=0.25)
    return figure


def draw_agents(analyses: Sequence[RewardAnalysis], sample: Sample, agents: Sequence[str]) -> Figure:
    """Distribution of each agent's rewards, and the correlation of rewards between agents."""
    n_agents = len(agents)
    figure = Figure(figsize=(1.2 + _PANEL_WIDTH * len(analyses), 2 * _PANEL_HEIGHT + 0.8), layout="constrained")
    panels = figure.subplots(2, len(analyses), squeeze=False, sharey="row")
    image = None
    for column, analysis in enumerate(analyses):
        learned = standardise(analysis.predictions.agent_rewards[sample.mask])
        _draw_percentiles(panels[0, column], learned)
        deviation = analysis.metrics.get("spread_across_agents", np.nan)
        panels[0, column].set_title(f"{analysis.name}\ndeviation between agents {deviation:.2f}")
        correlations = np.array([[correlation(a, b) for b in learned.T] for a in learned.T])
        image = panels[1, column].imshow(correlations, cmap="RdBu_r", vmin=-1, vmax=1)
        write_values(panels[1, column], correlations, abs(correlations) > 0.6)
        for axes in panels[:, column]:
            axes.set_xticks(range(n_agents), agents, rotation=45, ha="right", fontsize=8)
        panels[1, column].set_yticks(range(n_agents), agents, fontsize=8)
    panels[0, 0].set_ylabel("standardised reward")
    if image is not None:
        figure.colorbar(image, ax=panels[1, :], aspect=20, label="correlation")
    return figure


def _draw_percentiles(axes: Axes, learned: NDArray[np.floating]) -> None:
    """Median, middle 50% and middle 90% of each column."""
    for n, values in enumerate(learned.T):
        low, quarter, median, three_quarters, high = np.percentile(values, _PERCENTILES)
        colour = line_style(n).colour
        axes.plot([n, n], [low, high], color=colour, linewidth=1.2)
        axes.plot([n, n], [quarter, three_quarters], color=colour, linewidth=7, solid_capstyle="butt", alpha=0.7)
        axes.plot([n], [median], color="white", marker="o", markersize=4, markeredgecolor="black")
    axes.axhline(0, color=GREY, linestyle=":")


def draw_step_attention(analyses: Sequence[RewardAnalysis], sample: Sample) -> Figure | None:
    """Temporal-aware attention over three segments of low, medium and high return; None if no model has it.

    For each model and segment: the attention matrix (paper, eq. 5), and above it the weight of each step (eq. 6) with
    the true reward.
    """
    shown = [analysis for analysis in analyses if analysis.attention.steps is not None]
    if not shown:
        return None
    n_segments = len(sample.shown)
    size = (0.8 + 1.15 * _IMAGE_SIZE * n_segments, 1.45 * _IMAGE_SIZE * len(shown))
    figure = Figure(figsize=size, layout="constrained")
    blocks = figure.subfigures(len(shown), 1, squeeze=False).flat
    for block, analysis in zip(blocks, shown, strict=True):
        panels = block.subplots(2, n_segments, squeeze=False, height_ratios=(1, 2.2), sharex="col")
        concentration = analysis.metrics["weight_concentration"]
        block.suptitle(f"{analysis.name}: step weights (concentration {concentration:.3f})", fontsize=11)
        assert analysis.attention.steps is not None
        # Scaled by T, uniform attention is 1.
        scaled = analysis.attention.steps * sample.mask[sample.shown].sum(axis=1)[:, None, None]
        maximum = float(scaled.max())
        image = None
        for column in range(n_segments):
            _draw_weights(panels[0, column], analysis, sample, column)
            n_steps = int(sample.mask[sample.shown[column]].sum())
            matrix = scaled[column, :n_steps, :n_steps]
            image = panels[1, column].imshow(matrix, cmap="magma", vmin=0, vmax=maximum, aspect="auto", origin="lower")
            panels[1, column].set_xlabel("key step")
        assert image is not None
        block.colorbar(image, ax=panels[1, :], aspect=25, label="attention x T")
        panels[0, 0].set_ylabel("weight x T")
        panels[1, 0].set_ylabel("query step")
    return figure


def _draw_weights(axes: Axes, analysis: RewardAnalysis, sample: Sample, column: int) -> None:
    """The weight of each step of one of the shown segments, over its true reward."""
    segment = int(sample.shown[column])
    n_steps = int(sample.mask[segment].sum())
    weights = analysis.predictions.weights[segment, :n_steps] * n_steps
    axes.axhline(1, color=GREY, linestyle=":")
    axes.plot(weights, color=line_style(0).colour, label="weight x T")
    low, high = min(0.95, float(weights.min())), max(1.05, float(weights.max()))
    axes.set_ylim(low - 0.1 * (high - low), high + 0.1 * (high - low))
    twin: Axes = axes.twinx()
    twin.plot(standardise(sample.rewards[segment, :n_steps]), color="black", alpha=0.5, linewidth=0.9)
    twin.set_yticks([])
    axes.set_title(f"return {sample.returns[segment]:.1f} (percentile {100 * SHOWN_RANKS[column]:.0f})", fontsize=9)


def draw_agent_attention(analyses: Sequence[RewardAnalysis], agents: Sequence[str]) -> Figure | None:
    """Cooperation-aware attention between agents, averaged over steps (paper, eq. 4); None if no model has it."""
    shown = [(each, each.agent_attention) for each in analyses if each.agent_attention is not None]
    if not shown:
        return None
    figure = Figure(figsize=(1.6 + _IMAGE_SIZE * len(shown), _IMAGE_SIZE + 1.0), layout="constrained")
    panels = list(figure.subplots(1, len(shown), squeeze=False).flat)
    uniform = 1 / len(agents)
    limit = max(_MIN_COLOUR_RANGE * uniform, *(float(abs(attention - uniform).max()) for _, attention in shown))
    image = None
    for index, (axes, (analysis, attention)) in enumerate(zip(panels, shown, strict=True)):
        image = axes.imshow(attention, cmap="RdBu_r", vmin=uniform - limit, vmax=uniform + limit)
        write_values(axes, attention, abs(attention - uniform) > 0.6 * limit)
        axes.set_title(analysis.name)
        axes.set_xticks(range(len(agents)), agents, rotation=45, ha="right", fontsize=8)
        axes.set_yticks(range(len(agents)), agents if index == 0 else [], fontsize=8)
        axes.set_xlabel("key agent")
    panels[0].set_ylabel("query agent")
    if image is not None:
        figure.colorbar(image, ax=panels, aspect=20, label=f"attention weight (white: uniform, {uniform:.2f})")
    return figure
