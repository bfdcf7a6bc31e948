"""What the two preference attentions look at."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from mapt.studies.diagnosis import SHOWN_RANKS, Diagnosis, Sample
from mapt.studies.palette import QUIET, style
from mapt.studies.reward_figures import normalised

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
