"""How far an estimate is from the truth, and how far it says it may be."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from calib_toolkit import se3
from calib_toolkit.errors import CalibrationError

Array = NDArray[np.float64]

EULER, DELTA, POSITION = ("roll", "pitch", "yaw"), ("rx", "ry", "rz"), ("x", "y", "z")
UNITS = {
    **dict.fromkeys((*EULER, "rotation", *DELTA), "deg"),
    **dict.fromkeys((*POSITION, "translation"), "m"),
    "dt": "ms",
}
"""Unit of every error and sigma in the tables."""
FAILURES = (CalibrationError, ValueError, ArithmeticError)
"""What must cost one estimator its row, and nobody else."""
UNEXPECTED = "unexpected"
"""How the note begins of what should not have been refused, but made the program fail."""


@dataclass(frozen=True)
class Finding:
    """What one estimator found for one sensor or pair of sensors.

    error: estimate against truth, by parameter, in ``UNITS``; without those that are not known. sigma: as stated.
    undetermined: parameters that the estimator says it did not determine. refused: the sentence, if it refused.
    """

    estimator: str
    sensor: str
    error: Mapping[str, float] = field(default_factory=dict)
    sigma: Mapping[str, float] = field(default_factory=dict)
    undetermined: tuple[str, ...] = ()
    refused: str = ""


def refusal(e: Exception) -> str:
    """The sentence on one of the ``FAILURES``."""
    return str(e) if isinstance(e, CalibrationError) else f"{UNEXPECTED} {type(e).__name__}: {e}"


def rotation_error(R_error: Array) -> dict[str, float]:
    """Of ``R_true R_est^T`` (3, 3): Euler angles (``Rz(yaw) Ry(pitch) Rx(roll)``), the whole angle, and ``delta``."""
    angles = np.degrees(Rotation.from_matrix(R_error).as_euler("ZYX")[::-1])
    delta = np.degrees(se3.log_so3(R_error))
    return {**_named(EULER, angles), "rotation": float(np.linalg.norm(delta)), **_named(DELTA, delta)}


def rotation_sigma(cov: Array) -> dict[str, float]:
    """Of ``delta`` with covariance (3, 3), radians squared; of the Euler angles by Monte-Carlo (section VIII-D)."""
    delta = np.degrees(np.sqrt(np.maximum(np.diag(cov), 0.0)))
    return {**_named(EULER, np.degrees(euler_sigma(cov))), **_named(DELTA, delta)}


def euler_sigma(cov: Array) -> Array:
    """(3,) standard deviation of roll, pitch and yaw of a rotation ``Exp(delta)``, delta of covariance (3, 3)."""
    variance, axes = np.linalg.eigh(cov)
    deltas = _normal() @ (axes * np.sqrt(np.maximum(variance, 0.0))).T
    return np.asarray(Rotation.from_rotvec(deltas).as_euler("ZYX")[:, ::-1].std(axis=0))


@cache
def _normal() -> Array:
    """The draws of every Monte-Carlo: the same for all, so that nothing depends on the order of work."""
    return np.random.default_rng(0).normal(size=(4000, 3))


def _named(names: tuple[str, ...], values: Array) -> dict[str, float]:
    return dict(zip(names, map(float, values), strict=True))
