"""A table as a picture: accuracy by labels, one panel for each teacher."""

from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, NullLocator

from mapt.studies.palette import style
from mapt.studies.summary import Summary

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
