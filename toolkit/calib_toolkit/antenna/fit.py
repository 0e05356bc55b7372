"""Where an antenna sits and how late its clock is, by least squares over all stretches; how noisy both are."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve
from scipy.optimize import minimize
from scipy.stats import chi2

from calib_toolkit.antenna import blocks
from calib_toolkit.antenna.blocks import Base, Block, Index
from calib_toolkit.types import Trajectory

Array = NDArray[np.float64]

ROUNDS = 12
PASSES = 3
"""Times that noise and what is wrong are told anew."""
CLOSE = 0.01
TRUSTED = 0.9999
"""Share of good positions that are let through."""
DOUBT = float(np.log(10.0))
"""Sigma of the logarithm of how many times what was stated a variance is."""
LOOKED_AT = 24
"""Stretches from which the noise is told."""
DRAWS = 8
LEAST = 0.2
"""Share of the information that is taken to be real, however much noise feigns."""
SURE = 0.9999
FAR, LATE = 30.0, 10.0
"""Metres and seconds from where it started that an antenna and its clock may end."""


@dataclass(frozen=True)
class Found:
    """x: (4,) position of the antenna in the base, metres, and offset of its clock, seconds. cov: (4, 4).

    bare, debiased: (4, 4) covariance if all information were real, and without what noise feigns. scale: (3,) of the
    stated variance of positions, and of the base's shifts and turns. rejected: share of positions. stretches: number.
    """

    x: Array
    cov: Array
    bare: Array
    debiased: Array
    scale: Array
    rejected: float
    stretches: int

    def real(self, direction: Array) -> float:
        """Share of the information along a direction (4,) that is not feigned by noise."""
        return float((direction @ self.bare @ direction) / (direction @ self.debiased @ direction))


def estimate(base: Base, positions: Trajectory, dt: float, prior: tuple[Array, Array]) -> Found:
    """From an offset that is right to a second or so. prior: information (4, 4) and its product with values (4,)."""
    x, scale = np.array([0.0, 0.0, 0.0, dt]), np.ones(3)
    rows = blocks.cut(base, positions, dt)
    total = sum(map(len, rows))
    for _ in range(PASSES):
        x, seen = _settle(base, positions, rows, x, scale, prior)
        scale = _noise(seen, scale)
        rows = _good(rows, seen, scale)
    x, seen = _settle(base, positions, rows, x, scale, prior)
    weighed = [_reduced(b, b.by_antenna, scale) for b in seen]
    S = sum((w[0] for w in weighed), prior[0])
    rng = np.random.default_rng(0)
    feigned = np.zeros((4, 4))
    for b in seen:
        for _ in range(DRAWS):
            feigned += _reduced(b, blocks.errors(b, x[:3], scale[1:], rng), scale)[0] / DRAWS
    to = np.linalg.inv(np.linalg.cholesky(S))
    share, axes = np.linalg.eigh(np.eye(4) - to @ feigned @ to.T)
    debiased = to.T @ axes @ np.diag(1 / np.clip(share, LEAST, 1.0)) @ axes.T @ to
    cov = debiased @ S @ debiased
    wider = np.sqrt(_inflation(np.array([w[1] for w in weighed]), debiased, cov))
    rejected = 1 - sum(map(len, rows)) / max(total, 1)
    return Found(x, cov * np.outer(wider, wider), to.T @ to, debiased, scale, rejected, len(rows))


def _settle(
    base: Base, positions: Trajectory, rows: Sequence[Index], x: Array, scale: Array, prior: tuple[Array, Array]
) -> tuple[Array, list[Block]]:
    """Rounds of Gauss-Newton, noise standing still."""
    for _ in range(ROUNDS):
        R, _, _ = blocks.turned(base, positions, rows, x[3], x[:3])
        seen = [blocks.against(base, positions, r, Q, x[3], x[:3]) for r, Q in zip(rows, R, strict=True)]
        parts = [_reduced(b, b.by_antenna, scale) for b in seen]
        wide = np.diag(1 / np.array([FAR, FAR, FAR, LATE]) ** 2)
        S = sum((s for s, _ in parts), prior[0] + wide)
        g = sum((g for _, g in parts), prior[1] - prior[0] @ x)
        step = np.linalg.solve(S, g)
        step[3] = np.clip(step[3], -1.0, 1.0)
        x = x + step
        if np.max(np.abs(step) * np.sqrt(np.diag(S))) < CLOSE:
            break
    return x, seen


def _reduced(b: Block, by: Array, scale: Array) -> tuple[Array, Array]:
    """Information (4, 4) and gradient (4,) with what belongs to the stretch alone eliminated."""
    k = len(b.residual)
    W = cho_factor(_covariance(b, scale))
    X, own = by.reshape(3 * k, -1), b.by_own.reshape(3 * k, 6)
    all_ = np.column_stack([X, own, b.residual.ravel()])
    M = all_.T @ cho_solve(W, all_)
    n = X.shape[1]
    held = M[n : n + 6, n : n + 6] + np.diag([0.0, 0.0, 0.0, *[blocks.TURNED**-2] * 3])
    gain = M[:n, n : n + 6] @ np.linalg.inv(held)
    left = M[:n] - gain @ M[n : n + 6]
    return left[:, :n], -left[:, -1]


def _covariance(b: Block, scale: Array) -> Array:
    k = len(b.residual)
    cov = scale[1] * b.grown[0] + scale[2] * b.grown[1]
    at = np.arange(k)
    full = cov.reshape(k, 3, k, 3)
    full[at, :, at, :] += scale[0] * b.noise + 1e-8 * np.eye(3)
    return full.reshape(3 * k, 3 * k)


def _noise(seen: Sequence[Block], scale: Array) -> Array:
    """(3,) by which stated variances are to be multiplied: the most likely (REML), told loosely by what is stated."""
    some = [seen[i] for i in np.unique(np.linspace(0, len(seen) - 1, LOOKED_AT).astype(int))]

    def unlikely(log_scale: Array) -> float:
        total = float(log_scale @ log_scale) / DOUBT**2
        S = np.eye(4) * 1e-6
        for b in some:
            k = len(b.residual)
            L = np.linalg.cholesky(_covariance(b, np.exp(log_scale)))
            all_ = np.column_stack([b.by_own.reshape(3 * k, 6), b.by_antenna.reshape(3 * k, 4), b.residual.ravel()])
            M = np.linalg.solve(L, all_)
            A, r, X = M[:, :6], M[:, -1], M[:, 6:10]
            info = A.T @ A + 1e-9 * np.eye(6)
            gain = np.linalg.solve(info, A.T @ np.column_stack([r, X]))
            r, X = r - A @ gain[:, 0], X - A @ gain[:, 1:]
            S += X.T @ X
            total += float(r @ r) + 2 * np.log(np.diag(L)).sum() + np.linalg.slogdet(info)[1]
        return total + float(np.linalg.slogdet(S)[1])

    start = np.log(scale) + np.concatenate([np.zeros((1, 3)), np.eye(3)])
    options = {"initial_simplex": start, "xatol": 0.03, "fatol": 0.05}
    found = minimize(unlikely, start[0], method="Nelder-Mead", options=options)
    return np.asarray(np.exp(found.x))


def _good(rows: Sequence[Index], seen: Sequence[Block], scale: Array) -> list[Index]:
    """The positions that the others of their stretch do not contradict."""
    kept = []
    for r, b in zip(rows, seen, strict=True):
        k = len(r)
        P = np.linalg.inv(_covariance(b, scale))
        own = b.by_own.reshape(3 * k, 6)
        P = P - P @ own @ np.linalg.pinv(own.T @ P @ own, hermitian=True) @ own.T @ P
        pulled = (P @ b.residual.ravel()).reshape(k, 3)
        each = P.reshape(k, 3, k, 3)[np.arange(k), :, np.arange(k), :]
        squared = np.einsum("ki,kij,kj->k", pulled, np.linalg.pinv(each, hermitian=True), pulled)
        good = squared < chi2.ppf(TRUSTED, 3)
        if good.sum() >= blocks.FEWEST:
            kept.append(r[good])
    return kept


def _inflation(pulls: Array, gain: Array, cov: Array) -> Array:
    """(4,) by how much variances are larger since errors go together within a stretch. pulls: (b, 4)."""
    n = len(pulls)
    if n < 8:
        return np.ones(4)
    moved = (pulls - pulls.mean(axis=0)) @ gain
    total = n * float(np.einsum("bi,ij,bj->", moved, np.linalg.inv(cov), moved))
    if total < chi2.ppf(SURE, 4 * (n - 1)):
        return np.ones(4)
    return np.maximum((moved**2).sum(axis=0) / np.diag(cov) * n / (n - 1), 1.0)
