"""A MuJoCo body and the agents that drive it: the model, and which geoms belong to whom."""

# mujoco is compiled and ships no stubs.
# pyright: reportAttributeAccessIssue=false

from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

import mujoco

from mapt.tasks.errors import TaskError
from mapt.tasks.partition import Partition


@dataclass(frozen=True, slots=True)
class MujocoScene:
    """A model from gymnasium's assets and its partition among agents."""

    #: File name in gymnasium's MuJoCo assets.
    asset: str
    #: Mass to which the whole body is scaled.
    total_mass_kg: float
    partition: Partition

    def load_model(self) -> mujoco.MjModel:
        """Compile the model.

        MuJoCo 4 deprecates the attribute `settotalmass` and prints so on every load. Scaling after the compiler
        gives the same bits in every field, in silence.

        Raises:
            TaskError: if gymnasium's file is missing.
        """
        spec = mujoco.MjSpec.from_file(str(asset_path(self.asset)))
        spec.compiler.settotalmass = -1
        model = spec.compile()
        mujoco.mj_setTotalmass(model, self.total_mass_kg)
        mujoco.mj_setConst(model, mujoco.MjData(model))
        return model

    def agent_geoms(self) -> tuple[tuple[int, ...], ...]:
        """Per agent, the ids of the geoms on the bodies that its joints move directly."""
        model = self.load_model()
        bodies = [{int(model.joint(name).bodyid[0]) for name in names} for names in self.partition.agents]
        return tuple(
            tuple(geom for geom in range(model.ngeom) if int(model.geom_bodyid[geom]) in owned) for owned in bodies
        )


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
