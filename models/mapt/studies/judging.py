"""Scripted teachers at work on a replay."""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from mapt.preferences.dataset import PreferenceDataset
from mapt.preferences.teachers import Evidence, ScriptedTeacher, make_teacher
from mapt.studies.errors import TooFewLabels
from mapt.studies.naming import Written
from mapt.studies.pairs import IntArray, training_pairs
from mapt.studies.replay import Replay

#: give up on a teacher that skips more than this many pairs for each it labels
_MOST_SKIPS_PER_LABEL = 20
#: a teacher looks at so many segments at once, so that memory does not grow with the labels
_SEGMENTS_AT_ONCE = 1000


class Judge:
    """A scripted teacher who looks at segments of one replay.

    Args:
        teacher: a name of `teacher_names`, or one with parameters: `phase+mistake:mistake=0.05`.
        seed: of what it does by chance.

    Raises:
        UnknownTeacher, InvalidTeacher: if there is none such.
    """

    def __init__(self, teacher: str, replay: Replay, seed: int) -> None:
        written = Written.parse(teacher)
        self.name = teacher
        self._teacher: ScriptedTeacher = make_teacher(written.name, seed=seed, **written.settings)
        self._replay = replay

    def parameters(self) -> Mapping[str, object]:
        """Everything that decides its labels, fit for JSON."""
        return self._teacher.parameters()

    def labels(self, pairs: IntArray) -> NDArray[np.float32]:
        """P(segment 0 preferred) of pairs (P, 2), (P,); NaN where it skips."""
        parts = np.array_split(pairs, max(1, 2 * len(pairs) // _SEGMENTS_AT_ONCE))
        sides = ((self._evidence(part[:, 0]), self._evidence(part[:, 1])) for part in parts)
        return np.concatenate([self._teacher.judge(first, second) for first, second in sides])

    def scores(self, indices: IntArray) -> NDArray[np.float64]:
        """What it judges these segments by, without mistakes or doubt, (S,)."""
        parts = np.array_split(indices, max(1, len(indices) // _SEGMENTS_AT_ONCE))
        return np.concatenate([self._teacher.scores(self._evidence(part)) for part in parts])

    def _evidence(self, indices: IntArray) -> Evidence:
        """These segments, as much of them as the teacher reads."""
        replay, reads = self._replay, self._teacher.rule.reads
        seen: dict[str, NDArray[np.floating]] = {}
        if {"observations", "actions"} & set(reads):
            segments = replay.segments(indices)
            seen = {"observations": segments.observations, "actions": segments.actions}
        for name, read in (("qpos", replay.source.qpos), ("qvel", replay.source.qvel)):
            if name in reads:
                seen[name] = read(indices)
        return Evidence(replay.rewards[indices], replay.mask[indices], **seen)


def labelled_dataset(judge: Judge, replay: Replay, n_labels: int, seed: int) -> PreferenceDataset:
    """Exactly `n_labels` labelled pairs of segments to learn from; those skipped are replaced by further ones.

    Raises:
        TooFewLabels: if the teacher skips nearly everything.
    """
    labels = np.empty(0, np.float32)
    pairs = np.empty((0, 2), np.int64)
    while (given := int(np.isfinite(labels).sum())) < n_labels:
        if len(labels) > _MOST_SKIPS_PER_LABEL * n_labels:
            raise TooFewLabels(judge.name, n_labels, given)
        more = training_pairs(len(replay), len(labels) + n_labels - given, seed)[len(labels) :]
        pairs, labels = np.concatenate((pairs, more)), np.concatenate((labels, judge.labels(more)))
    kept = np.flatnonzero(np.isfinite(labels))
    used, positions = np.unique(pairs[kept], return_inverse=True)
    return PreferenceDataset(replay.view(used), positions.reshape(-1, 2), labels[kept])
