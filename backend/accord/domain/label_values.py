"""The values of a label, P(segment 0 is preferred), and which side a value prefers."""

from collections.abc import Mapping

#: by the experiment's answer scale; 0.75 and 0.25 mean that a segment is slightly better
LABEL_VALUES: Mapping[str, tuple[float, ...]] = {"three": (0.0, 0.5, 1.0), "five": (0.0, 0.25, 0.5, 0.75, 1.0)}
#: values of `side_of`
SIDES: tuple[float, ...] = LABEL_VALUES["three"]


def side_of(value: float) -> float:
    """The label without its degree: 1 if segment 0 is preferred, 0 if segment 1 is, 0.5 if neither."""
    return 1.0 if value > 0.5 else 0.0 if value < 0.5 else 0.5
