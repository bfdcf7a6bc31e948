"""A partition as indices: which numbers each agent sees, and which actuators it drives."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapt.tasks.partition import actuator_index, observation_index
from mapt.tasks.rules import MujocoRules
from mapt.tasks.scene import MujocoScene

#: Name of the one agent that sees the whole state and drives every joint.
WHOLE_TEAM = "whole team"


@dataclass(frozen=True, slots=True)
class Team:
    """N agents on one body."""

    #: (N, C): columns of the row, see `Layout`.
    observed: NDArray[np.intp]
    #: (N, A): actuators, -1 where an agent drives fewer than others.
    actuators: NDArray[np.intp]

    @classmethod
    def of(cls, scene: MujocoScene, rules: MujocoRules, agent_obsk: int | None) -> "Team":
        """The team that the scene's partition makes.

        Args:
            agent_obsk: neighbours up to this many edges away are seen. None is MaMuJoCo's single agent: it sees the
                state and drives every joint, in the order of ctrl.

        Raises:
            InvalidTaskOption: if `agent_obsk` is negative.
        """
        layout = rules.layout(scene.nq, scene.nv)
        actuators = actuator_index(scene.partition)
        if agent_obsk is None:
            return cls(np.array([layout.columns(rules.state)]), np.sort(actuators[actuators >= 0])[None])
        return cls(observation_index(scene.partition, agent_obsk, layout), actuators)

    @property
    def action_dims(self) -> tuple[int, ...]:
        """Numbers of each agent's action that drive something; those after them are ignored."""
        return tuple(int(driven) for driven in (self.actuators >= 0).sum(axis=1))

    def with_index(self, zero: int, one: int) -> NDArray[np.intp]:
        """(N, C + N): what is observed, then a one-hot index of the agent out of these two columns."""
        index = np.where(np.eye(len(self.observed), dtype=bool), one, zero)
        return np.concatenate([self.observed, index], axis=1)
