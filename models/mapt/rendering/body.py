"""Where the moving parts of a model are, pose by pose: positions alone, no dynamics."""

# mujoco is compiled and ships no stubs.
# pyright: reportAttributeAccessIssue=false

import mujoco
import numpy as np
from numpy.typing import NDArray

from mapt.rendering.scene import moving_geoms

Float64s = NDArray[np.float64]
#: poses that are tried to find how far a body reaches
TRIED_POSES = 200


class Body:
    """The geoms of a model that are not fixed to the world, G of them."""

    def __init__(self, model: mujoco.MjModel) -> None:
        self.model = model
        self.data = mujoco.MjData(model)
        self._geoms = moving_geoms(model)

    def place(self, qpos: Float64s) -> None:
        self.data.qpos[:] = qpos
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_camlight(self.model, self.data)

    def boxes(self, axes: Float64s) -> tuple[Float64s, Float64s]:
        """Centres and half sizes (G,3), metres, of the boxes around the geoms as they are placed.

        Args:
            axes: (3,3), rows are the directions along which boxes lie and are measured.
        """
        turn = axes @ self.data.geom_xmat[self._geoms].reshape(-1, 3, 3)
        centre, half = np.split(self.model.geom_aabb[self._geoms], 2, axis=1)
        centre = self.data.geom_xpos[self._geoms] @ axes.T + np.einsum("gij,gj->gi", turn, centre)
        return centre, np.einsum("gij,gj->gi", np.abs(turn), half)

    def extents(self, qpos: Float64s, axes: Float64s) -> tuple[Float64s, Float64s]:
        """Lowest and highest corners (T,3), metres, of the box around all geoms in each pose (T,nq)."""
        corners = np.empty((2, len(qpos), 3))
        for step, state in enumerate(qpos):
            self.place(state)
            centre, half = self.boxes(axes)
            corners[0, step] = (centre - half).min(axis=0)
            corners[1, step] = (centre + half).max(axis=0)
        return corners[0], corners[1]

    def poses(self) -> Float64s:
        """(P,nq): the model's own pose, and others with every driven hinge anywhere in its range. Always the same."""
        model, rng = self.model, np.random.default_rng(0)
        poses = np.tile(model.qpos0, (1 + TRIED_POSES, 1))
        joints = model.actuator_trnid[model.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT, 0]
        for joint in joints[model.jnt_type[joints] == mujoco.mjtJoint.mjJNT_HINGE]:
            low, high = model.jnt_range[joint] if model.jnt_limited[joint] else (-np.pi, np.pi)
            poses[1:, model.jnt_qposadr[joint]] = rng.uniform(low, high, TRIED_POSES)
        return poses
