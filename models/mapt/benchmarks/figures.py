"""Learned against true reward: how they are spread, how they go along a rollout, how they rank."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, NullLocator
from numpy.typing import NDArray

from mapt.benchmarks.reward_analysis import SHOWN_RANKS, Diagnosis, Sample
from mapt.benchmarks.tables import Summary
from mapt.plotting import QUIET, style
from mapt.rewards.metrics import correlation

_BINS: list[float] = np.linspace(-4, 4, 81).tolist()
_PANEL_WIDTH, _PANEL_HEIGHT, _MOST_COLUMNS = 3.6, 2.9, 3
#: points of a scatter plot; more only darken it
_MOST_POINTS = 20_000
_PERCENTILES = (5, 25, 50, 75, 95)


def draw_histograms(diagnoses: Sequence[Diagnosis], sample: Sample, agents: Sequence[str]) -> Figure:
    """The paper's figures 2 and 4: rewards of state-action pairs, a colour for each agent, each model in units of its
    own deviation."""
    figure, panels = _grid(len(diagnoses) + 1)
    mask = sample.mask
    true = normalised(sample.rewards[mask])
    panels[0].hist(true, _BINS, density=True, color=QUIET, histtype="stepfilled", alpha=0.8)
    panels[0].set_title("true reward of the team")
    for axes, diagnosis in zip(panels[1:], diagnoses, strict=True):
        learned = normalised(diagnosis.predictions.agent_rewards[mask])
        for n, agent in enumerate(agents):
            drawn = style(n)
            axes.hist(
                learned[:, n],
                _BINS,
                density=True,
                histtype="step",
                color=drawn.colour,
                linestyle=("solid", "dashed")[n % 2],
                linewidth=1.4,
                label=agent,
            )
        axes.set_title(diagnosis.name)
    for axes in panels:
        axes.set_xlabel("reward, in deviations")
        axes.set_yticks([])
        axes.set_xlim(_BINS[0], _BINS[-1])
    panels[0].set_ylabel("density")
    _legend(figure, panels[-1])
    figure.suptitle(f"Rewards of {mask.sum():,} state-action pairs")
    return figure


def draw_time_series(
    learned: dict[str, NDArray[np.floating]], true: NDArray[np.floating], what: str, breaks: Sequence[int] = ()
) -> Figure:
    """The paper's figure 5: the team's reward along a rollout, both with mean 0 and deviation 1.

    Args:
        learned: for each model, (L,).
        true: (L,).
        what: the rollout, in words.
        breaks: steps before which something else begins.
    """
    figure = Figure(figsize=(10, 0.8 + 1.7 * len(learned)), layout="constrained")
    panels = figure.subplots(len(learned), 1, squeeze=False, sharex=True).flat
    for index, (axes, (name, rewards)) in enumerate(zip(panels, learned.items(), strict=True)):
        axes.plot(normalised(true), color="black", linewidth=1.0, label="true")
        axes.plot(normalised(rewards), color=style(index).colour, linewidth=1.2, label=name)
        for step in breaks:
            axes.axvline(step - 0.5, color=QUIET, linestyle=":")
        axes.set_title(f"{name}: correlation {correlation(rewards, true):.2f}", fontsize=10, loc="left")
        axes.legend(loc="upper right", ncols=2, frameon=False, fontsize=8)
        axes.set_xlim(0, len(true) - 1)
        low, high = axes.get_ylim()
        axes.set_ylim(low, high + 0.25 * (high - low))
    figure.axes[-1].set_xlabel("step")
    figure.supylabel("reward, in deviations", fontsize=10)
    figure.suptitle(what)
    return figure


def draw_ranks(diagnoses: Sequence[Diagnosis], sample: Sample) -> Figure:
    """Scores by true returns of segments, and r-hat by true reward of steps."""
    figure = Figure(figsize=(1.0 + _PANEL_WIDTH * len(diagnoses), 2 * _PANEL_HEIGHT + 0.4), layout="constrained")
    panels = figure.subplots(2, len(diagnoses), squeeze=False)
    rng, mask = np.random.default_rng(0), sample.mask
    steps = rng.permutation(int(mask.sum()))[:_MOST_POINTS]
    age = np.arange(len(sample.indices)) / len(sample.indices)
    dots = None
    for column, diagnosis in enumerate(diagnoses):
        above, below = panels[0, column], panels[1, column]
        dots = above.scatter(
            sample.returns, diagnosis.predictions.scores, s=5, c=age, cmap="viridis", vmin=0, vmax=1, lw=0
        )
        above.set_title(f"{diagnosis.name}\nrank correlation {diagnosis.metrics.get('rank_correlation', np.nan):.3f}")
        above.set_xlabel("true return of a segment")
        learned, true = diagnosis.predictions.rewards[mask][steps], sample.rewards[mask][steps]
        below.hexbin(true, learned, gridsize=50, bins="log", mincnt=1, cmap="Blues", linewidths=0.1)
        below.set_title(f"correlation {diagnosis.metrics.get('step_correlation', np.nan):.3f}")
        below.set_xlabel("true reward of a step")
    panels[0, 0].set_ylabel("score")
    panels[1, 0].set_ylabel("learned reward of the team")
    if dots is not None:
        bar = figure.colorbar(dots, ax=panels[0, :], ticks=[0, 1], aspect=30)
        bar.set_ticklabels(["first", "last"])
        bar.set_label("when it was played")
    return figure


def draw_calibration(diagnoses: Sequence[Diagnosis]) -> Figure:
    """How often the labels agree with a prediction of so much, and how many predictions there are of each."""
    figure = Figure(figsize=(6.4, 7.6), layout="constrained")
    curve, counts = figure.subplots(2, 1, sharex=True, height_ratios=(3.5, 1))
    curve.plot([0, 1], [0, 1], color=QUIET, linestyle=":", label="calibrated")
    for index, diagnosis in enumerate(diagnoses):
        drawn, bins = style(index), diagnosis.calibration
        ece = diagnosis.metrics.get("ece", np.nan)
        predicted = [each.predicted for each in bins]
        curve.plot(
            predicted,
            [each.observed for each in bins],
            color=drawn.colour,
            marker=drawn.mark,
            markersize=5,
            label=f"{diagnosis.name}: ECE {ece:.3f}",
        )
        counts.plot(predicted, [each.count for each in bins], color=drawn.colour, marker=drawn.mark, markersize=4)
    curve.set_ylabel("how often it was labelled better")
    curve.legend(frameon=False, loc="upper left")
    counts.set_yscale("log")
    counts.set_ylabel("predictions")
    counts.set_xlabel("predicted probability that a segment is better")
    for axes in (curve, counts):
        axes.grid(alpha=0.25)
    return figure


def draw_agents(diagnoses: Sequence[Diagnosis], sample: Sample, agents: Sequence[str]) -> Figure:
    """Rewards of each agent beside each other, and how they go together."""
    n_agents = len(agents)
    figure = Figure(figsize=(1.2 + _PANEL_WIDTH * len(diagnoses), 2 * _PANEL_HEIGHT + 0.8), layout="constrained")
    panels = figure.subplots(2, len(diagnoses), squeeze=False, sharey="row")
    image = None
    for column, diagnosis in enumerate(diagnoses):
        learned = normalised(diagnosis.predictions.agent_rewards[sample.mask])
        _draw_ranges(panels[0, column], learned)
        panels[0, column].set_title(
            f"{diagnosis.name}\nspread across agents {diagnosis.metrics.get('spread_across_agents', np.nan):.2f}"
        )
        together = np.array([[correlation(a, b) for b in learned.T] for a in learned.T])
        image = panels[1, column].imshow(together, cmap="RdBu_r", vmin=-1, vmax=1)
        _write_numbers(panels[1, column], together)
        for axes in panels[:, column]:
            axes.set_xticks(range(n_agents), agents, rotation=45, ha="right", fontsize=8)
        panels[1, column].set_yticks(range(n_agents), agents, fontsize=8)
    panels[0, 0].set_ylabel("reward, in deviations")
    if image is not None:
        figure.colorbar(image, ax=panels[1, :], aspect=20, label="correlation")
    return figure


def normalised(values: NDArray[np.floating]) -> NDArray[np.floating]:
    """With mean 0 and deviation 1 over all of them; a constant gives 0."""
    return (values - values.mean()) / max(float(values.std()), 1e-12)


def _draw_ranges(axes: Axes, learned: NDArray[np.floating]) -> None:
    """Median, middle half and middle nine tenths of each column."""
    for n, values in enumerate(learned.T):
        low, quarter, middle, three_quarters, high = np.percentile(values, _PERCENTILES)
        colour = style(n).colour
        axes.plot([n, n], [low, high], color=colour, linewidth=1.2)
        axes.plot([n, n], [quarter, three_quarters], color=colour, linewidth=7, solid_capstyle="butt", alpha=0.7)
        axes.plot([n], [middle], color="white", marker="o", markersize=4, markeredgecolor="black")
    axes.axhline(0, color=QUIET, linestyle=":")


def _write_numbers(axes: Axes, values: NDArray[np.floating]) -> None:
    for (row, column), value in np.ndenumerate(values):
        if np.isfinite(value):
            dark = abs(value) > 0.6
            axes.text(
                column, row, f"{value:.2f}", ha="center", va="center", fontsize=7, color="white" if dark else "black"
            )


def _grid(n_panels: int) -> tuple[Figure, list[Axes]]:
    """Panels in as few rows as leave them readable; those that are left over are not drawn."""
    rows = -(-n_panels // _MOST_COLUMNS)
    columns = -(-n_panels // rows)
    figure = Figure(figsize=(1.6 + _PANEL_WIDTH * columns, _PANEL_HEIGHT * rows + 0.5), layout="constrained")
    panels = list(figure.subplots(rows, columns, squeeze=False).flat)
    for axes in panels[n_panels:]:
        axes.set_axis_off()
    return figure, panels[:n_panels]


def _legend(figure: Figure, axes: Axes) -> None:
    handles, names = axes.get_legend_handles_labels()
    figure.legend(handles, names, loc="outside right center", frameon=False, fontsize=9)


_PANEL = 3.3
#: colours span at least this share of an equal attention to either side, so that noise looks like noise
_LEAST_RANGE = 0.25


def draw_step_attention(diagnoses: Sequence[Diagnosis], sample: Sample) -> Figure | None:
    """Temporal preference attention over three segments of poor, middling and good return; None if no model has any.

    For each model and segment, who asks whom (eq. 5), and above it the weight of each step (eq. 6) beside the true
    reward.
    """
    having = [diagnosis for diagnosis in diagnoses if diagnosis.maps.steps is not None]
    if not having:
        return None
    n_shown = len(sample.shown)
    figure = Figure(figsize=(0.8 + 1.15 * _PANEL * n_shown, 1.45 * _PANEL * len(having)), layout="constrained")
    blocks = figure.subfigures(len(having), 1, squeeze=False).flat
    for block, diagnosis in zip(blocks, having, strict=True):
        panels = block.subplots(2, n_shown, squeeze=False, height_ratios=(1, 2.2), sharex="col")
        block.suptitle(
            f"{diagnosis.name}: weights of steps (concentration {diagnosis.metrics['weight_concentration']:.3f})",
            fontsize=11,
        )
        assert diagnosis.maps.steps is not None
        # 1 where all steps weigh the same.
        shares = diagnosis.maps.steps * sample.mask[sample.shown].sum(axis=1)[:, None, None]
        greatest = float(shares.max())
        image = None
        for column in range(n_shown):
            _draw_weights(panels[0, column], diagnosis, sample, column)
            n_steps = int(sample.mask[sample.shown[column]].sum())
            seen = shares[column, :n_steps, :n_steps]
            image = panels[1, column].imshow(seen, cmap="magma", vmin=0, vmax=greatest, aspect="auto", origin="lower")
            panels[1, column].set_xlabel("step asked")
        assert image is not None
        block.colorbar(image, ax=panels[1, :], aspect=25, label="attention x T")
        panels[0, 0].set_ylabel("weight x T")
        panels[1, 0].set_ylabel("step that asks")
    return figure


def _draw_weights(above: Axes, diagnosis: Diagnosis, sample: Sample, column: int) -> None:
    """The weight of each step of one of the shown segments, over its true reward."""
    place = int(sample.shown[column])
    n_steps = int(sample.mask[place].sum())
    weights = diagnosis.predictions.weights[place, :n_steps] * n_steps
    above.axhline(1, color=QUIET, linestyle=":")
    above.plot(weights, color=style(0).colour, label="weight x T")
    low, high = min(0.95, float(weights.min())), max(1.05, float(weights.max()))
    above.set_ylim(low - 0.1 * (high - low), high + 0.1 * (high - low))
    beside: Axes = above.twinx()
    beside.plot(normalised(sample.rewards[place, :n_steps]), color="black", alpha=0.5, linewidth=0.9)
    beside.set_yticks([])
    share = SHOWN_RANKS[column]
    above.set_title(f"return {sample.returns[place]:.1f} (above {share:.0%} of segments)", fontsize=9)


def draw_agent_attention(diagnoses: Sequence[Diagnosis], agents: Sequence[str]) -> Figure | None:
    """Co-operation-aware attention: who looks at whom, on average (eq. 4); None if no model has any."""
    having = [(each, each.agent_attention) for each in diagnoses if each.agent_attention is not None]
    if not having:
        return None
    figure = Figure(figsize=(1.6 + _PANEL * len(having), _PANEL + 1.0), layout="constrained")
    panels = list(figure.subplots(1, len(having), squeeze=False).flat)
    equal = 1 / len(agents)
    farthest = max(_LEAST_RANGE * equal, *(float(abs(attention - equal).max()) for _, attention in having))
    image = None
    for index, (axes, (diagnosis, attention)) in enumerate(zip(panels, having, strict=True)):
        image = axes.imshow(attention, cmap="RdBu_r", vmin=equal - farthest, vmax=equal + farthest)
        for (row, column), value in np.ndenumerate(attention):
            colour = "white" if abs(value - equal) > 0.6 * farthest else "black"
            axes.text(column, row, f"{value:.2f}", ha="center", va="center", fontsize=7, color=colour)
        axes.set_title(diagnosis.name)
        axes.set_xticks(range(len(agents)), agents, rotation=45, ha="right", fontsize=8)
        axes.set_yticks(range(len(agents)), agents if index == 0 else [], fontsize=8)
        axes.set_xlabel("is looked at")
    panels[0].set_ylabel("looks")
    if image is not None:
        figure.colorbar(image, ax=panels, aspect=20, label=f"share of attention (white: {equal:.2f}, equal)")
    return figure


_PANELS_PER_ROW = 3
#: models are drawn beside each other at the same number of labels
_SHIFT = 0.03
#: room beside the fewest and the most labels
_MARGIN = 1.5


def draw_table(summary: Summary, path: Path) -> None:
    """Write the picture; the share told wrongly, on a logarithmic axis, since most models are mostly right."""
    teachers = summary.plan.teachers
    columns = min(_PANELS_PER_ROW, len(teachers))
    rows = -(-len(teachers) // columns)
    figure = Figure(figsize=(1.5 + 4.5 * columns, 1.2 + 3.6 * rows), layout="constrained")
    panels = list(figure.subplots(rows, columns, squeeze=False).flat)
    for axes, teacher in zip(panels, teachers, strict=False):
        _draw_teacher(axes, summary, teacher)
    for axes in panels[len(teachers) :]:
        axes.set_axis_off()
    handles, names = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside right center", frameon=False, fontsize="small")
    # No longer than one panel is wide.
    figure.suptitle(f"{summary.plan.task}, mean and spread over seeds", fontsize="medium")
    figure.savefig(path, dpi=130)


def _draw_teacher(axes: Axes, summary: Summary, teacher: str) -> None:
    # Nothing wrong has no place on a logarithmic axis: half a pair stands for it.
    least = 0.5 / summary.plan.test_pairs
    models, counts = summary.plan.models, sorted(summary.plan.labels)
    for index, model in enumerate(models):
        lines = [summary.line(teacher, labels, model) for labels in counts]
        found = [(line.labels, line.metrics["accuracy"]) for line in lines if "accuracy" in line.metrics]
        if not found:
            continue
        drawn, shift = style(index), 1 + _SHIFT * (index - (len(models) - 1) / 2)
        axes.errorbar(
            [labels * shift for labels, _ in found],
            [100 * max(1 - accuracy.mean, least) for _, accuracy in found],
            yerr=[100 * accuracy.deviation for _, accuracy in found],
            label=model,
            capsize=2,
            markersize=5,
            linewidth=1.2,
            color=drawn.colour,
            marker=drawn.mark,
            linestyle=drawn.dashes,
        )
    axes.set_xscale("log")
    axes.set_xlim(counts[0] / _MARGIN, counts[-1] * _MARGIN)
    axes.set_xticks(counts, [f"{labels:,}" for labels in counts])
    axes.xaxis.set_minor_locator(NullLocator())
    if axes.has_data():
        axes.set_yscale("log")
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.yaxis.set_minor_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.grid(alpha=0.25, which="both")
    axes.set_title(teacher)
    axes.set_xlabel("labels")
    axes.set_ylabel("fresh pairs told wrongly, %")
