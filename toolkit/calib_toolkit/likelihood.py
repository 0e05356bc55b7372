"""What the three stages share: all pairs of sensors, the trimmed sum of their log-likelihoods, the simplex search.

Section VI-C of the paper.
"""

from collections.abc import Callable
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

Array = NDArray[np.float64]
LOG_2PI = float(np.log(2 * np.pi))


def all_pairs(n: int) -> list[tuple[int, int]]:
    """Each pair of sensors once, x before y.

    Equation (17) as printed sums every pair in both orders; that doubles the log-likelihood, leaves its
    maximum where it is, and would halve every variance, so each pair enters once.
    """
    return list(combinations(range(n), 2))


def trimmed(log_likelihoods: Array, trim: float) -> tuple[float, NDArray[np.bool_]]:
    """Sum of the best ``1 - trim`` of one pair's log-likelihoods (m,), and which those are (VI-C1)."""
    keep = np.zeros(len(log_likelihoods), dtype=bool)
    drop = int(trim * len(log_likelihoods))
    keep[np.argpartition(log_likelihoods, drop)[drop:] if drop else slice(None)] = True
    return float(log_likelihoods[keep].sum()), keep


def log_normal(residual: Array, variance: Array) -> Array:
    """Log density of scalar residuals (m,) under N(0, variance) (m,): the logarithm of equation (9)."""
    return -0.5 * (residual**2 / variance + np.log(variance) + LOG_2PI)


def log_normal_3d(residual: Array, cov: Array) -> Array:
    """Log density of residuals (m, 3) under N(0, cov) (m, 3, 3): the logarithm of equations (13) and (15).

    Closed form for symmetric 3x3 matrices: this is where an evaluation spends its time.
    """
    a, b, c = cov[:, 0, 0], cov[:, 0, 1], cov[:, 0, 2]
    d, e, f = cov[:, 1, 1], cov[:, 1, 2], cov[:, 2, 2]
    A, B, C = d * f - e * e, c * e - b * f, b * e - c * d
    D, E, F = a * f - c * c, b * c - a * e, a * d - b * b
    det = a * A + b * B + c * C
    x, y, z = residual.T
    squared = (A * x * x + D * y * y + F * z * z + 2 * (B * x * y + C * x * z + E * y * z)) / det
    return -0.5 * (squared + np.log(det) + 3 * LOG_2PI)


def maximise(log_likelihood: Callable[[Array], float], start: Array, cov: Array) -> Array:
    """Nelder-Mead simplex search (VI-C2), in units of the sigma that the answer is expected to have.

    start: (q,). cov: (q, q) about that of the answer; it shapes the first simplex and the tolerance, a
    hundredth of a sigma. The search begins again from its own answer until that stands still. Returns (q,).
    """
    if start.size == 0:
        return start
    variance, axes = np.linalg.eigh(cov)
    shape = axes * np.sqrt(np.maximum(variance, 1e-12 * variance.max(initial=0.0)))
    best, value, size = np.zeros(start.size), -log_likelihood(start), 3.0
    for _ in range(5):
        found = minimize(
            lambda u: -log_likelihood(start + shape @ u),
            best,
            method="Nelder-Mead",
            options={
                "initial_simplex": np.vstack([best, best + size * np.eye(start.size)]),
                "xatol": 0.01,
                "fatol": 1e-4,
                "adaptive": start.size > 3,
                "maxfev": 400 * start.size,
            },
        )
        moved, gained = np.max(np.abs(found.x - best)), value - found.fun
        best, value, size = found.x, found.fun, 1.0
        if moved < 0.05 or gained < 1e-3:
            break
    return start + shape @ best
