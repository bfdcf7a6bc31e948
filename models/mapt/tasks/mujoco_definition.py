"""The two parts that define a MuJoCo task: a robot with its partition among agents, and a Markov decision process."""

# mujoco is compiled and ships no stubs.
# pyright: reportAttributeAccessIssue=false

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import NDArray

from mapt.errors import TaskError
from mapt.tasks.partition import FeatureColumn, FeatureLayout, Partition, Shapes

FloatArray = NDArray[np.float64]
#: Arrays (E, ...) by feature name: `qpos`, `qvel`, the MDP's `fields` of MjData and its computed `features`.
Features = Mapping[str, FloatArray]
#: (generator, n) -> qpos (n, nq) and qvel (n, nv) of n initial states.
StartSampler = Callable[[np.random.Generator, int], tuple[FloatArray, FloatArray]]
#: (features before, features after, controls (E, nu)) -> reward (E,). Before the step, only `previous` are known.
RewardFunction = Callable[[Features, Features, FloatArray], FloatArray]
#: features -> bool (E,).
Condition = Callable[[Features], NDArray[np.bool_]]


@dataclass(frozen=True, slots=True)
class Robot:
    """A MuJoCo model and the partition of its joints among agents.

    `nq` and `nv` are given, so that a `TaskSpec` can be made without compiling the model.
    """

    #: Makes the uncompiled model, for example `gymnasium_asset("ant.xml")`.
    make_spec: Callable[[], mujoco.MjSpec]
    nq: int
    nv: int
    #: Simulated time of one physics step.
    physics_step_seconds: float
    partition: Partition
    #: Total mass to which the model is scaled; None leaves it.
    total_mass_kg: float | None = None
    #: Per agent, a body that belongs to it with everything attached to it. Empty where the partition names joints of
    #: the model, whose bodies belong to their agents.
    agent_roots: tuple[str, ...] = ()

    def load_model(self) -> mujoco.MjModel:
        """Compile the model.

        Raises:
            TaskError: if gymnasium's file is missing.
        """
        return self.compile(self.make_spec())

    def compile(self, spec: mujoco.MjSpec) -> mujoco.MjModel:
        """Compile `make_spec`'s result, possibly with additions, and scale its mass."""
        # MuJoCo 4 warns about the attribute `settotalmass` at each load. Scaling after compilation gives equal bits.
        spec.compiler.settotalmass = -1
        model = spec.compile()
        if self.total_mass_kg is not None:
            mujoco.mj_setTotalmass(model, self.total_mass_kg)
            mujoco.mj_setConst(model, mujoco.MjData(model))
        return model

    def agent_geoms(self) -> tuple[tuple[int, ...], ...]:
        """Per agent, the ids of the geoms on bodies that its joints move directly, or that are welded to these.

        A body moved by several agents' joints is listed for each of them. With `agent_roots`, the geoms on these bodies
        and on all that hang on them.
        """
        model = self.load_model()
        if self.agent_roots:
            return tuple(_geoms_below(model, model.body(root).id) for root in self.agent_roots)
        moved = [
            {int(model.body_weldid[model.joint(name).bodyid[0]]) for name in names} for names in self.partition.agents
        ]
        welded_to = model.body_weldid[model.geom_bodyid]
        return tuple(tuple(geom for geom in range(model.ngeom) if int(welded_to[geom]) in bodies) for bodies in moved)


def _geoms_below(model: mujoco.MjModel, root: int) -> tuple[int, ...]:
    """Ids of the geoms on a body and on its descendants."""
    bodies = {root}
    for body in range(root + 1, model.nbody):  # a parent comes before its children
        if int(model.body_parentid[body]) in bodies:
            bodies.add(body)
    return tuple(geom for geom in range(model.ngeom) if int(model.geom_bodyid[geom]) in bodies)


def gymnasium_asset(name: str) -> Callable[[], mujoco.MjSpec]:
    """Return a function that reads one of gymnasium's MuJoCo models."""
    return lambda: mujoco.MjSpec.from_file(str(asset_path(name)))


