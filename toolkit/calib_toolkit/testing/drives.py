"""Short drives whose true pose is known at any time: they are formulas, so no stamp has to be interpolated."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from calib_toolkit import se3

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Drive:
    """A vehicle's way. pose: seconds (n,) to ``T_world_vehicle`` (n, 4, 4), vehicle x forward, z up, metres."""

    name: str
    pose: Callable[[Array], Array]


def _still(t: Array) -> Array:
    return np.tile(np.eye(4), (len(t), 1, 1))


def _forward(t: Array) -> Array:
    T = _still(t)
    T[:, 0, 3] = 8.0 * t + 0.5 * np.sin(t)
    return T


def _turning(t: Array) -> Array:
    """A left-hand bend of 20 m radius on an uneven road: heave, roll and pitch of a few centimetres and degrees."""
    yaw = 0.4 * t
    position = np.stack([20.0 * np.sin(yaw), 20.0 * (1 - np.cos(yaw)), 0.05 * np.sin(3.0 * t)], axis=1)
    angles = np.stack([yaw, 0.03 * np.sin(2.3 * t), 0.05 * np.sin(1.7 * t)], axis=1)
    return se3.rigid(Rotation.from_euler("ZYX", angles).as_matrix(), position)


STILL = Drive("still", _still)
FORWARD = Drive("forward", _forward)
TURNING = Drive("turning", _turning)
