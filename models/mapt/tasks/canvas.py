"""Anti-aliased shapes on an RGB image, in numpy: what drawings of states are made of.

Positions and lengths are in pixels; x points right and y down, and (0, 0) is the upper left corner of the image.
"""

import copy
import math

import numpy as np
from numpy.typing import NDArray

#: Red, green and blue from 0 to 255.
Colour = tuple[int, int, int]
Floats = NDArray[np.floating]

#: first column and length of the runs of pixels in a row of a digit, by the row's three bits
_RUNS = ((), ((2, 1),), ((1, 1),), ((1, 2),), ((0, 1),), ((0, 1), (2, 1)), ((0, 2),), ((0, 3),))
#: the bits of the five rows of each digit
_DIGITS = (
    (7, 5, 5, 5, 7),
    (2, 6, 2, 2, 7),
    (7, 1, 7, 4, 7),
    (7, 1, 7, 1, 7),
    (5, 5, 7, 1, 1),
    (7, 4, 7, 1, 7),
    (7, 4, 7, 5, 7),
    (7, 1, 1, 1, 1),
    (7, 5, 7, 5, 7),
    (7, 5, 7, 1, 7),
)


class Canvas:
    """An image to draw on. Shapes may reach beyond its edges; what lies outside is not drawn."""

    def __init__(self, height: int, width: int, colour: Colour) -> None:
        self.height, self.width = height, width
        self._pixels = np.empty((height, width, 3), dtype=np.float32)
        self._pixels[:] = colour

    def copy(self) -> "Canvas":
        """Another canvas with the same image."""
        same = copy.copy(self)
        same._pixels = self._pixels.copy()
        return same

    def image(self) -> NDArray[np.uint8]:
        """A copy of the image, (H, W, 3)."""
        return (self._pixels + 0.5).astype(np.uint8)

    def rectangle(self, left: float, top: float, width: float, height: float, colour: Colour) -> None:
        """Fill a rectangle."""
        patch = self._patch(left, top, left + width, top + height)
        if patch is not None:
            (rows, columns), (x, y) = patch
            across = np.clip(np.minimum(x + 0.5 - left, left + width - x + 0.5), 0, min(1.0, width))
            down = np.clip(np.minimum(y + 0.5 - top, top + height - y + 0.5), 0, min(1.0, height))
            self._blend(rows, columns, across * down, colour)

    def disc(self, x: float, y: float, radius: float, colour: Colour, opacity: float = 1.0) -> None:
        """Fill a disc."""
        patch = self._patch(x - radius, y - radius, x + radius, y + radius)
        if patch is not None:
            (rows, columns), (px, py) = patch
            inside = radius - np.sqrt((px - x) ** 2 + (py - y) ** 2)
            self._blend(rows, columns, opacity * np.clip(inside + 0.5, 0, 1), colour)

    def discs(self, x: NDArray[np.floating], y: NDArray[np.floating], radius: float, colour: Colour) -> None:
        """Fill the union of discs of one radius around n points, (n,) and (n,)."""
        covered = np.zeros((self.height, self.width), dtype=np.float32)
        for centre_x, centre_y in zip(x.tolist(), y.tolist(), strict=True):
            patch = self._patch(centre_x - radius, centre_y - radius, centre_x + radius, centre_y + radius)
            if patch is not None:
                (rows, columns), (px, py) = patch
                inside = np.clip(radius + 0.5 - np.sqrt((px - centre_x) ** 2 + (py - centre_y) ** 2), 0, 1)
                np.maximum(covered[rows, columns], inside, out=covered[rows, columns])
        self._blend(slice(None), slice(None), covered, colour)

    def diamond(self, x: float, y: float, radius: float, colour: Colour, opacity: float = 1.0) -> None:
        """Fill a square that stands on a corner, with its corners `radius` from its centre."""
        patch = self._patch(x - radius, y - radius, x + radius, y + radius)
        if patch is not None:
            (rows, columns), (px, py) = patch
            inside = (radius - np.abs(px - x) - np.abs(py - y)) * math.sqrt(0.5)
            self._blend(rows, columns, opacity * np.clip(inside + 0.5, 0, 1), colour)

    def line(
        self, start: tuple[float, float], end: tuple[float, float], width: float, colour: Colour, opacity: float = 1.0
    ) -> None:
        """Draw a line with round ends."""
        (x0, y0), (x1, y1), half = start, end, width / 2
        patch = self._patch(min(x0, x1) - half, min(y0, y1) - half, max(x0, x1) + half, max(y0, y1) + half)
        if patch is not None:
            (rows, columns), (x, y) = patch
            way_x, way_y = x1 - x0, y1 - y0
            length = max(way_x * way_x + way_y * way_y, 1e-9)
            along = np.clip(((x - x0) * way_x + (y - y0) * way_y) / length, 0, 1)
            distance = np.sqrt((x - x0 - along * way_x) ** 2 + (y - y0 - along * way_y) ** 2)
            self._blend(rows, columns, opacity * np.clip(half + 0.5 - distance, 0, 1), colour)

    def number(self, value: int, x: float, y: float, height: float, colour: Colour) -> None:
        """Write a number, centred at a point."""
        pixel, digits = height / 5, [int(digit) for digit in str(value)]
        left, top = x - pixel * (4 * len(digits) - 1) / 2, y - height / 2
        for position, digit in enumerate(digits):
            for row, bits in enumerate(_DIGITS[digit]):
                for column, length in _RUNS[bits]:
                    start = left + pixel * (4 * position + column)
                    self.rectangle(start, top + pixel * row, pixel * length, pixel, colour)

    def _patch(
        self, left: float, top: float, right: float, bottom: float
    ) -> tuple[tuple[slice, slice], tuple[Floats, Floats]] | None:
        """Rows and columns of the pixels in a box, and their centres: x (1, w) and y (h, 1). None if there are none."""
        first_column, last_column = max(math.floor(left) - 1, 0), min(math.ceil(right) + 1, self.width)
        first_row, last_row = max(math.floor(top) - 1, 0), min(math.ceil(bottom) + 1, self.height)
        if first_column >= last_column or first_row >= last_row:
            return None
        x = np.arange(first_column, last_column, dtype=np.float32)[None] + np.float32(0.5)
        y = np.arange(first_row, last_row, dtype=np.float32)[:, None] + np.float32(0.5)
        return (slice(first_row, last_row), slice(first_column, last_column)), (x, y)

    def _blend(self, rows: slice, columns: slice, covered: Floats, colour: Colour) -> None:
        pixels = self._pixels[rows, columns]
        pixels += covered[..., None] * (np.array(colour, dtype=np.float32) - pixels)
