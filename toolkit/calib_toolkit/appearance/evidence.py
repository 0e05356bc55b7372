"""What the costs around the best pose tell of it, and how well: the delta method, by moments of the drive (VII-A).

The mean cost over the moments is taken as a parabola near its least value; how differently each moment slopes there
says how far another drive's moments would have moved it. Nothing of the motion's own estimate is in the answer.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

SAMPLES = 100
ROUNDS = 6
NEAR = 4.0
"""Steps from the best pose within which earlier ones still show the parabola."""
STEP = 2.0
"""Steps of the parabola that the pose moves at a time, at most."""
WIDEST = 1.0
"""Sigma of the motion, to which a parabola is fitted at most."""
NOTHING = 1e2
"""Sigma of the motion, along what the cost says nothing of."""


@dataclass(frozen=True)
class Evidence:
    """z: (6,) and cov: (6, 6), whitened: of appearance alone. posterior: (6,) with the motion's estimate.

    costs: (m,) there, at each of the moments that were compared. clear: standard errors by which their mean is better
    there than a sigma of the motion away. apart: from where another search ended, in sigma of the motion.
    """

    z: Array
    cov: Array
    posterior: Array
    costs: Array
    clear: float
    apart: float = 0.0


def evidence(cost: Callable[[Array], Array], z: Array, least: Array, seed: int) -> Evidence:
    """Of costs (k, m) at poses (k, 6) and m moments. z: (6,) about the most likely. least: (6, 6) covariance of the
    steps that show a parabola, where the answer is sharper.
    """
    rng = np.random.default_rng(seed)
    C, posterior = np.linalg.cholesky(least), z
    poses, costs = np.zeros((0, 6)), None
    for _ in range(ROUNDS):
        half = rng.normal(size=(SAMPLES // 2, 6)) @ C.T
        new = posterior + np.concatenate([half, -half])
        seen = cost(new)
        poses, costs = np.concatenate([poses, new]), seen if costs is None else np.concatenate([costs, seen])
        to = np.linalg.inv(C)
        step = (poses - posterior) @ to.T
        near = np.sum(step**2, axis=1) < NEAR**2
        information, pull = _told(*_parabola(step[near], costs[near]))
        information, pull = to.T @ information @ to, to.T @ pull
        both = np.linalg.inv(information + np.eye(6))
        moved = both @ (pull - posterior)
        most = STEP / max(float(np.linalg.norm(to @ moved)), 1e-9)
        cov = np.asarray(np.linalg.inv(information + np.eye(6) / NOTHING**2), np.float64)
        z = np.asarray(posterior + cov @ pull, np.float64)
        posterior = np.asarray(posterior + moved * min(1.0, most), np.float64)
        C = np.linalg.cholesky(np.linalg.inv(information + np.eye(6) / WIDEST**2) + least)
    here = cost(posterior[None])[0]
    better = cost(posterior + rng.normal(size=(SAMPLES // 4, 6))).mean(axis=0) - here
    m = len(here)
    clear = float(better.mean() / (better.std(ddof=1) / np.sqrt(m) + 1e-12))
    return Evidence(z, cov, posterior, here, clear)


def _parabola(step: Array, seen: Array) -> tuple[Array, Array]:
    """Slopes of each moment (m, 6) and the curvature of the mean (6, 6), by least squares over steps (k, 6)."""
    i, j = np.triu_indices(6)
    design = np.column_stack([np.ones(len(step)), step, step[:, i] * step[:, j]])
    found = np.linalg.lstsq(design, seen, rcond=None)[0]
    H = np.zeros((6, 6))
    H[i, j] = found[7:].mean(axis=1)
    slope: Array = np.asarray(found[1:7].T, dtype=np.float64)
    return slope, H + H.T


def _told(slope: Array, H: Array) -> tuple[Array, Array]:
    """Information ``H G^-1 H`` and pull ``-H G^-1 g``, of which the inverse covariance and the step follow.

    slope: (m, 6), of mean g and covariance G of the mean. Along what has no curvature both are zero.
    """
    values, axes = np.linalg.eigh(H)
    H = (axes * np.maximum(values, 0.0)) @ axes.T
    G = np.cov(slope.T) / max(len(slope) - 8, 1)  # few moments make the inverse too large
    G += 1e-9 * np.trace(G) * np.eye(6)
    told: Array = H @ np.linalg.solve(G, np.column_stack([H, -slope.mean(axis=0)]))
    return told[:, :6], told[:, 6]
