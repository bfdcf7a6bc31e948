"""Where segments lie among each other, without a trained model."""

import numpy as np
from numpy.typing import NDArray

from mapt.preferences.dataset import SegmentArrays


def segment_features(segments: SegmentArrays) -> NDArray[np.float32]:
    """Mean and deviation over a segment's real steps of everything its agents see and do: (S, 2 * N * (C + A)).

    B-Pref compares whole flattened segments, by which a gait and the same gait half a stride later are strangers. These
    say where a team is and how much it moves, whatever the phase, with 1/T of the numbers.
    """
    steps = np.concatenate((segments.observations, segments.actions), axis=3)
    steps = steps.reshape(*steps.shape[:2], -1)
    weights = segments.mask / segments.mask.sum(axis=1, keepdims=True)
    mean = np.einsum("st,stf->sf", weights, steps)
    variance = np.einsum("st,stf->sf", weights, (steps - mean[:, None]) ** 2)
    return np.concatenate((mean, np.sqrt(variance)), axis=1).astype(np.float32)
