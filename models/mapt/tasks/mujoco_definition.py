"""A MuJoCo body and the agents that drive it: the model, and which geoms belong to whom."""

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


@dataclass(frozen=True, slots=True)
class Robot:
    """A model and its partition among agents. The sizes are stated, so that a spec needs no compiler."""

    #: Makes a description of the model, for the compiler; `gymnasium_asset` is one such.
    describe: Callable[[], mujoco.MjSpec]
    nq: int
    nv: int
    #: Simulated time of one step of the physics.
    physics_step_seconds: float
    partition: Partition
    #: Mass to which the whole body is scaled.
    total_mass_kg: float | None = None

    def load_model(self) -> mujoco.MjModel:
        """Compile the model.

        MuJoCo 4 deprecates the attribute `settotalmass` and prints so on every load. Scaling after the compiler
        gives the same bits in every field, in silence.

        Raises:
            TaskError: if gymnasium's file is missing.
        """
        return self.compile(self.describe())

    def compile(self, spec: mujoco.MjSpec) -> mujoco.MjModel:
        """The model of `describe`'s description, or of one that was changed since."""
        spec.compiler.settotalmass = -1
        model = spec.compile()
        if self.total_mass_kg is not None:
            mujoco.mj_setTotalmass(model, self.total_mass_kg)
            mujoco.mj_setConst(model, mujoco.MjData(model))
        return model

    def agent_geoms(self) -> tuple[tuple[int, ...], ...]:
        """Per agent, the ids of the geoms that its joints move directly, with those of bodies fixed to these.

        A body that joints of several agents move is in the list of each.
        """
        model = self.load_model()
        moved = [
            {int(model.body_weldid[model.joint(name).bodyid[0]]) for name in names} for names in self.partition.agents
        ]
        carrier = model.body_weldid[model.geom_bodyid]
        return tuple(tuple(geom for geom in range(model.ngeom) if int(carrier[geom]) in bodies) for bodies in moved)


def gymnasium_asset(name: str) -> Callable[[], mujoco.MjSpec]:
    """Reads a model of gymnasium's, when it is called."""
    return lambda: mujoco.MjSpec.from_file(str(asset_path(name)))


def asset_path(name: str) -> Path:
    """A file of gymnasium's MuJoCo assets, found without importing gymnasium and its registry.

    Raises:
        TaskError: if gymnasium is not installed or does not have it.
    """
    package = find_spec("gymnasium")
    if package is None or package.origin is None:
        raise TaskError("gymnasium is not installed; its assets hold the bodies of the tasks.")
    path = Path(package.origin).parent / "envs" / "mujoco" / "assets" / name
    if not path.is_file():
        raise TaskError(f"{path} is missing; reinstall gymnasium.")
    return path


FloatArray = NDArray[np.float64]
#: Every feature by name, each (E, ...): qpos, qvel, the fields that the mdp name, and what they compute.
Features = Mapping[str, FloatArray]


def no_features(_frame: Features) -> None:
    """Nothing is computed beyond positions, velocities and fields."""


def never_terminated(frame: Features) -> NDArray[np.bool_]:
    """(E,) bool: no state is without a future."""
    return np.zeros(len(frame["qpos"]), dtype=bool)


@dataclass(frozen=True, slots=True)
class MujocoMdp:
    """The mdp of a task on MuJoCo."""

    #: Physics steps per step of the task.
    frame_skip: int
    #: (generator, n) -> qpos (n, nq), qvel (n, nv) of n fresh episodes.
    sample_start: Callable[[np.random.Generator, int], tuple[FloatArray, FloatArray]]
    #: (frame before, frame after, controls (E, nu)) -> reward (E,). The frame before holds `before` alone.
    reward: Callable[[Features, Features, FloatArray], FloatArray]
    #: What the state is made of.
    state: tuple[FeatureColumn, ...]
    #: frame after -> terminated (E,) bool.
    terminated: Callable[[Features], NDArray[np.bool_]] = never_terminated
    #: Features that the reward reads from the frame before the step.
    before: tuple[str, ...] = ("qpos",)
    #: Fields of MjData that are read, with their shapes. As after `mj_step`, they describe the last stage of the
    #: integrator, not the state that it reached.
    fields: Shapes = field(default_factory=dict)
    #: Shapes of what `compute` writes.
    features: Shapes = field(default_factory=dict)
    #: Writes every one of `features` into the frame, in place.
    compute: Callable[[Features], None] = no_features

    def layout(self, nq: int, nv: int) -> FeatureLayout:
        return FeatureLayout({"qpos": (nq,), "qvel": (nv,), **self.fields, **self.features})


def uniform_start(
    qpos: FloatArray, n_velocities: int, scale: float, *, normal_velocities: bool = False
) -> Callable[[np.random.Generator, int], tuple[FloatArray, FloatArray]]:
    """Starts about a pose at rest: uniform noise within plus and minus `scale` on each position.

    Velocities are as wide, or normal with this deviation.
    """

    def draw(rng: np.random.Generator, n: int) -> tuple[FloatArray, FloatArray]:
        positions = qpos + rng.uniform(-scale, scale, size=(n, qpos.size))
        if normal_velocities:
            return positions, scale * rng.standard_normal((n, n_velocities))
        return positions, rng.uniform(-scale, scale, size=(n, n_velocities))

    return draw


def sum_of_squares(numbers: FloatArray) -> FloatArray:
    """Sum of squares of each environment, (E,)."""
    flat = numbers.reshape(len(numbers), -1)
    return np.vecdot(flat, flat)
