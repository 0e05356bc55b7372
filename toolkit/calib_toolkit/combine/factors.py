"""One pair's estimate as a factor of the rig: which of its six numbers count, and how they change with the poses."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag, null_space

from calib_toolkit import se3
from calib_toolkit.types import PairEstimate

Array = NDArray[np.float64]

FLOOR = 1e-12
"""Least variance of any number, square metres or radians: nothing is known better than to a micrometre."""
NOWHERE = 1e-9
"""Metres between two sensors below which there is no direction from one to the other."""


@dataclass(frozen=True)
class Factor:
    """What one usable estimate says of sensors a and b, rows of the calibration, a before b.

    across: (3, j) directions along which its translation counts, in axes of a: three, two (across a unit
    translation) or none. cov: (j + 3, j + 3), by_clock: (j + 3,) per second, of these and the three of the rotation.
    """

    label: str
    a: int
    b: int
    T_a_b: Array
    across: Array
    cov: Array
    by_clock: Array
    has_scale: bool

    def turns_only(self) -> "Factor":
        """Of which the rotation alone counts."""
        return replace(self, across=np.zeros((3, 0)), cov=self.cov[-3:, -3:], by_clock=self.by_clock[-3:])

    def residual(self, T: Array, late: Array) -> Array:
        """(j + 3,) poses T (n, 4, 4) in any one frame less the estimate; late: (n,) seconds that each sensor's
        offset is more than it was when the estimate was made.
        """
        return self._off(se3.relative(T[self.a], T[self.b]), late)

    def linear(self, T: Array, late: Array) -> tuple[Array, Array, Array]:
        """The residual, and its change (j + 3, 6) with a's and with b's pose: ``(dt, delta)`` in the frame of T."""
        found = se3.relative(T[self.a], T[self.b])
        off = self._off(found, late)
        turn = off[-3:] + self.by_clock[-3:] * (late[self.b] - late[self.a])
        by_shift = np.eye(3) if self.has_scale else self._off_course_by(found[:3, 3])
        by_pose = np.zeros((len(off), 6))
        by_pose[:-3, :3] = self.across.T @ by_shift
        by_pose[-3:, 3:] = np.linalg.inv(se3.left_jacobian(turn))
        J_a, J_b = se3.relative_jacobians(T[self.a], T[self.b])
        return off, by_pose @ J_a, by_pose @ J_b

    def _off(self, found: Array, late: Array) -> Array:
        turn = se3.log_so3(found[:3, :3] @ self.T_a_b[:3, :3].T)
        shift = found[:3, 3] - self.T_a_b[:3, 3] if self.has_scale else self._off_course(found[:3, 3])
        moved = self.by_clock * (late[self.b] - late[self.a])
        return np.concatenate([self.across.T @ shift, turn]) - moved

    def _off_course(self, t: Array) -> Array:
        """How far the direction of t is from the estimate's: twice the tangent of half the angle, across it."""
        unit, ahead = self._course(t)
        return 2 * unit / (1 + ahead)

    def _off_course_by(self, t: Array) -> Array:
        unit, ahead = self._course(t)
        by_unit = 2 * np.eye(3) / (1 + ahead) - 2 * np.outer(unit, self.T_a_b[:3, 3]) / (1 + ahead) ** 2
        return np.asarray(by_unit @ (np.eye(3) - np.outer(unit, unit)) / max(float(np.linalg.norm(t)), NOWHERE))

    def _course(self, t: Array) -> tuple[Array, float]:
        unit = t / max(float(np.linalg.norm(t)), NOWHERE)
        return unit, max(float(unit @ self.T_a_b[:3, 3]), -1 + 1e-6)


def unusable(estimate: PairEstimate, names: Sequence[str]) -> str:
    """Why an estimate can not be used at all; empty if it can."""
    t = estimate.transform
    if not estimate.converged:
        return estimate.note or "its search did not converge"
    if t.a == t.b or not {t.a, t.b} <= set(names):
        return "these are not two sensors of the rig"
    if not all(np.all(np.isfinite(v)) for v in (t.T_a_b, t.cov, estimate.by_clock)):
        return "it holds numbers that are not finite"
    if np.linalg.eigvalsh(_correlation(t.cov)).min() < -1e-6:
        return "its covariance is not positive"
    return ""


def labelled(estimate: PairEstimate) -> str:
    """An estimate in words."""
    return f"{estimate.metric} of {estimate.transform.a} and {estimate.transform.b}"


def factor(estimate: PairEstimate, names: Sequence[str]) -> Factor:
    """An estimate that is not :func:`unusable`."""
    t = estimate.transform
    a, b = names.index(t.a), names.index(t.b)
    T, cov, by_clock = t.T_a_b, t.cov, estimate.by_clock
    if a > b:
        by_T, _ = se3.relative_jacobians(T, np.eye(4))
        a, b, T, cov, by_clock = b, a, se3.invert(T), by_T @ cov @ by_T.T, -by_T @ by_clock
    across = np.eye(3)
    if not t.has_scale:
        unit = T[:3, 3] / np.linalg.norm(T[:3, 3])
        T, across = se3.rigid(T[:3, :3], unit), null_space(unit[None])
    told = np.asarray(block_diag(across, np.eye(3)))
    floor = FLOOR * np.eye(told.shape[1])
    return Factor(labelled(estimate), a, b, T, across, told.T @ cov @ told + floor, told.T @ by_clock, t.has_scale)


def _correlation(cov: Array) -> Array:
    sigma = np.sqrt(np.maximum(np.diag(cov), FLOOR))
    return np.asarray(cov / np.outer(sigma, sigma))
