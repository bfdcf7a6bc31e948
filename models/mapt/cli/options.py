"""Options that several commands share."""

from enum import StrEnum
from typing import Annotated

import typer

Task = Annotated[str, typer.Option(help="Task by name.")]
Seeds = Annotated[str, typer.Option(help="Seeds, with commas between; each has a replay of its own.")]
SegmentSteps = Annotated[int, typer.Option(min=1, help="Steps of a segment, T.")]
PolicySteps = Annotated[
    int, typer.Option(min=1, help="Environment steps of the policy's training from which segments are kept.")
]
Device = Annotated[str, typer.Option(help="Where the networks are: cpu, cuda or auto.")]
Workers = Annotated[
    int, typer.Option(min=0, help="How many at once, each in a process of its own; 0 for one per core.")
]
Segments = Annotated[int, typer.Option(min=10, help="Segments to keep of each replay, spread over the training.")]


class Preset(StrEnum):
    """Size of a network and its training."""

    SMALL = "small"
    PAPER = "paper"
