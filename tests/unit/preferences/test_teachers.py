import numpy as np
import pytest

from mapt.preferences.errors import ShapeError
from mapt.preferences.teachers import OracleTeacher


def test_oracle_prefers_the_larger_return():
    labels = OracleTeacher().judge([[1.0, 5.0], [0.0, 0.0], [2.0, 1.0]], [[3.0, 1.0], [1.0, 0.0], [1.0, 2.0]])
    assert labels.tolist() == [1.0, 0.0, 0.5]
    assert labels.dtype == np.float32


def test_oracle_counts_real_steps_alone():
    labels = OracleTeacher().judge([[1.0, 99.0]], [[1.0, 1.0]], mask_0=[[True, False]], mask_1=[[True, True]])
    assert labels.tolist() == [0.0]


def test_segments_may_differ_in_length():
    assert OracleTeacher().judge([[1.0, 1.0, 1.0]], [[2.0]]).tolist() == [1.0]


@pytest.mark.parametrize(
    ("rewards_0", "rewards_1", "mask_0"),
    [([1.0], [[1.0]], None), ([[1.0]], [[1.0], [2.0]], None), ([[1.0]], [[1.0]], [[True, True]])],
)
def test_shapes_that_disagree_are_refused_by_the_oracle(rewards_0, rewards_1, mask_0):
    with pytest.raises(ShapeError):
        OracleTeacher().judge(rewards_0, rewards_1, mask_0)
