"""Motions of a cheetah, made without a policy."""

import numpy as np
from numpy.typing import NDArray

STEP_SECONDS = 0.05
#: phases and amplitudes of the six joints in radians
_PHASES = np.array([0.0, 0.9, 1.8, 2.4, 3.3, 4.2])
_SWINGS = np.array([0.4, 0.5, 0.4, 0.4, 0.5, 0.3])


def trot(steps: int, metres_a_second: float = 2.0) -> NDArray[np.float64]:
    """qpos (T,9) of a steady trot with all six joints swinging at 2 Hz."""
    seconds = np.arange(steps)[:, None] * STEP_SECONDS
    joints = _SWINGS * np.sin(4 * np.pi * seconds + _PHASES)
    pitch = 0.05 * np.sin(4 * np.pi * seconds)
    return np.hstack([metres_a_second * seconds, 0.03 * np.cos(8 * np.pi * seconds), pitch, joints])


def wild_run(steps: int) -> NDArray[np.float64]:
    """qpos (T,9) of a motion that is hard to follow: 0 to 14 m/s in jerks, leaps of 0.8 m, two somersaults."""
    phase = np.linspace(0, 1, steps)
    qpos = trot(steps)
    qpos[:, 0] = np.cumsum(10 * phase * (1 + 0.4 * np.sin(20 * np.pi * phase))) * STEP_SECONDS
    qpos[:, 1] = 0.8 * np.abs(np.sin(6 * np.pi * phase))
    qpos[:, 2] = 4 * np.pi * phase
    return qpos
