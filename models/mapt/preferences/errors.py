"""What can be wrong with preferences.

PreferenceError
├── ShapeError
├── NotFinite
├── InvalidMask
├── InvalidLabel
├── InvalidPair
└── NotEnoughPairs
"""


class PreferenceError(ValueError):
    """Segments, pairs or labels cannot be used as given."""


class ShapeError(PreferenceError):
    """An array has another shape than its place asks for."""

    def __init__(self, name: str, shape: tuple[int, ...], expected: str) -> None:
        super().__init__(f"{name} has shape {shape}, expected {expected}")


class NotFinite(PreferenceError):
    """An array holds NaN or infinity where the step is real."""

    def __init__(self, name: str, segment: int) -> None:
        super().__init__(f"{name} of segment {segment} holds NaN or infinity")


class InvalidMask(PreferenceError):
    """A segment's real steps are not one unbroken run from its first step."""

    def __init__(self, segment: int) -> None:
        super().__init__(f"segment {segment} must have its real steps first, at least one, then padding")


class InvalidLabel(PreferenceError):
    """A label is no probability that segment 0 is preferred."""

    def __init__(self, index: int, label: float) -> None:
        super().__init__(f"label {index} is {label}; it must lie in [0, 1] (1: segment 0 is better)")


class InvalidPair(PreferenceError):
    """A pair names a segment that is not there, or the same one twice."""

    def __init__(self, index: int, pair: tuple[int, int], n_segments: int) -> None:
        super().__init__(f"pair {index} is {pair}; it must name two different segments of {n_segments}")


class NotEnoughPairs(PreferenceError):
    """Fewer pairs than the task needs."""

    def __init__(self, n_pairs: int, needed: int) -> None:
        super().__init__(f"{n_pairs} labelled pairs, at least {needed} are needed")
