"""The rig that is most likely given the motion result and the pairs' estimates: a least-squares problem."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cholesky, solve_triangular

from calib_toolkit import assembly, se3
from calib_toolkit.combine import shared
from calib_toolkit.combine.factors import NOWHERE, Factor
from calib_toolkit.types import Calibration
from calib_toolkit.types.calibration import PARAMETERS

Array = NDArray[np.float64]

FAR = 1e3
"""How many times ``assembly.ANYTHING`` off an undetermined number may be at no cost: it holds no information."""
FEWEST = 3.0
"""Sigma that a distance must be from zero before a direction alone tells anything of where the two sensors are."""

ROUNDS, SETTLED = 50, 1e-18
"""Gauss-Newton steps at most, and the normalised square of one that is too small to matter."""


@dataclass(frozen=True)
class Prior:
    """What motion says of the change of its own result (7n,): ``root @ N(0, 1)``, and anything along ``open``.

    T: (n, 4, 4). root: (7n, 7n), its square the covariance as stated. open: (7n, k).
    """

    T: Array
    root: Array
    open: Array

    @staticmethod
    def of(motion: Calibration, wider: Array, free: Sequence[int] = ()) -> "Prior":
        """wider: (n,) how many times the stated sigma a sensor's pose has. free: sensors told nothing of."""
        n = len(motion.names)
        T = motion.T_base_sensor.copy()
        T[:, :3, 3] = np.nan_to_num(T[:, :3, 3])
        cov = np.nan_to_num(motion.covariance)
        # the base's own rows stay zero whatever is said of it
        unsaid = ~motion.determined & (np.arange(n) != motion.index(motion.base))[:, None]
        lost = unsaid & (np.diag(cov).reshape(n, 7) == 0)
        untold = lost | (unsaid & assembly.determined(motion.names, motion.undetermined))
        untold[list(free), :6] = True
        anything = np.array([assembly.ANYTHING[p] for p in PARAMETERS])
        open_ = assembly.with_unknown(motion.names, motion.undetermined, np.diag((untold * anything**2).ravel()))
        stretch = np.column_stack([wider] * 6 + [np.ones(n)]).ravel()
        columns = _root(open_)
        stated = _root(cov + np.diag((lost * anything**2).ravel()))
        return Prior(T, stretch[:, None] * stated, FAR * columns[:, np.any(columns, axis=0)])

    def moved(self, change: Array) -> Array:
        """(n, 4, 4) poses after a change (7n,)."""
        parts = change.reshape(-1, 7)
        return se3.rigid(se3.exp_so3(parts[:, 3:6]) @ self.T[:, :3, :3], self.T[:, :3, 3] + parts[:, :3])


@dataclass(frozen=True)
class Solution:
    """The most likely change (7n,) of the motion result, and its derivatives there.

    factors: as it was used. whitened: (m, 7n) derivative of the whitened residuals by the poses and offsets.
    """

    prior: Prior
    change: Array
    factors: Sequence[Factor]
    whitened: Array

    @cached_property
    def T(self) -> Array:
        """(n, 4, 4) ``T_base_sensor``."""
        return self.prior.moved(self.change)

    @property
    def late(self) -> Array:
        """(n,) seconds that clock offsets are more than motion said."""
        return np.asarray(self.change[6::7])

    @cached_property
    def stated(self) -> Array:
        """(7n, 7n) covariance with motion's own where nothing is known."""
        return self._covariance(self.prior.root)

    @cached_property
    def covariance(self) -> Array:
        """(7n, 7n) covariance, vast along what nothing tells."""
        return self._covariance(np.column_stack([self.prior.root, self.prior.open]))

    def expected(self, f: Factor) -> tuple[Array, Array]:
        """An estimate's residual, and the covariance that the error of this rig gives it."""
        off, J = linear(f, self.T, self.late)
        return off, np.asarray(J @ self.covariance @ J.T)

    def _covariance(self, root: Array) -> Array:
        root = _turned(root, self.change)
        J = np.vstack([np.eye(root.shape[1]), self.whitened @ root])
        half = solve_triangular(np.linalg.qr(J, mode="r"), root.T, trans="T").T
        return np.asarray(half @ half.T)


