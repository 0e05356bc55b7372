"""From information to a covariance that holds: less what noise feigns, and more where errors go together in time."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

Array = NDArray[np.float64]
Index = NDArray[np.int64]

LEAST = 0.2
"""Share of the information along a direction that is taken to be real, however much noise feigns."""
BLOCK = 5.0
"""Seconds, at least, over which errors may go together; there are at most ``BLOCKS`` of them in a drive."""
BLOCKS = 60
FEWEST = 8
SURE = 0.9999
"""Share of drives with independent errors that are left alone."""


def covariance(information: Array, feigned: Array, free: Array) -> tuple[Array, Array]:
    """Covariance (p, p), and the gain (p, p) that takes a gradient to the step it causes.

    information, feigned: (p, p). free: (p, k) orthonormal directions that were searched. The noise of the motion
    enters the gradient, but what it adds to the information does not hold the answer: ``D^-1 S D^-1``.
    """
    S, noise = free.T @ information @ free, free.T @ feigned @ free
    L = np.linalg.cholesky(S)
    to = np.linalg.inv(L)
    share, axes = np.linalg.eigh(np.eye(len(S)) - to @ noise @ to.T)
    inverse = to.T @ axes @ np.diag(1 / np.clip(share, LEAST, 1.0)) @ axes.T @ to
    gain = free @ inverse @ free.T
    return gain @ information @ gain, gain


def inflation(
    pulls: Sequence[Array], stamps: Sequence[Array], gain: Array, cov: Array, groups: Sequence[Index]
) -> Array:
    """(p,) by how much each variance is larger because errors near in time go together; one where they do not.

    pulls: (n) of (m, p), each reading's part of the gradient. stamps: (n) of (m,) seconds. Sums over blocks of time
    are compared with what independent errors would make of them, for all parameters of a group together.
    """
    p = len(cov)
    factor = np.ones(p)
    first, last = min(s[0] for s in stamps), max(s[-1] for s in stamps)
    length = max(BLOCK, (last - first) / BLOCKS)
    blocks = int((last - first) / length)
    if blocks < FEWEST or not p:
        return factor
    sums = np.zeros((blocks, p))
    for pull, s in zip(pulls, stamps, strict=True):
        np.add.at(sums, np.minimum(((s - first) / length).astype(np.int64), blocks - 1), pull)
    moved = (sums - sums.mean(axis=0)) @ gain
    for group in groups:
        own = group[np.diag(cov)[group] > 0]
        if not len(own):
            continue
        found = np.linalg.pinv(cov[np.ix_(own, own)], hermitian=True)
        rank = np.linalg.matrix_rank(found, hermitian=True)
        total = blocks * float(np.einsum("bi,ij,bj->", moved[:, own], found, moved[:, own]))
        if total > chi2.ppf(SURE, rank * (blocks - 1)):
            ratio = (moved[:, own] ** 2).sum(axis=0) / np.diag(cov)[own] * blocks / (blocks - 1)
            factor[own] = np.maximum(ratio, 1.0)
    return factor
