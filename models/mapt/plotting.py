"""Colours and marks of the figures: told apart with any colour vision, and in grey by their marks."""

from dataclasses import dataclass

#: Okabe and Ito's
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000", "#8D99A6")
MARKS = ("o", "s", "^", "D", "v", "P", "X", "*")
QUIET = "#8D99A6"


@dataclass(frozen=True, slots=True)
class Style:
    """How one line of a figure is drawn."""

    colour: str
    mark: str
    dashes: str


def style(index: int) -> Style:
    """Of the line with this number."""
    return Style(
        COLOURS[index % len(COLOURS)], MARKS[index % len(MARKS)], "solid" if index < len(COLOURS) else "dashed"
    )
