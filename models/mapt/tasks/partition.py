"""Who moves and who sees what: a body's joints shared out among agents.

The conventions are gymnasium-robotics' MaMuJoCo's: an agent sees everything of its own joints, then less of the joints
one, two, ... edges away, each group in the order of the joints' labels, then what every agent sees. A number is named
by its feature (`qpos`, `qvel`, a field of MjData, or what the task's mdp compute) and its place in it.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from itertools import accumulate, chain, pairwise
from math import prod

import numpy as np
from numpy.typing import NDArray

from mapt.errors import InvalidConfig

#: A feature's name and a place in it, counted through its shape in C order.
FeatureColumn = tuple[str, int]
#: A feature's shape for one environment, by name.
Shapes = Mapping[str, tuple[int, ...]]


def columns(feature: str, start: int, stop: int) -> tuple[FeatureColumn, ...]:
    """Places start to stop - 1 of a feature."""
    return tuple((feature, index) for index in range(start, stop))


@dataclass(frozen=True, slots=True)
class FeatureLayout:
    """Features one after the other, and last a 0 that stands for whatever an agent lacks."""

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
        slices = self.slices
        return [slices[feature].start + index for feature, index in wanted]

    def views(self, row: NDArray[np.float64]) -> dict[str, NDArray[np.float64]]:
        """Each feature of rows (E, width) in its own shape, (E, ...), sharing their memory."""
        return {name: row[:, place].reshape(-1, *self.shapes[name]) for name, place in self.slices.items()}


def as_slice(index: NDArray[np.intp]) -> NDArray[np.intp] | slice:
    """The index as a slice where it is an unbroken run, which numpy reads several times faster."""
    first, last = int(index[0]), int(index[-1])
    if np.array_equal(index, np.arange(first, last + 1)):
        return slice(first, last + 1)
    return index


@dataclass(frozen=True, slots=True)
class Joint:
    """A driven joint: what it shows to its agent and to others, and its actuator."""

    #: Name of the joint in the model.
    name: str
    #: Index in ctrl.
    actuator: int
    #: What the agent that drives it sees.
    own: tuple[FeatureColumn, ...]
    #: What an agent sees that only neighbours it.
    near: tuple[FeatureColumn, ...]
    #: By which joints are ordered in an observation; the name where it is empty.
    label: str = ""

    @property
    def order(self) -> tuple[str, int]:
        return self.label or self.name, self.actuator


def hinge(name: str, qpos: int, qvel: int, actuator: int) -> Joint:
    """A joint that shows its angle and speed to its agent, and its angle to others."""
    return Joint(name, actuator, own=(("qpos", qpos), ("qvel", qvel)), near=(("qpos", qpos),))


@dataclass(frozen=True, slots=True)
class Partition:
    """The joints of a body, which of them are neighbours, and which agent drives which."""

    #: Every joint that is driven or seen.
    joints: tuple[Joint, ...]
    #: Names of joints that are all neighbours of each other.
    edges: tuple[tuple[str, ...], ...]
    #: Names of the joints each agent drives, in the order of its action.
    agents: tuple[tuple[str, ...], ...]
    #: What every agent sees.
    shared: tuple[FeatureColumn, ...]
    #: Features about bodies rather than joints: an agent sees a number of these once, though several joints show it.
    seen_once: frozenset[str] = frozenset()

    def joint(self, name: str) -> Joint:
        return next(joint for joint in self.joints if joint.name == name)

    def neighbourhoods(self, agent: int, depth: int) -> tuple[tuple[str, ...], ...]:
        """Names of joints at exactly 0, 1, ..., `depth` edges from the agent's own, each group in order."""
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
    """(N, A): the actuator behind each number of each agent's action, -1 where an agent drives fewer than others."""
    driven = [[partition.joint(name).actuator for name in names] for names in partition.agents]
    width = max(map(len, driven))
    return np.array([actuators + [-1] * (width - len(actuators)) for actuators in driven])


def observation_index(partition: Partition, agent_obsk: int, layout: FeatureLayout) -> NDArray[np.intp]:
    """(N, C): the column of the row behind each number of each observation.

    An agent at the end of a limb has fewer neighbours. Its missing ones read the 0 at the end of the row, placed before
    the shared part, so that one column means the same for every agent.

    Args:
        agent_obsk: neighbours up to this many edges away are seen.

    Raises:
        InvalidConfig: if `agent_obsk` is negative.
    """
    if agent_obsk < 0:
        raise InvalidConfig(f"agent_obsk must be 0 or more, got {agent_obsk}.")
    local = [layout.columns(_local(partition, agent, agent_obsk)) for agent in range(len(partition.agents))]
    width = max(map(len, local))
    shared = layout.columns(partition.shared)
    return np.array([index + [layout.zero] * (width - len(index)) + shared for index in local])


def _local(partition: Partition, agent: int, agent_obsk: int) -> list[FeatureColumn]:
    own, *near = partition.neighbourhoods(agent, agent_obsk)
    columns: list[FeatureColumn] = []
    for column in chain.from_iterable(partition.joint(name).own for name in own):
        if column[0] not in partition.seen_once or column not in columns:
            columns.append(column)
    columns.extend(chain.from_iterable(partition.joint(name).near for name in chain.from_iterable(near)))
    return columns
