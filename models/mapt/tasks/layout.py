"""Where everything that can be observed stands in one row of numbers per environment."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from itertools import accumulate, pairwise
from math import prod

import numpy as np
from numpy.typing import NDArray

#: A feature's name and a place in it, counted through its shape in C order.
Column = tuple[str, int]
#: A feature's shape for one environment, by name.
Shapes = Mapping[str, tuple[int, ...]]


def columns(feature: str, start: int, stop: int) -> tuple[Column, ...]:
    """Places start to stop - 1 of a feature."""
    return tuple((feature, index) for index in range(start, stop))


@dataclass(frozen=True, slots=True)
class Layout:
    """Features one after the other, and last a 0 that stands for whatever an agent lacks."""

    shapes: Shapes

    @property
    def slices(self) -> dict[str, slice]:
        """The columns of each feature."""
        bounds = pairwise(accumulate(map(prod, self.shapes.values()), initial=0))
        return {name: slice(*bound) for name, bound in zip(self.shapes, bounds, strict=True)}

    @property
    def zero(self) -> int:
        """The column of the 0."""
        return sum(map(prod, self.shapes.values()))

    @property
    def width(self) -> int:
        return self.zero + 1

    def columns(self, wanted: Iterable[Column]) -> list[int]:
        slices = self.slices
        return [slices[feature].start + index for feature, index in wanted]

    def views(self, row: NDArray[np.float64]) -> dict[str, NDArray[np.float64]]:
        """Each feature of rows (E, width) in its own shape, (E, ...), sharing their memory."""
        return {name: row[:, place].reshape(-1, *self.shapes[name]) for name, place in self.slices.items()}


def as_slice(index: NDArray[np.intp]) -> NDArray[np.intp] | slice:
    """The index as a slice where it is an unbroken run, which numpy reads several times faster."""
    first, last = int(index[0]), int(index[-1])
    if np.array_equal(index, np.arange(first, last + 1)):
        return slice(first, last + 1)
    return index
