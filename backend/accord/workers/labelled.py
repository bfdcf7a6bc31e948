"""The labelled segments of an experiment as one data set, read from the blobs once."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from accord.services.collect import load_arrays
from accord.services.publish import TrainingLabel
from accord.store.blobs import BlobStore
from mapt.preferences.dataset import PreferenceDataset, SegmentArrays

_Arrays = tuple[NDArray[np.float32], NDArray[np.float32]]


class LabelledSegments:
    """Keeps the arrays of one experiment in memory between two trainings: 20 kB a segment, two segments a label."""

    def __init__(self, blobs: BlobStore) -> None:
        self._blobs = blobs
        self._experiment_id = ""
        #: blob key -> observations (T, N, C) and actions (T, N, A)
        self._arrays: dict[str, _Arrays] = {}

    def dataset(self, experiment_id: str, labels: Sequence[TrainingLabel]) -> PreferenceDataset:
        """The labels with their segments, each segment once, in the order of its first label.

        Raises:
            BlobMissing: if a segment's arrays are gone.
        """
        if experiment_id != self._experiment_id:
            self._experiment_id, self._arrays = experiment_id, {}
        keys = [key for label in labels for key in (label.segment_0_blob, label.segment_1_blob)]
        place = {key: index for index, key in enumerate(dict.fromkeys(keys))}
        arrays = [self._read(key) for key in place]
        segments = SegmentArrays.stack([each[0] for each in arrays], [each[1] for each in arrays])
        pairs = np.array([place[key] for key in keys]).reshape(-1, 2)
        return PreferenceDataset(segments, pairs, np.array([label.value for label in labels], dtype=np.float32))

    def _read(self, key: str) -> _Arrays:
        if key not in self._arrays:
            arrays = load_arrays(self._blobs, key)
            self._arrays[key] = arrays["observations"].astype(np.float32), arrays["actions"].astype(np.float32)
        return self._arrays[key]
