"""What a scripted teacher gets to see of segments."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mapt.errors import InvalidMask, MissingView, NotFinite, ShapeError

FloatArray = NDArray[np.floating[Any]]
BoolArray = NDArray[np.bool_]
Float64s = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class TeacherView:
    """B segments of up to T steps, as their teacher sees them. Padding may hold any number.

    A learned reward sees observations and actions alone. A teacher may know more: the true reward, the simulator.

    Raises:
        ShapeError, InvalidMask: where the arrays disagree, or a segment's real steps do not come first.
        NotFinite: if a real step's reward is NaN or infinite.
    """

    #: float64 (B, T), true reward of each step
    rewards: Float64s
    #: bool (B, T), true where the step is real; all of them when not given
    mask: BoolArray = None  # pyright: ignore[reportAssignmentType]
    #: (B, T, N, C)
    observations: FloatArray | None = None
    #: (B, T, N, A), one-hot where actions are discrete
    actions: FloatArray | None = None
    #: (B, T, nq) and (B, T, nv), simulator states in which the actions were taken
    qpos: FloatArray | None = None
    qvel: FloatArray | None = None

    def __post_init__(self) -> None:
        rewards = np.asarray(self.rewards, dtype=np.float64)
        if rewards.ndim != 2 or rewards.shape[1] == 0:
            raise ShapeError("rewards", rewards.shape, "(B, T) with T >= 1")
        # None is a convenience of the constructor only: whoever reads the field finds an array.
        mask = np.ones(rewards.shape, np.bool_) if self.mask is None else np.asarray(self.mask, np.bool_)  # pyright: ignore[reportUnnecessaryComparison]
        object.__setattr__(self, "rewards", rewards)
        object.__setattr__(self, "mask", mask)
        if mask.shape != rewards.shape:
            raise ShapeError("mask", mask.shape, f"that of rewards, {rewards.shape}")
        broken = ~mask[:, 0] | (mask[:, 1:] & ~mask[:, :-1]).any(axis=1)
        if broken.any():
            raise InvalidMask(int(broken.argmax()))
        broken = (mask & ~np.isfinite(rewards)).any(axis=1)
        if broken.any():
            raise NotFinite("rewards", int(broken.argmax()))
        for name, n_axes in (("observations", 4), ("actions", 4), ("qpos", 3), ("qvel", 3)):
            array = getattr(self, name)
            if array is not None and (array.ndim != n_axes or array.shape[:2] != rewards.shape):
                raise ShapeError(name, array.shape, f"{n_axes} axes, the first two {rewards.shape}")

    @classmethod
    def stack(cls, segments: Sequence[Mapping[str, ArrayLike]]) -> "TeacherView":
        """Segments of any lengths, each as arrays by name: rewards (T_s,), and any of the other fields with T_s first.

        What not every segment has is left out; padding is zeros.

        Raises:
            ShapeError: if there is no segment, or arrays that belong together differ in shape.
            MissingView: if a segment has no rewards.
        """
        if not segments:
            raise ShapeError("segments", (0,), "at least one")
        if any("rewards" not in segment for segment in segments):
            raise MissingView("rewards")
        names = {field.name for field in fields(cls)} - {"mask"}
        for segment in segments:
            names &= segment.keys()
        lengths = np.array([len(np.asarray(segment["rewards"])) for segment in segments])
        n_steps = int(lengths.max())
        padded = {name: _pad(name, [np.asarray(segment[name]) for segment in segments], lengths) for name in names}
        return cls(mask=np.arange(n_steps) < lengths[:, None], **padded)

    def __len__(self) -> int:
        return len(self.rewards)

    @property
    def lengths(self) -> NDArray[np.int64]:
        """Real steps of each segment, (B,)."""
        return self.mask.sum(axis=1)

    def take(self, indices: ArrayLike) -> "TeacherView":
        """The segments at `indices`, in that order."""
        index = np.asarray(indices)
        arrays = ((field.name, getattr(self, field.name)) for field in fields(self))
        return TeacherView(**{name: array[index] for name, array in arrays if array is not None})

    def with_rewards(self, rewards: Float64s) -> "TeacherView":
        """The same segments with other rewards (B, T)."""
        return replace(self, rewards=rewards)

    def seen(self, name: str) -> FloatArray:
        """The array with this name.

        Raises:
            MissingView: if it was not given.
        """
        array = getattr(self, name)
        if array is None:
            raise MissingView(name)
        return array

    def columns(self, columns: Sequence[int], agents: Sequence[int] | None = None) -> Float64s:
        """These columns of what these agents, or all, observe: float64 (B, T, agents, columns); padding reads 0.

        Raises:
            MissingView: if there are no observations, or no such agent or column.
        """
        observations = self.seen("observations")
        n_agents, n_columns = observations.shape[2:]
        chosen = range(n_agents) if agents is None else agents
        for what, wanted, there in (("agent", chosen, n_agents), ("column", columns, n_columns)):
            if any(not 0 <= index < there for index in wanted):
                raise MissingView(f"{what} {max(wanted)} of {there} in observations")
        found = observations[:, :, list(chosen)][..., list(columns)].astype(np.float64)
        return np.where(self.mask[:, :, None, None], found, 0.0)


def _pad(name: str, parts: Sequence[NDArray[Any]], lengths: NDArray[np.int64]) -> NDArray[Any]:
    trailing = parts[0].shape[1:]
    for part, length in zip(parts, lengths, strict=True):
        if part.shape != (length, *trailing):
            raise ShapeError(name, part.shape, f"{(int(length), *trailing)}")
    padded = np.zeros((len(parts), int(lengths.max()), *trailing), dtype=parts[0].dtype)
    for row, part in zip(padded, parts, strict=True):
        row[: len(part)] = part
    return padded
