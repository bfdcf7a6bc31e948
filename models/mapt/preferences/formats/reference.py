"""The pickle that the MAPT reference trains on: a list of {"traj0", "traj1", "label"}.

Each trajectory has "obs" (T, N, C) and "actions" (T, N, A), or (T, N, 1) with the action's number where actions are
discrete. The label is 1 where trajectory 0 is better, -1 where trajectory 1 is, and anything else where they are
equal; the reference writes 0. Skipped pairs have no place in it.

Source: https://github.com/catezi/MAPT, mat/algorithms/reward_model/utils/dataloader.py.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapt.errors import InvalidFile, MissingPart, NotRepresentable, UnknownLabel
from mapt.preferences.dataset import FloatArray, PreferenceDataset, SegmentArrays
from mapt.preferences.formats.arrays import finite_floats, numbered_actions
from mapt.preferences.formats.pickle_writer import write_pickle
from mapt.preferences.formats.pickles import MAX_BYTES, load_pickle
from mapt.preferences.formats.records import Comparisons, SegmentRecords
from mapt.preferences.segments import action_indices

_LABELS = {1: 1.0, -1: 0.0, 0: 0.5}
_KNOWN = "1 (first better), -1 (second better) and 0 (equal)"


def read_reference(
    path: Path | str, *, n_actions: int | None = None, other_labels_are_equal: bool = False, max_bytes: int = MAX_BYTES
) -> Comparisons:
    """
    Args:
        n_actions: of a task with discrete actions: their numbers become one-hot.
        other_labels_are_equal: take a label that is none of 1, -1 and 0 for "equal", as the reference itself does.
            It also takes 2, 0.7 or a label of the wrong polarity so; therefore it has to be asked for.

    Raises:
        InvalidFile: with the first pair that is not of this format; see also `load_pickle`.
        UnknownLabel: for a label other than 1, -1 and 0.
        ShapeError, NotFinite: if the trajectories differ in dimensions, or hold NaN.
    """
    path = Path(path)
    items = load_pickle(path, max_bytes=max_bytes)
    if not isinstance(items, list) or not items:
        raise InvalidFile(path, "is not a list of pairs, as the MAPT reference writes")
    sides: list[tuple[list[FloatArray], list[FloatArray]]] = [([], []), ([], [])]
    labels: list[float] = []
    for index, item in enumerate(items):
        labels.append(_label(path, index, _entry(path, index, item, "label"), other_labels_are_equal))
        for (observations, actions), name in zip(sides, ("traj0", "traj1"), strict=True):
            trajectory = _entry(path, index, item, name)
            where = f"{name} of pair {index}"
            observations.append(finite_floats(path, where, _entry(path, index, trajectory, "obs"), 3))
            acted = _entry(path, index, trajectory, "actions")
            actions.append(
                finite_floats(path, where, acted, 3)
                if n_actions is None
                else numbered_actions(path, where, acted, n_actions)
            )
    first, second = (SegmentRecords(SegmentArrays.stack(*side)) for side in sides)
    return Comparisons.of_pairs(first, second, labels)


def write_reference(path: Path | str, dataset: PreferenceDataset, *, discrete: bool = False) -> None:
    """Write labelled pairs for the reference to train on, in the memory of one pair.

    Args:
        discrete: actions are one-hot; they are written as their numbers, (T, N, 1).

    Raises:
        AlreadyExists: if there is a file.
        NotOneHot: if discrete actions are not one-hot.
        NotRepresentable: if a label is not 1, 0 or 0.5, or the segments differ in length.
    """
    write_pickle(Path(path), _items(Path(path), dataset, discrete))


def _items(path: Path, dataset: PreferenceDataset, discrete: bool) -> Iterator[dict[str, Any]]:
    words = {ours: theirs for theirs, ours in _LABELS.items()}
    for pair, label in zip(dataset.pairs, dataset.labels.tolist(), strict=True):
        if label not in words:
            raise NotRepresentable(path, f"a label of {label} has no place in this format, only 1, 0 and 0.5")
        segments = dataset.segments.take(pair)
        if not segments.mask.all():
            # The reference cuts each trajectory to the length of the last: shorter ones would crash it.
            raise NotRepresentable(path, "segments of unequal length have no place in this format")
        actions: NDArray[Any] = action_indices(segments)[..., None] if discrete else segments.actions
        first, second = (
            {"obs": observed, "actions": acted} for observed, acted in zip(segments.observations, actions, strict=True)
        )
        yield {"traj0": first, "traj1": second, "label": words[label]}


def _entry(path: Path, index: int, item: object, name: str) -> Any:
    if not isinstance(item, dict):
        raise InvalidFile(path, f"pair {index} is {type(item).__name__}, not a dict")
    if name not in item:
        raise MissingPart(path, f"{name!r} in pair {index}")
    return item[name]


def _label(path: Path, index: int, label: object, other_is_equal: bool) -> float:
    if isinstance(label, np.ndarray) and label.size == 1:
        label = label.reshape(())[()]
    if not isinstance(label, int | float | np.number) or np.isnan(label):
        raise UnknownLabel(path, index, label, _KNOWN)
    known = _LABELS.get(float(label))  # pyright: ignore[reportArgumentType]
    if known is None and not other_is_equal:
        raise UnknownLabel(path, index, label, _KNOWN)
    return 0.5 if known is None else known