def asset_path(name: str) -> Path:
    """The path of one of gymnasium's MuJoCo files. Does not import gymnasium.

    Raises:
        TaskError: if gymnasium is not installed or lacks the file.
    """
    package = find_spec("gymnasium")
    if package is None or package.origin is None:
        raise TaskError("gymnasium is not installed. The robots' models are among its assets.")
    path = Path(package.origin).parent / "envs" / "mujoco" / "assets" / name
    if not path.is_file():
        raise TaskError(f"{path} is missing. Reinstall gymnasium.")
    return path


def no_features(_features: Features) -> None:
    """Compute nothing: the default of `MujocoMdp.compute`."""


def never_terminated(features: Features) -> NDArray[np.bool_]:
    """False for every environment, (E,): the default of `MujocoMdp.terminated`."""
    return np.zeros(len(features["qpos"]), dtype=bool)


@dataclass(frozen=True, slots=True)
class MujocoMdp:
    """The Markov decision process of a MuJoCo task. Its functions work on all E environments at once."""

    #: Physics steps per environment step.
    frame_skip: int
    #: Samples initial states.
    sample_start: StartSampler
    #: Computes the true reward.
    reward: RewardFunction
    #: The columns that make up the state.
    state: tuple[FeatureColumn, ...]
    #: Whether the state after a step is terminal.
    terminated: Condition = never_terminated
    #: Whether the step reached what the task counts as success; None if it counts nothing.
    success: Condition | None = None
    #: Names of the features that `reward` reads from before the step.
    previous: tuple[str, ...] = ("qpos",)
    #: Shapes by name of the fields of MjData to read. As after `mj_step`, their values are those of the integrator's
    #: last stage, not of the final state.
    fields: Shapes = field(default_factory=dict)
    #: Shapes by name of the features that `compute` writes.
    features: Shapes = field(default_factory=dict)
    #: Writes every one of `features`, in place.
    compute: Callable[[Features], None] = no_features

    def layout(self, nq: int, nv: int) -> FeatureLayout:
        """The layout of all features in one row per environment."""
        return FeatureLayout({"qpos": (nq,), "qvel": (nv,), **self.fields, **self.features})


def uniform_start(
    qpos: FloatArray, n_velocities: int, scale: float, *, normal_velocities: bool = False
) -> StartSampler:
    """Initial states around a pose: positions with uniform noise in [-scale, scale].

    Velocities are uniform in the same range, or normal with standard deviation `scale`.
    """

    def sample(rng: np.random.Generator, n: int) -> tuple[FloatArray, FloatArray]:
        positions = qpos + rng.uniform(-scale, scale, size=(n, qpos.size))
        if normal_velocities:
            return positions, scale * rng.standard_normal((n, n_velocities))
        return positions, rng.uniform(-scale, scale, size=(n, n_velocities))

    return sample


def locomotion_reward(
    step_seconds: float, control_cost_weight: float, healthy: Condition | None = None
) -> RewardFunction:
    """Gymnasium's reward for moving along x: speed in m/s, minus the weighted sum of squares of the controls.

    Args:
        control_cost_weight: applies to the controls before MuJoCo clamps them.
        healthy: adds 1 for each step after which it holds.
    """

    def reward(before: Features, after: Features, controls: FloatArray) -> FloatArray:
        speed = (after["qpos"][:, 0] - before["qpos"][:, 0]) / step_seconds
        gained = speed if healthy is None else speed + healthy(after)
        return gained - control_cost_weight * sum_of_squares(controls)

    return reward


def negated(condition: Condition) -> Condition:
    """The opposite of a condition, such as the termination of an unhealthy robot."""
    return lambda features: ~condition(features)


def sum_of_squares(numbers: FloatArray) -> FloatArray:
    """Sum of squares of each environment: (E, ...) -> (E,)."""
    flat = numbers.reshape(len(numbers), -1)
    return np.vecdot(flat, flat)
