"""How a reading over an interval of time depends on a latent signal between knots: which knots, and how much."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline

Array = NDArray[np.float64]
Index = NDArray[np.int64]


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


def reach(longest: float, spacing: float) -> int:
    """How many hats, ``spacing`` apart, a window of ``longest`` seconds can meet."""
    return int(np.ceil(longest / spacing)) + 2


def hats(start: float, spacing: float, size: int, a: Array, b: Array, reach: int) -> Windows:
    """Integrals from a to b (n,) of a signal, linear between ``size`` knots ``spacing`` apart from ``start`` on."""
    first = np.clip(np.floor((a - start) / spacing).astype(np.int64), 0, size - reach)
    k = first[:, None] + np.arange(reach)
    at_a, at_b = ((t[:, None] - start) / spacing - k for t in (a, b))
    rate = np.maximum(0.0, 1 - np.abs(at_b)) - np.maximum(0.0, 1 - np.abs(at_a))
    return Windows(first, spacing * (_area(at_b) - _area(at_a)), rate)


def splines(knots: Array, a: Array, b: Array, reach: int) -> Windows:
    """Differences from a to b (n,) of a cubic spline with these knots (the ends four times), by its coefficients."""
    size = len(knots) - 4
    (first_a, at_a, slope_a), (first_b, at_b, slope_b) = _basis(knots, a), _basis(knots, b)
    first = np.minimum(first_a, size - reach)
    weights, rate = np.zeros((len(a), reach)), np.zeros((len(a), reach))
    n = np.arange(len(a))
    for j in range(4):
        weights[n, first_a - first + j] -= at_a[:, j]
        weights[n, first_b - first + j] += at_b[:, j]
        rate[n, first_a - first + j] -= slope_a[:, j]
        rate[n, first_b - first + j] += slope_b[:, j]
    return Windows(first, weights, rate)


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