def solve(prior: Prior, factors: Sequence[Factor]) -> Solution:
    """Directions count once the distances that they belong to are known from all the rest."""
    if all(f.has_scale for f in factors):
        return _solve(prior, factors, np.zeros(len(prior.root)))
    rest = _solve(prior, [f if f.has_scale else f.turns_only() for f in factors], np.zeros(len(prior.root)))
    return _solve(prior, [counted(f, rest) for f in factors], rest.change)


def counted(f: Factor, rest: Solution) -> Factor:
    """The estimate, without its direction if what is known besides may put the two sensors in one place."""
    if f.has_scale:
        return f
    T = rest.T
    J = np.zeros((6, len(T), 7))
    J[:, f.a, :6], J[:, f.b, :6] = se3.relative_jacobians(T[f.a], T[f.b])
    by_all = J.reshape(6, -1)[:3]
    distance, variance = se3.relative(T[f.a], T[f.b])[:3, 3], np.trace(by_all @ rest.covariance @ by_all.T)
    return f if distance @ distance > FEWEST**2 * variance + NOWHERE**2 else f.turns_only()


def linear(f: Factor, T: Array, late: Array) -> tuple[Array, Array]:
    """A residual (k,) and its change (k, 7n) with the poses, ``(dt, delta)`` in base axes, and the clock offsets."""
    J = np.zeros((len(f.cov), len(T), 7))
    off, J[:, f.a, :6], J[:, f.b, :6] = f.linear(T, late)
    J[:, f.a, 6], J[:, f.b, 6] = f.by_clock, -f.by_clock
    return off, J.reshape(len(J), -1)


def _solve(prior: Prior, factors: Sequence[Factor], start: Array) -> Solution:
    """Gauss-Newton over ``change = root @ z``, of which motion says that z is N(0, 1)."""
    if not factors:
        return Solution(prior, np.zeros(len(prior.root)), (), np.zeros((0, len(prior.root))))
    root = np.column_stack([prior.root, prior.open])
    L = cholesky(shared.covariance(factors, prior.moved(start)), lower=True)

    def whitened(z: Array) -> tuple[Array, Array]:
        change = root @ z
        T, late = prior.moved(change), change[6::7]
        off, J = zip(*(linear(f, T, late) for f in factors), strict=True)
        both = solve_triangular(L, np.column_stack([np.concatenate(off), np.vstack(J)]), lower=True)
        return np.concatenate([z, both[:, 0]]), both[:, 1:]

    z: Array = np.asarray(np.linalg.lstsq(root, start, rcond=None)[0], dtype=np.float64)
    off, by_all = whitened(z)
    for _ in range(ROUNDS):
        J = np.vstack([np.eye(len(z)), by_all @ _turned(root, root @ z)])
        step = np.linalg.lstsq(J, -off, rcond=None)[0]
        tries = ((z + s * step, *whitened(z + s * step)) for s in (0.5**k for k in range(10)))
        better = next((t for t in tries if t[1] @ t[1] < off @ off), None)
        if better is None:
            break
        z, off, by_all = better
        if np.sum((J @ step) ** 2) < SETTLED:
            break
    return Solution(prior, np.asarray(root @ z), factors, by_all)


def _turned(root: Array, change: Array) -> Array:
    """Rows of a change of the motion result as ``(dt, delta)`` of the poses that it leads to."""
    turned = root.reshape(len(change) // 7, 7, -1).copy()
    turned[:, 3:6] = se3.left_jacobian(change.reshape(-1, 7)[:, 3:6]) @ turned[:, 3:6]
    return turned.reshape(root.shape)


def _root(cov: Array) -> Array:
    """(p, p) whose square is a covariance that may be singular; scaled, or metres and seconds would lose digits."""
    sigma = np.sqrt(np.maximum(np.diag(cov), 0.0))
    unit = np.where(sigma > 0, sigma, 1.0)
    variance, axes = np.linalg.eigh(cov / np.outer(unit, unit))
    variance[variance < 1e-12 * max(variance.max(), 0.0)] = 0.0
    return np.asarray(sigma[:, None] * axes * np.sqrt(variance))
