"""How each sensor is turned: sections VI-A2, VI-B2, VI-C and VI-D for the rotations.

A rigid body's rotation vector is the same for all its sensors but for their axes (equation 10). Everything is
written in base axes: ``w_i = R_base_i w_sensor``; turning a residual does not change its likelihood.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from calib_toolkit import delta, se3
from calib_toolkit.likelihood import all_pairs, log_normal_3d, maximise, trimmed
from calib_toolkit.sync import Steps

Array = NDArray[np.float64]


@dataclass(frozen=True)
class RotationOptions:
    """trim: share of each pair's steps left out (VI-C1)."""

    trim: float = 0.25


@dataclass(frozen=True)
class Rotations:
    """R_base_sensor: (n, 3, 3). cov: (3n, 3n) of ``delta`` in ``R_true = Exp(delta) R``, base axes."""

    R_base_sensor: Array
    cov: Array


def estimate(steps: Steps, options: RotationOptions) -> Rotations:
    """Rotations of all sensors in the first one's frame."""
    R = optimise(initialise(steps), steps, options)
    return Rotations(R, uncertainty(R, steps, options))


def initialise(steps: Steps) -> Array:
    """Weighted Kabsch between the first sensor and each other one (VI-A2). Returns (n, 3, 3).

    A step weighs the inverse of the summed diagonals of both covariances.
    """
    w, cov = steps.vec[..., 3:], steps.cov[..., 3:, 3:]
    spread = np.trace(cov, axis1=-2, axis2=-1)
    return np.array([np.eye(3), *(_kabsch(w[0], w[i], 1 / (spread[0] + spread[i])) for i in range(1, len(w)))])


def log_likelihood(R: Array, steps: Steps, options: RotationOptions) -> float:
    """Equations (11) to (13) and (17): trimmed sum over all pairs. R: (n, 3, 3)."""
    w, cov = _in_base_axes(R, steps)
    return sum(trimmed(log_normal_3d(w[x] - w[y], cov[x] + cov[y]), options.trim)[0] for x, y in all_pairs(len(w)))


def optimise(start: Array, steps: Steps, options: RotationOptions) -> Array:
    """The rotations of highest likelihood, searched as turns away from the start. (n, 3, 3)."""

    def turned(deltas: Array) -> Array:
        turns = np.vstack([np.zeros(3), deltas.reshape(-1, 3)])
        return se3.exp_so3(turns) @ start

    expected = uncertainty(start, steps, options)[3:, 3:]
    found = maximise(lambda p: log_likelihood(turned(p), steps, options), np.zeros(len(expected)), expected)
    return turned(found)


def uncertainty(R: Array, steps: Steps, options: RotationOptions) -> Array:
    """Covariance (3n, 3n) of the rotations: the larger of Cramer-Rao and the approximate delta method (VI-D1)."""
    n, q = len(R), 3 * (len(R) - 1)
    w, cov = _in_base_axes(R, steps)
    sums = delta.Sums.zero(q, n, len(steps), 3)
    for x, y in all_pairs(n):
        _, kept = trimmed(log_normal_3d(w[x] - w[y], cov[x] + cov[y]), options.trim)
        at = np.flatnonzero(kept)
        J = np.zeros((len(at), 3, q + 3))
        # w_i = Exp(delta_i) R_i w: d w_i / d delta_i = -[w_i]x
        J[:, :, 3 * x : 3 * x + 3] = -se3.skew(w[x, at])
        J[:, :, 3 * y : 3 * y + 3] = se3.skew(w[y, at])
        sums.add(at, x, y, J[:, :, 3:], np.linalg.inv(cov[x, at] + cov[y, at]), np.eye(3), -np.eye(3))
    full = np.zeros((q + 3, q + 3))
    full[3:, 3:] = delta.larger(sums.cramer_rao(), sums.approximate_delta(cov))
    return full


def disagreement(R: Array, names: Sequence[str], steps: Steps) -> dict[str, float]:
    """How many times more two sensors' turns differ than their stated noise explains, by ``a-b``; ideally one.

    The median of the squared normalised difference, against that of three degrees of freedom.
    """
    w, cov = _in_base_axes(R, steps)
    found = {}
    for x, y in all_pairs(len(w)):
        error = w[x] - w[y]
        squared = np.einsum("mi,mi->m", error, np.linalg.solve(cov[x] + cov[y], error[..., None])[..., 0])
        found[f"{names[x]}-{names[y]}"] = float(np.sqrt(np.median(squared) / chi2.median(3)))
    return found


def _in_base_axes(R: Array, steps: Steps) -> tuple[Array, Array]:
    return se3.turn_vectors(R, steps.vec[..., 3:]), se3.turn_covs(R, steps.cov[..., 3:, 3:])


def _kabsch(w_base: Array, w_sensor: Array, weight: Array) -> Array:
    U, _, Vt = np.linalg.svd((w_base * weight[:, None]).T @ w_sensor)
    return U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
