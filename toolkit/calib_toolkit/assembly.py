"""What the stages found, as one calibration."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from calib_toolkit import se3
from calib_toolkit.rotation import Rotations
from calib_toolkit.timing import TimeOffsets
from calib_toolkit.translation import Translations
from calib_toolkit.types import Calibration, Undetermined
from calib_toolkit.types.calibration import PARAMETERS

Array = NDArray[np.float64]

SHARE = 0.3
"""A parameter is not determined if an undetermined direction has at least this component along it."""
WORTH = {"x": 1.0, "y": 1.0, "z": 1.0, "rx": 0.1, "ry": 0.1, "rz": 0.1, "dt": 1.0}
"""Metres, radians and seconds that are worth the same where a direction mixes them."""

ANYTHING = {"x": 2.0, "y": 2.0, "z": 2.0, "rx": 1.0, "ry": 1.0, "rz": 1.0, "dt": 1.0}
"""Sigma of what the drive says nothing about: metres, radians, seconds."""


def determined(names: Sequence[str], undetermined: Sequence[Undetermined]) -> NDArray[np.bool_]:
    """(n, 7) whether each sensor's each parameter is determined."""
    known = np.ones((len(names), len(PARAMETERS)), dtype=bool)
    for u in undetermined:
        parts = {key: component / WORTH[key.rpartition(".")[2]] for key, component in u.direction.items()}
        size = np.linalg.norm(list(parts.values()))
        for key, component in parts.items():
            name, _, parameter = key.rpartition(".")
            if abs(component) >= SHARE * size:
                known[names.index(name), PARAMETERS.index(parameter)] = False
    return known


def calibration(
    names: tuple[str, ...],
    has_scale: NDArray[np.bool_],
    undetermined: Sequence[Undetermined],
    offsets: TimeOffsets,
    rotations: Rotations | None = None,
    translations: Translations | None = None,
) -> Calibration:
    """The calibration after as many stages as are given; what later ones will find is not determined yet.

    The stages are estimated one after the other, so their covariances fill blocks of the joint one. Along an
    undetermined direction it holds ``ANYTHING``, which parameters that lean on it get their part of.
    """
    n = len(names)
    known = determined(names, undetermined)
    R, t = np.broadcast_to(np.eye(3), (n, 3, 3)), np.zeros((n, 3))
    cov = np.zeros((n, 7, n, 7))
    cov[:, 6, :, 6] = offsets.cov
    if rotations is None:
        known[1:, 3:6] = False
    else:
        R = rotations.R_base_sensor
        cov[:, 3:6, :, 3:6] = rotations.cov.reshape(n, 3, n, 3)
    if translations is None:
        known[1:, :3] = False
    else:
        t = translations.t_base_sensor
        cov[:, :3, :, :3] = translations.cov.reshape(n, 3, n, 3)
    joint = with_unknown(names, undetermined, cov.reshape(7 * n, 7 * n))
    return Calibration(
        names[0],
        names,
        se3.rigid(R, t),
        offsets.dt,
        joint,
        has_scale,
        known,
        tuple(undetermined),
    )


def alone(name: str) -> Calibration:
    """A base and nothing else."""
    one = np.ones(1, dtype=bool)
    return Calibration(
        name, (name,), np.eye(4)[None], np.zeros(1), np.zeros((7, 7)), one, np.ones((1, 7), dtype=bool)
    )


def with_unknown(names: Sequence[str], undetermined: Sequence[Undetermined], cov: Array) -> Array:
    """A covariance (7n, 7n) with ``ANYTHING`` along directions that are not determined.

    A direction that turns and shifts is the beginning of an arc, which so far away has left the straight line.
    """
    for u in undetermined:
        vector = _vector(names, u)
        cov = cov + np.outer(vector, vector)
        parts = vector.reshape(-1, 7)
        bent = np.zeros_like(parts)
        bent[:, :3] = np.cross(parts[:, 3:6], parts[:, :3]) / 2
        cov = cov + np.outer(bent, bent)
    return cov


def _vector(names: Sequence[str], u: Undetermined) -> Array:
    """(7n,) an undetermined direction, as long as what is not known along it."""
    found = np.zeros((len(names), len(PARAMETERS)))
    for key, component in u.direction.items():
        name, _, parameter = key.rpartition(".")
        found[names.index(name), PARAMETERS.index(parameter)] = component
    # as far as the first parameter can be from anything
    return np.asarray(
        found.ravel() * min(ANYTHING[k.rpartition(".")[2]] / abs(c) for k, c in u.direction.items() if c)
    )
