"""From the noise of the readings to the noise of the answer: the delta method, its approximate form, Cramer-Rao.

Section VI-D of the paper. The approximate form is Censi's (reference [26]): where an answer p minimises a cost
J(p, z) of readings z, ``cov(p) = H^-1 G cov(z) G^T H^-1`` with ``H = d2J/dp2`` and ``G = d2J/dp dz``.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def jacobian(f: Callable[[Array], Array], x: Array, step: float = 1e-6) -> Array:
    """Central finite differences. f: (k,) -> (...,). Returns (..., k)."""
    columns = []
    for i in range(x.size):
        h = np.zeros(x.size)
        h[i] = step
        columns.append((np.asarray(f(x + h)) - np.asarray(f(x - h))) / (2 * step))
    return np.stack(columns, axis=-1)


def larger(a: Array, b: Array) -> Array:
    """For each parameter the larger of two variances, with the correlations of the second (VI-D1). (q, q) each."""
    sigma_b = np.sqrt(np.diag(b))
    sigma = np.sqrt(np.maximum(np.diag(a), np.diag(b)))
    scale = np.outer(sigma_b, sigma_b)
    correlation = np.divide(b, scale, out=np.eye(len(b)), where=scale > 0)  # nothing may pull at a parameter
    return correlation * np.outer(sigma, sigma)


@dataclass
class Sums:
    """What a sum of Gaussian pair likelihoods says about its maximum, gathered pair by pair.

    information: (q, q). mixed: (n, m, q, d), how each sensor's reading at each step pulls at the parameters:
    a reading that enters several pairs pulls through all of them at once.
    """

    information: Array
    mixed: Array

    @staticmethod
    def zero(q: int, n: int, m: int, d: int = 1) -> "Sums":
        """q parameters, n sensors, m steps, d numbers a reading."""
        return Sums(np.zeros((q, q)), np.zeros((n, m, q, d)))

    def add(
        self, steps: NDArray[np.int64], x: int, y: int, J: Array, weight: NDArray[np.floating], E_x: Array, E_y: Array
    ) -> None:
        """One pair. J: (k, e, q) of its residual by the parameters, at the k steps kept; weight: (k, e, e)
        inverse covariance; E_x, E_y: (k, e, d) of the residual by each reading, or one for all."""
        JtW = np.swapaxes(J, 1, 2) @ weight
        self.information += (JtW @ J).sum(axis=0)
        self.mixed[x, steps] += JtW @ E_x
        self.mixed[y, steps] += JtW @ E_y

    def cramer_rao(self) -> Array:
        """The bound (q, q): the inverse of the information."""
        return np.asarray(np.linalg.pinv(self.information, hermitian=True), dtype=np.float64)

    def approximate_delta(self, cov: Array) -> Array:
        """The approximate delta method (q, q), from each reading's covariance (n, m, d, d)."""
        bound = self.cramer_rao()
        usable = np.where(np.isfinite(cov), cov, 0.0)
        spread = np.einsum("nmqd,nmde,nmre->qr", self.mixed, usable, self.mixed, optimize=True)
        return bound @ spread @ bound
