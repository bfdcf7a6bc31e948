"""Tolerances that follow the precision and the size of the compared numbers."""

import numpy as np
from numpy.typing import ArrayLike

#: Two orders of float32 operations differ by a few times 1e-7 of the largest term, and a deep network multiplies that.
#: This is a hundred times more, and far below the effect of any error in an algorithm.
FLOAT32_RELATIVE = 1e-4


def assert_float32_close(
    found: ArrayLike, expected: ArrayLike, *, relative: float = FLOAT32_RELATIVE, terms: ArrayLike = 0.0
) -> None:
    """Assert that two float32 computations of the same numbers agree on any processor.

    The tolerance is `relative` times the largest absolute value among the expected ones and `terms`, for every element:
    a small element can be the difference of large terms.

    Args:
        terms: what the numbers are sums of, where all sums may happen to be small.
    """
    found, expected, terms = np.asarray(found), np.asarray(expected), np.asarray(terms)
    scale = float(max(np.abs(expected).max(initial=0.0), np.abs(terms).max(initial=0.0)))
    np.testing.assert_allclose(found, expected, rtol=0, atol=relative * scale)
