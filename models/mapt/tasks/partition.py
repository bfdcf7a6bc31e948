"""The partition of a robot among agents: which joints each agent drives, and which features it observes.

The conventions are those of gymnasium-robotics' MaMuJoCo. An agent observes all features of its own joints, then fewer
of the joints one, two, ... edges away, each group ordered by the joints' labels, then the features that all agents
share. A `FeatureColumn` names one observed number: a feature (`qpos`, `qvel`, a field of MjData or a computed feature)
and an index into it.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from itertools import accumulate, chain, pairwise
from math import prod

import numpy as np
from numpy.typing import NDArray

from mapt.errors import InvalidConfig

#: A feature's name and an index into it, in C order.
FeatureColumn = tuple[str, int]
#: Shapes of features in one environment, by name.
Shapes = Mapping[str, tuple[int, ...]]


def columns(feature: str, start: int, stop: int) -> tuple[FeatureColumn, ...]:
    """The columns start to stop - 1 of a feature."""
    return tuple((feature, index) for index in range(start, stop))


@dataclass(frozen=True, slots=True)
class FeatureLayout:
    """The position of every feature in one row per environment. The last column is a 0, which pads observations."""

    shapes: Shapes

    @property
    def slices(self) -> dict[str, slice]:
        """The columns of each feature."""
        bounds = pairwise(accumulate(map(prod, self.shapes.values()), initial=0))
        return {name: slice(*bound) for name, bound in zip(self.shapes, bounds, strict=True)}

    @property
    def zero(self) -> int:
        """The column of the 0."""
        return sum(map(prod, self.shapes.values()))

    @property
    def width(self) -> int:
        return self.zero + 1

    def columns(self, wanted: Iterable[FeatureColumn]) -> list[int]:
        """The row's indices of these columns."""
        slices = self.slices
        return [slices[feature].start + index for feature, index in wanted]

    def views(self, row: NDArray[np.float64]) -> dict[str, NDArray[np.float64]]:
        """Views (E, ...) of each feature in rows (E, width)."""
        return {name: row[:, part].reshape(-1, *self.shapes[name]) for name, part in self.slices.items()}


def as_slice(index: NDArray[np.intp]) -> NDArray[np.intp] | slice:
    """The index as a slice if it is contiguous, which numpy reads several times faster."""
    first, last = int(index[0]), int(index[-1])
    if np.array_equal(index, np.arange(first, last + 1)):
        return slice(first, last + 1)
    return index


@dataclass(frozen=True, slots=True)
class Joint:
    """A driven joint: its actuator, and the features that its agent and that neighbouring agents observe."""

    #: Name of the joint in the model.
    name: str
    #: Index in ctrl.
    actuator: int
    #: Observed by the agent that drives the joint.
    own: tuple[FeatureColumn, ...]
    #: Observed by agents that drive a neighbouring joint.
    near: tuple[FeatureColumn, ...]
    #: Sort key of the joint in observations; the name if empty.
    label: str = ""

    @property
    def order(self) -> tuple[str, int]:
        return self.label or self.name, self.actuator


def hinge(name: str, qpos: int, qvel: int, actuator: int) -> Joint:
    """A joint of which its agent observes angle and speed, and neighbours the angle."""
    return Joint(name, actuator, own=(("qpos", qpos), ("qvel", qvel)), near=(("qpos", qpos),))


@dataclass(frozen=True, slots=True)
class Partition:
    """The joints of a robot, their neighbourhood graph, and the agent that drives each."""

    #: All joints that are driven or observed.
    joints: tuple[Joint, ...]
    #: Hyperedges of the graph: names of joints that are all neighbours of each other.
    edges: tuple[tuple[str, ...], ...]
    #: Names of the joints that each agent drives, in the order of its action.
    agents: tuple[tuple[str, ...], ...]
    #: Observed by all agents.
    shared: tuple[FeatureColumn, ...]
    #: Features of bodies rather than joints: an agent observes each column once, even if several of its joints have it.
    seen_once: frozenset[str] = frozenset()

    def joint(self, name: str) -> Joint:
        return next(joint for joint in self.joints if joint.name == name)

    def neighbourhoods(self, agent: int, depth: int) -> tuple[tuple[str, ...], ...]:
        """Names of the joints exactly 0, 1, ..., `depth` edges from the agent's own, each group sorted."""
        seen = set(self.agents[agent])
        groups = [self._ordered(seen)]
        for _ in range(depth):
            near = {name for edge in self.edges if set(edge) & set(groups[-1]) for name in edge} - seen
            seen |= near
            groups.append(self._ordered(near))
        return tuple(groups)

    def _ordered(self, names: Iterable[str]) -> tuple[str, ...]:
        return tuple(sorted(names, key=lambda name: self.joint(name).order))


def actuator_index(partition: Partition) -> NDArray[np.intp]:
    """(N, A): the actuator of each entry of each agent's action; -1 pads the actions of agents with fewer joints."""
    driven = [[partition.joint(name).actuator for name in names] for names in partition.agents]
    width = max(map(len, driven))
    return np.array([actuators + [-1] * (width - len(actuators)) for actuators in driven])


def observation_index(partition: Partition, agent_obsk: int, layout: FeatureLayout) -> NDArray[np.intp]:
    """(N, C): the column of the row behind each entry of each observation.

    Agents with fewer neighbours are padded with the layout's 0 before the shared part, so that an entry means the same
    for every agent.

    Args:
        agent_obsk: observe joints up to this many edges away.

    Raises:
        InvalidConfig: if `agent_obsk` is negative.
    """
    if agent_obsk < 0:
        raise InvalidConfig(f"agent_obsk must be 0 or more, got {agent_obsk}.", "agent_obsk")
    local = [layout.columns(_local_columns(partition, agent, agent_obsk)) for agent in range(len(partition.agents))]
    width = max(map(len, local))
    shared = layout.columns(partition.shared)
    return np.array([index + [layout.zero] * (width - len(index)) + shared for index in local])


def _local_columns(partition: Partition, agent: int, agent_obsk: int) -> list[FeatureColumn]:
    own, *near = partition.neighbourhoods(agent, agent_obsk)
    observed: list[FeatureColumn] = []
    for column in chain.from_iterable(partition.joint(name).own for name in own):
        if column[0] not in partition.seen_once or column not in observed:
            observed.append(column)
    observed.extend(chain.from_iterable(partition.joint(name).near for name in chain.from_iterable(near)))
    return observed
