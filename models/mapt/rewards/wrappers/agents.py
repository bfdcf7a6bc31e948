"""What the agents of an environment see and do, as the arrays a reward model reads."""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mapt.rewards.config import RewardConfig
from mapt.rewards.errors import InvalidRollout


def observation_rows(
    values: object, names: Sequence[str], config: RewardConfig, *, indexed: bool
) -> NDArray[np.float32]:
    """Observations of all agents, float32 (..., N, C).

    Args:
        values: as an environment gives them: one array (..., N, C), or one (..., C) for each agent, in a tuple in
            their order or by their `names`.
        indexed: append a one-hot of which agent it is, for a model that was trained on such observations.

    Raises:
        InvalidRollout: if an agent is missing, or the shapes differ between agents or do not fit the model.
    """
    rows = _stacked("observations", values, names, axis=-2)
    if indexed:
        index = np.broadcast_to(np.eye(rows.shape[-2], dtype=np.float32), (*rows.shape[:-1], rows.shape[-2]))
        rows = np.concatenate((rows, index), axis=-1)
    return _fitting("observations", rows, config.n_agents, config.observation_dim)


def action_rows(values: object, names: Sequence[str], config: RewardConfig) -> NDArray[np.float32]:
    """Actions of all agents, float32 (..., N, A); `values` as observations, or (..., N) numbers of discrete actions.

    Raises:
        InvalidRollout: if an agent is missing, or the shapes differ between agents or do not fit the model.
    """
    if not config.discrete_actions:
        return _fitting("actions", _stacked("actions", values, names, axis=-2), config.n_agents, config.action_dim)
    numbers = _stacked("actions", values, names, axis=-1)
    known = np.arange(config.action_dim)
    if not np.isin(numbers, known).all():
        raise InvalidRollout(f"an action is not a whole number from 0 to {config.action_dim - 1}")
    one_hot = (numbers[..., None] == known).astype(np.float32)
    return _fitting("actions", one_hot, config.n_agents, config.action_dim)


def _stacked(what: str, values: object, names: Sequence[str], axis: int) -> NDArray[np.float32]:
    if isinstance(values, Mapping):
        if missing := [name for name in names if name not in values]:
            raise InvalidRollout(f"{what} of {missing[0]} are missing: every agent must act in every step")
        values = tuple(values[name] for name in names)
    if not isinstance(values, tuple):
        return _array(what, values)
    arrays = [_array(what, value) for value in values]
    if len({array.shape for array in arrays}) != 1:
        raise InvalidRollout(f"{what} differ in shape between agents: {[array.shape for array in arrays]}")
    return np.stack(arrays, axis=axis)


def _array(what: str, values: object) -> NDArray[np.float32]:
    taken: ArrayLike = values  # pyright: ignore[reportAssignmentType]
    try:
        return np.asarray(taken, dtype=np.float32)
    except (TypeError, ValueError) as error:
        raise InvalidRollout(f"{what} are no numbers: {type(values).__name__}") from error


def _fitting(what: str, rows: NDArray[np.float32], n_agents: int, width: int) -> NDArray[np.float32]:
    if rows.shape[-2:] != (n_agents, width):
        raise InvalidRollout(f"{what} of a step have shape {rows.shape[-2:]}, expected {(n_agents, width)}")
    return rows
