"""What is known of the segments that a query may be about: each read and scored once, kept between two choices."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from accord.services.collect import load_arrays
from accord.store.blobs import BlobStore
from mapt.preferences.dataset import SegmentArrays
from mapt.preferences.selection import segment_features
from mapt.rewards.members import RewardEnsemble

#: segments read at once
_CHUNK = 64

_Vector = NDArray[np.float32]


class Scout:
    """Looks into the segments of one experiment."""

    def __init__(self, blobs: BlobStore) -> None:
        self._blobs = blobs
        #: by blob key, (F,); a segment never changes
        self._features: dict[str, _Vector] = {}
        #: of which version's ensemble the scores are
        self._version_id = ""
        #: by blob key, (M,)
        self._scores: dict[str, _Vector] = {}

    def scores(
        self, version_id: str, ensemble: RewardEnsemble, keys: Sequence[str], device: str
    ) -> NDArray[np.float32]:
        """Score of each segment by each member, (M, S); computed once for a version's ensemble.

        Raises:
            BlobMissing: if a segment's arrays are gone.
        """
        if version_id != self._version_id:
            self._version_id, self._scores = version_id, {}
        for chunk in self._new(keys, self._scores):
            self._scores.update(zip(chunk, ensemble.scores(self._read(chunk), device).T, strict=True))
        return np.stack([self._scores[key] for key in keys], axis=1)

    def features(self, keys: Sequence[str]) -> NDArray[np.float32]:
        """`segment_features` of each segment, (S, F).

        Raises:
            BlobMissing: if a segment's arrays are gone.
        """
        for chunk in self._new(keys, self._features):
            self._features.update(zip(chunk, segment_features(self._read(chunk)), strict=True))
        return np.stack([self._features[key] for key in keys])

    def _new(self, keys: Sequence[str], known: dict[str, _Vector]) -> list[list[str]]:
        new = [key for key in dict.fromkeys(keys) if key not in known]
        return [new[start : start + _CHUNK] for start in range(0, len(new), _CHUNK)]

    def _read(self, keys: Sequence[str]) -> SegmentArrays:
        arrays = [load_arrays(self._blobs, key) for key in keys]
        return SegmentArrays.stack([each["observations"] for each in arrays], [each["actions"] for each in arrays])
