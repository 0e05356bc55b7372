"""How a reading over an interval of time depends on a latent signal between knots: which knots, and how much."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline

from calib_toolkit.sync import Chain

Array = NDArray[np.float64]
Index = NDArray[np.int64]

PIECES = 8
"""Of an interval, over which twists are added up."""


@dataclass(frozen=True)
class Windows:
    """Which latents n readings depend on: reading k sees ``sum_j weights[k, j] latents[first[k] + j]``.

    first: (n,) not decreasing. weights: (n, m). rate: (n, m) change of the weights as the window moves later, per
    second.
    """

    first: Index
    weights: Array
    rate: Array

    def of(self, latents: Array, weights: Array | None = None) -> Array:
        """What the readings see of latents (K, d), (n, d); or what other weights (n, m) make of them."""
        chosen = self.weights if weights is None else weights
        return np.einsum("nm,nm...->n...", chosen, latents[self.first[:, None] + np.arange(chosen.shape[1])])


def hats(start: float, spacing: float, size: int, a: Array, b: Array) -> Windows:
    """Integrals from a to b (n,) of a signal, linear between ``size`` knots ``spacing`` apart from ``start`` on."""
    reach = int(np.ceil(np.max(b - a) / spacing)) + 2
    first = np.clip(np.floor((a - start) / spacing).astype(np.int64), 0, size - reach)
    k = first[:, None] + np.arange(reach)
    at_a, at_b = ((t[:, None] - start) / spacing - k for t in (a, b))
    rate = np.maximum(0.0, 1 - np.abs(at_b)) - np.maximum(0.0, 1 - np.abs(at_a))
    return Windows(first, spacing * (_area(at_b) - _area(at_a)), rate)


def splines(knots: Array, a: Array, b: Array) -> Windows:
    """Differences from a to b (n,) of a cubic spline with these knots (the ends four times), by its coefficients."""
    size = len(knots) - 4
    (first_a, at_a, slope_a), (first_b, at_b, slope_b) = _basis(knots, a), _basis(knots, b)
    reach = min(int(np.max(first_b - first_a)) + 4, size)
    first = np.minimum(first_a, size - reach)
    weights, rate = np.zeros((len(a), reach)), np.zeros((len(a), reach))
    n = np.arange(len(a))
    for j in range(4):
        weights[n, first_a - first + j] -= at_a[:, j]
        weights[n, first_b - first + j] += at_b[:, j]
        rate[n, first_a - first + j] -= slope_a[:, j]
        rate[n, first_b - first + j] += slope_b[:, j]
    return Windows(first, weights, rate)


def coning(base: Chain, a: Array, b: Array) -> Array:
    """(n, 6) by which the twist from a to b (n,) is more than the sum of the twists in between, ``[v w]``.

    Motions do not commute: ``log T = sum + 1/2 integral [sum so far, twist]`` (Magnus), from the base's own readings.
    """
    knots = a[:, None] + (b - a)[:, None] * np.linspace(0.0, 1.0, PIECES + 1)
    at = base.summed(np.clip(knots, base.knots[0], base.knots[-1]))
    piece, so_far = np.diff(at, axis=1), at[:, :-1] - at[:, :1]
    (v_a, w_a), (v_b, w_b) = ((x[..., :3], x[..., 3:]) for x in (so_far, piece))
    bracket = np.concatenate([np.cross(w_a, v_b) - np.cross(w_b, v_a), np.cross(w_a, w_b)], axis=2)
    return np.asarray(bracket.sum(axis=1) / 2)


def _area(u: Array) -> Array:
    """Of a hat of height one over -1 to 1, left of u."""
    u = np.clip(u, -1.0, 1.0)
    return np.where(u < 0, 0.5 * (1 + u) ** 2, 0.5 + u - 0.5 * u**2)


def _basis(knots: Array, x: Array) -> tuple[Index, Array, Array]:
    """The first of the four B-splines that are not zero at x (n,), their values (n, 4) and slopes (n, 4)."""
    x = np.clip(x, knots[3], knots[-4] - 1e-9)
    values = BSpline.design_matrix(x, knots, 3)
    first = values.indices.reshape(-1, 4)[:, 0].astype(np.int64)
    quadratic = np.zeros((len(x), 5))
    quadratic[:, 1:4] = BSpline.design_matrix(x, knots[1:-1], 2).data.reshape(-1, 3)
    k = first[:, None] + np.arange(4)
    left, right = knots[k + 3] - knots[k], knots[k + 4] - knots[k + 1]
    with np.errstate(divide="ignore", invalid="ignore"):
        rising = np.where(left > 0, quadratic[:, :4] / left, 0.0)
        falling = np.where(right > 0, quadratic[:, 1:] / right, 0.0)
    return first, values.data.reshape(-1, 4), 3 * (rising - falling)
