"""Options that several commands share, and how lists in them are read."""

from enum import StrEnum
from typing import Annotated

import typer

from mapt.studies.errors import InvalidStudy

Task = Annotated[str, typer.Option(help="Task by name.")]
Seeds = Annotated[str, typer.Option(help="Seeds, with commas between; each has a replay of its own.")]
SegmentSteps = Annotated[int, typer.Option(min=1, help="Steps of a segment, T.")]
PolicySteps = Annotated[
    int, typer.Option(min=1, help="Environment steps of the policy's training from which segments are kept.")
]
Device = Annotated[str, typer.Option(help="Where the networks are: cpu, cuda or auto.")]
Segments = Annotated[int, typer.Option(min=10, help="Segments to keep of each replay, spread over the training.")]


class Preset(StrEnum):
    """Size of a network and its training."""

    SMALL = "small"
    PAPER = "paper"


def words(option: str, text: str) -> tuple[str, ...]:
    """The parts of a list with commas.

    Raises:
        InvalidStudy: if one is empty or comes twice.
    """
    parts = tuple(part.strip() for part in text.split(","))
    if not all(parts) or len(set(parts)) != len(parts):
        raise InvalidStudy(f"{option} {text!r} must name at least one, each once, with commas between")
    return parts


def numbers(option: str, text: str, least: int) -> tuple[int, ...]:
    """The whole numbers of a list with commas.

    Raises:
        InvalidStudy: if one is no number, too small, or comes twice.
    """
    try:
        parts = tuple(int(part) for part in words(option, text))
    except ValueError as error:
        raise InvalidStudy(f"{option} {text!r} is no list of numbers; it looks like 0,1,2") from error
    if min(parts) < least or len(set(parts)) != len(parts):
        raise InvalidStudy(f"{option} {text!r}: each must be {least} or more, and come once")
    return parts
