"""The view of segments that scripted teachers judge by: true rewards, observations, actions and simulator states."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mapt.errors import MissingArray, NotFinite, ShapeError
from mapt.preferences.dataset import BoolArray, check_mask, length_mask, pad

FloatArray = NDArray[np.floating[Any]]
Float64s = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class TeacherView:
    """B segments of up to T steps with their true rewards and, where known, simulator states.

    A reward model sees only observations and actions. Padding may hold any number.

    Raises:
        ShapeError: if the shapes of the arrays disagree.
        InvalidMask: if a row of the mask is not one or more ones followed by zeros.
        NotFinite: if a reward outside of the padding is NaN or infinite.
    """

    #: float64 (B, T), true reward of each step
    rewards: Float64s
    #: bool (B, T), false in the padding; no padding if None
    mask: BoolArray = None  # pyright: ignore[reportAssignmentType]
    #: (B, T, N, C)
    observations: FloatArray | None = None
    #: (B, T, N, A), one-hot where actions are discrete
    actions: FloatArray | None = None
    #: (B, T, nq) and (B, T, nv), simulator states before each action
    qpos: FloatArray | None = None
    qvel: FloatArray | None = None

    def __post_init__(self) -> None:
        rewards = np.asarray(self.rewards, dtype=np.float64)
        if rewards.ndim != 2 or rewards.shape[1] == 0:
            raise ShapeError("rewards", rewards.shape, "(B, T) with T >= 1")
        # None is only accepted by the constructor: the field always holds an array.
        mask = np.ones(rewards.shape, np.bool_) if self.mask is None else np.asarray(self.mask, np.bool_)  # pyright: ignore[reportUnnecessaryComparison]
        object.__setattr__(self, "rewards", rewards)
        object.__setattr__(self, "mask", mask)
        if mask.shape != rewards.shape:
            raise ShapeError("mask", mask.shape, f"that of rewards, {rewards.shape}")
        check_mask(mask)
        invalid = (mask & ~np.isfinite(rewards)).any(axis=1)
        if invalid.any():
            raise NotFinite("rewards", int(invalid.argmax()))
        for name, n_axes in (("observations", 4), ("actions", 4), ("qpos", 3), ("qvel", 3)):
            array = getattr(self, name)
            if array is not None and (array.ndim != n_axes or array.shape[:2] != rewards.shape):
                raise ShapeError(name, array.shape, f"{n_axes} axes, the first two {rewards.shape}")

    @classmethod
    def stack(cls, segments: Sequence[Mapping[str, ArrayLike]]) -> "TeacherView":
        """Pad segments of different lengths with zeros to the longest. Fields that a segment lacks are left out.

        Args:
            segments: of each, the arrays by field name, (T_s, ...). `rewards` (T_s,) is required.

        Raises:
            ShapeError: if there is no segment, or the shapes of its arrays disagree.
            MissingArray: if a segment has no rewards.
        """
        if not segments:
            raise ShapeError("segments", (0,), "at least one")
        if any("rewards" not in segment for segment in segments):
            raise MissingArray("rewards")
        names = {field.name for field in fields(cls)} - {"mask"}
        for segment in segments:
            names &= segment.keys()
        padded = {name: pad(name, [np.asarray(segment[name]) for segment in segments]) for name in names}
        lengths = padded["rewards"][1]
        for name, (array, n_steps) in padded.items():
            if (n_steps != lengths).any():
                raise ShapeError(name, array.shape, f"the steps of rewards, {lengths}")
        return cls(mask=length_mask(lengths), **{name: array for name, (array, _) in padded.items()})

    def __len__(self) -> int:
        return len(self.rewards)

    @property
    def lengths(self) -> NDArray[np.int64]:
        """Steps of each segment without padding, (B,)."""
        return self.mask.sum(axis=1)

    def take(self, indices: ArrayLike) -> "TeacherView":
        """The segments at `indices`, in that order."""
        index = np.asarray(indices)
        arrays = ((field.name, getattr(self, field.name)) for field in fields(self))
        return TeacherView(**{name: array[index] for name, array in arrays if array is not None})

    def with_rewards(self, rewards: Float64s) -> "TeacherView":
        """A copy with other rewards (B, T)."""
        return replace(self, rewards=rewards)

    def require(self, name: str) -> FloatArray:
        """The array of the field `name`.

        Raises:
            MissingArray: if it was not given.
        """
        array = getattr(self, name)
        if array is None:
            raise MissingArray(name)
        return array

    def columns(self, columns: Sequence[int], agents: Sequence[int] | None = None) -> Float64s:
        """Columns of the observations of some agents, or of all: float64 (B, T, agents, columns), 0 in the padding.

        Raises:
            MissingArray: if there are no observations, or no such agent or column.
        """
        observations = self.require("observations")
        n_agents, n_columns = observations.shape[2:]
        chosen = range(n_agents) if agents is None else agents
        for what, wanted, size in (("agent", chosen, n_agents), ("column", columns, n_columns)):
            if any(not 0 <= index < size for index in wanted):
                raise MissingArray(f"{what} {max(wanted)} of {size} in observations")
        values = observations[:, :, list(chosen)][..., list(columns)].astype(np.float64)
        return np.where(self.mask[:, :, None, None], values, 0.0)
