"""Errors that several estimates have in common, of which only a share can be averaged away.

Metrics that look at the same frames fail alike, and all pairs of one lidar or camera see through its intrinsics and
its motion. How much of an estimate's variance that is, no metric can say; a fixed share of it is taken. The common
error is no larger, along any direction, than that share of the *smallest* of the variances, so that a precise
estimate never borrows from a coarse one (with a fixed correlation it would, by weighing the coarse one negatively).
"""

from collections.abc import Hashable, Sequence
from functools import reduce

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from calib_toolkit.combine.factors import Factor

Array = NDArray[np.float64]

FRAMES, SENSOR = 0.4, 0.2
"""Shares of the variance that are the pair's, common to all its metrics, and each of its two sensors', common to all
their pairs. Equally good metrics of one pair are thus correlated by 0.8, pairs with one sensor in common by 0.2."""
ANYWHERE = 10.0
"""Sigma of numbers that an estimate says nothing of, metres or radians."""


def covariance(factors: Sequence[Factor], T: Array) -> Array:
    """(m, m) of all residuals, one estimate after the other. T: (n, 4, 4) about right.

    Every estimate's own block stays what it is. An error of a sensor acts on all its pairs as if it stood elsewhere.
    """
    cov = np.asarray(block_diag(*(f.cov for f in factors)))
    ends = np.cumsum([0, *(len(f.cov) for f in factors)])
    common: dict[Hashable, list[tuple[int, Array]]] = {}
    for k, f in enumerate(factors):
        _, by_a, by_b = f.linear(T, np.zeros(len(T)))
        for source, by_error in ((f.a, by_a), (f.b, by_b), ((f.a, f.b), by_b)):
            common.setdefault(source, []).append((k, by_error))
    for name, members in common.items():
        share = FRAMES if isinstance(name, tuple) else SENSOR
        known = reduce(larger, (by_error.T @ np.linalg.inv(factors[k].cov) @ by_error for k, by_error in members))
        error = share * np.linalg.inv(known + np.eye(6) / ANYWHERE**2)
        for k, by_k in members:
            for j, by_j in members:
                if j != k:
                    cov[ends[k] : ends[k + 1], ends[j] : ends[j + 1]] += by_k @ error @ by_j.T
    return cov


def larger(A: Array, B: Array) -> Array:
    """Information (p, p) that is at least A and at least B along every direction, and no more than need be."""
    both = A + B
    L = np.linalg.cholesky(both + 1e-12 * np.trace(both) * np.eye(len(both)))
    back = np.linalg.inv(L)
    part, axes = np.linalg.eigh(back @ (A - B) @ back.T)
    axes = L @ axes
    return np.asarray((both + (axes * np.abs(part)) @ axes.T) / 2)
