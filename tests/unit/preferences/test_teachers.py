import numpy as np
import pytest

from mapt.preferences.errors import ShapeError
from mapt.preferences.teachers import Evidence, OracleTeacher


def evidence(rewards, mask=None):
    return Evidence(np.array(rewards, dtype=np.float64), None if mask is None else np.array(mask))


def test_oracle_prefers_the_larger_return():
    first, second = evidence([[1.0, 5.0], [0.0, 0.0], [2.0, 1.0]]), evidence([[3.0, 1.0], [1.0, 0.0], [1.0, 2.0]])
    labels = OracleTeacher().judge(first, second)
    assert labels.tolist() == [1.0, 0.0, 0.5]
    assert labels.dtype == np.float32


def test_oracle_counts_real_steps_alone():
    labels = OracleTeacher().judge(evidence([[1.0, 99.0]], [[True, False]]), evidence([[1.0, 1.0]]))
    assert labels.tolist() == [0.0]


def test_segments_may_differ_in_length():
    assert OracleTeacher().judge(evidence([[1.0, 1.0, 1.0]]), evidence([[2.0]])).tolist() == [1.0]


def test_sides_of_different_numbers_of_segments_are_refused():
    with pytest.raises(ShapeError):
        OracleTeacher().judge(evidence([[1.0]]), evidence([[1.0], [2.0]]))
