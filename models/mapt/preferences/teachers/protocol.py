"""The seam between teachers and everyone who asks them."""

from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from mapt.preferences.teachers.evidence import Evidence


class Teacher(Protocol):
    """Judges pairs of segments."""

    def judge(self, first: Evidence, second: Evidence) -> NDArray[np.float32]:
        """Label B pairs.

        Args:
            first, second: segments 0 and segments 1, B each; the two sides may differ in T.

        Returns:
            float32 (B,): P(segment 0 preferred); NaN where the teacher skips the pair.

        Raises:
            ShapeError: if the sides hold different numbers of segments.
            MissingEvidence: if they lack what this teacher judges by.
        """
        ...

    def parameters(self) -> dict[str, Any]:
        """Its name and every parameter, fit for JSON: what a label's record says of its teacher."""
        ...
