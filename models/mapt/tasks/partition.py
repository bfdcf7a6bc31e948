"""Who moves and who sees what: a body's joints shared out among agents.

The conventions are gymnasium-robotics' MaMuJoCo's: an agent sees position and velocity of its own joints, then the
positions of joints one, two, ... edges away, each group in the order of the joints' names, then what every agent sees.
"""

from dataclasses import dataclass
from itertools import chain

import numpy as np
from numpy.typing import NDArray

from mapt.tasks.errors import InvalidTaskOption


@dataclass(frozen=True, slots=True)
class Joint:
    """A driven joint: where it stands in qpos, qvel and ctrl."""

    name: str
    qpos: int
    qvel: int
    actuator: int


@dataclass(frozen=True, slots=True)
class Partition:
    """The joints of a body, which of them are neighbours, and which agent drives which."""

    #: Every driven joint.
    joints: tuple[Joint, ...]
    #: Pairs of names of neighbouring joints.
    edges: tuple[tuple[str, str], ...]
    #: Names of the joints each agent drives, in the order of its action.
    agents: tuple[tuple[str, ...], ...]
    #: Indices into qpos and qvel that every agent sees.
    shared_qpos: tuple[int, ...]
    shared_qvel: tuple[int, ...]

    def joint(self, name: str) -> Joint:
        return next(joint for joint in self.joints if joint.name == name)

    def neighbourhoods(self, agent: int, depth: int) -> tuple[tuple[str, ...], ...]:
        """Names of joints at exactly 0, 1, ..., `depth` edges from the agent's own, each group sorted."""
        seen = set(self.agents[agent])
        groups = [tuple(sorted(seen))]
        for _ in range(depth):
            near = {name for edge in self.edges if set(edge) & set(groups[-1]) for name in edge} - seen
            seen |= near
            groups.append(tuple(sorted(near)))
        return tuple(groups)


def actuator_index(partition: Partition) -> NDArray[np.intp]:
    """(N, A): the actuator behind each number of each agent's action."""
    return np.array([[partition.joint(name).actuator for name in names] for names in partition.agents])


def observation_index(partition: Partition, agent_obsk: int, nq: int, nv: int) -> NDArray[np.intp]:
    """(N, C): where each number of each observation stands in the row (qpos, qvel, 0).

    An agent at the end of a limb has fewer neighbours. Its missing ones read the 0 at the end of the row, placed before
    the shared part, so that one column means the same for every agent.

    Args:
        agent_obsk: neighbours up to this many edges away are seen.

    Raises:
        InvalidTaskOption: if `agent_obsk` is negative.
    """
    if agent_obsk < 0:
        raise InvalidTaskOption(f"agent_obsk must be 0 or more, got {agent_obsk}.")
    local = [_local_index(partition, agent, agent_obsk, nq) for agent in range(len(partition.agents))]
    width = max(map(len, local))
    shared = [*partition.shared_qpos, *(nq + index for index in partition.shared_qvel)]
    return np.array([index + [nq + nv] * (width - len(index)) + shared for index in local])


def _local_index(partition: Partition, agent: int, agent_obsk: int, nq: int) -> list[int]:
    own, *near = partition.neighbourhoods(agent, agent_obsk)
    own_joints = [partition.joint(name) for name in own]
    near_joints = [partition.joint(name) for name in chain.from_iterable(near)]
    return [
        *(index for joint in own_joints for index in (joint.qpos, nq + joint.qvel)),
        *(joint.qpos for joint in near_joints),
    ]
