"""A MuJoCo body and the agents that drive it: the model, and which geoms belong to whom."""

# mujoco is compiled and ships no stubs.
# pyright: reportAttributeAccessIssue=false

from collections.abc import Callable
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

import mujoco

from mapt.tasks.errors import TaskError
from mapt.tasks.partition import Partition


@dataclass(frozen=True, slots=True)
class MujocoScene:
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
