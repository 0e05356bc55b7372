"""Numbers that someone measured, as information on poses and clocks."""

from collections.abc import Sequence
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from calib_toolkit import delta, se3
from calib_toolkit.errors import ConfigError
from calib_toolkit.joint import verdict
from calib_toolkit.joint.clocks import Clocks, Late
from calib_toolkit.types import Measured

Array = NDArray[np.float64]

UPRIGHT = 0.99
"""Sine of the pitch from which roll and yaw are one."""
HELD = 1.0
"""Metres, or their worth in radians, to which numbers must hold a direction that the drive leaves open."""
NUMBERS = ("x", "y", "z", "roll", "pitch", "yaw")


def checked(prior: Sequence[Measured], names: Sequence[str]) -> None:
    """Refuse numbers of sensors that are not there. names: the base first. Raises ConfigError."""
    for m in prior:
        if m.sensor not in names:
            raise ConfigError(
                f"the prior tells of '{m.sensor}', which is not calibrated; there are: {', '.join(names)}"
            )
        if not np.isfinite(m.value) or not m.sigma > 0:
            raise ConfigError(
                f"the prior of {m.sensor}.{m.parameter} has no value, or no sigma above zero; give both"
            )
        if m.sensor == names[0]:
            raise ConfigError(
                f"the prior tells of '{m.sensor}', in whose frame all numbers are; choose another sensor with --base"
            )


def without_scale(prior: Sequence[Measured]) -> None:
    """Refuse numbers on poses where no sensor measures distances: they would be left unused. Raises ConfigError."""
    if unused := [f"{m.sensor}.{m.parameter}" for m in prior if m.parameter in NUMBERS]:
        raise ConfigError(
            f"the prior tells {', '.join(unused)}, but cameras alone give no positions and take no measured poses; "
            "add a sensor that measures distances, or leave them out"
        )


def information(T: Array, names: Sequence[str], prior: Sequence[Measured]) -> tuple[Array, Array]:
    """What the numbers say of poses T (n, 4, 4): information (6(n-1),) squared and gradient (6(n-1),).

    Of ``(dt, delta)`` of each sensor but the base, base axes.
    """
    size = 6 * (len(T) - 1)
    total, pull = np.zeros((size, size)), np.zeros(size)
    for m in prior:
        if m.parameter not in NUMBERS:
            continue
        i, k = names.index(m.sensor), NUMBERS.index(m.parameter)
        error = m.value - _numbers(T[i], np.zeros(6))[k]
        if k >= 3:
            error = (error + np.pi) % (2 * np.pi) - np.pi
        if k >= 3 and abs(T[i, 2, 0]) > UPRIGHT:
            raise ConfigError(
                f"the prior gives an angle of {m.sensor}, which points straight up or down, where roll and yaw can "
                "not be told apart; give its position only"
            )
        slope = np.zeros(size)
        slope[6 * (i - 1) : 6 * i] = delta.jacobian(partial(_numbers, T[i]), np.zeros(6))[k]
        total += np.outer(slope, slope) / m.sigma**2
        pull += slope * error / m.sigma**2
    return total, pull


def late(prior: Sequence[Measured], names: Sequence[str], clocks: Clocks) -> list[Late]:
    """What the numbers say of clocks."""
    found = [m for m in prior if m.parameter == "dt"]
    return [Late(int(clocks.of[names.index(m.sensor)]), m.value, m.sigma) for m in found]


def unheld(directions: Array, information: Array) -> Array:
    """(6, j) of the untold directions (6, k) of a sensor, in ``verdict.UNITS``, those that no number holds.

    information: (6, 6) of the numbers on ``(dt, delta)``.
    """
    seen = directions * verdict.UNITS[:, None]
    values, vectors = np.linalg.eigh(seen.T @ information @ seen)
    return directions @ vectors[:, values < 1 / HELD**2]


def _numbers(T: Array, moved: Array) -> Array:
    """(6,) of a pose, moved by ``(dt, delta)``."""
    angles = Rotation.from_matrix(se3.exp_so3(moved[3:]) @ T[:3, :3]).as_euler("ZYX")[::-1]
    return np.concatenate([T[:3, 3] + moved[:3], angles])
