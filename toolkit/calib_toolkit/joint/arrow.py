"""Least squares with a signal that nobody saw (many latents, each met by neighbours only) and a few parameters.

The normal equations look like an arrow: a band for the latents, a narrow border for the parameters. Neighbouring
latents are put together until the band is block-tridiagonal; cost and memory grow with the length of the drive.
"""

import math
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_solve_banded, cholesky_banded
from scipy.linalg.lapack import dtbtrs
from scipy.sparse import csc_array

from calib_toolkit.joint.windows import Index, Windows

Array = NDArray[np.float64]


class Arrow:
    """Normal equations being summed up.

    size, width: (size, width) latents. reach: how many neighbours one reading may meet. parameters: how many.
    information: (p, p) and gradient: (p,) of the parameters alone, to which anything may be added.
    """

    def __init__(self, size: int, width: int, reach: int, parameters: int) -> None:
        self.size, self.width = size, width
        self._per = max(reach - 1, 2)
        self._blocks = -(-size // self._per)
        padded = self._blocks * self._per
        self._band = np.zeros((padded, reach, width, width))
        self._band[size:, 0] = np.eye(width)
        self._pull = np.zeros((padded, width))
        self._cross = np.zeros((padded, width, parameters))
        self.information = np.zeros((parameters, parameters))
        self.gradient = np.zeros(parameters)

    def add(self, windows: Windows, by_latent: Array, weight: Array, residual: Array) -> None:
        """Readings with residuals (n, d) of weight (n, d, d), which change by by_latent (n, d, width)."""
        JW = np.swapaxes(by_latent, 1, 2) @ weight
        hessian, pull = JW @ by_latent, (JW @ residual[..., None])[..., 0]
        w, m = windows.weights, windows.weights.shape[1]
        self._pull += _summed(w, windows.first, pull, len(self._pull))
        for j in range(m):
            self._band[:, j] += _summed(w[:, j:] * w[:, : m - j], windows.first, hessian, len(self._band))

    def add_parameters(
        self, columns: Index, by_parameter: Array, windows: Windows, by_latent: Array, weight: Array, residual: Array
    ) -> None:
        """The same readings once more, by some of the parameters: by_parameter (n, d, q) for the columns (q,)."""
        LW = np.swapaxes(by_parameter, 1, 2) @ weight
        self.information[np.ix_(columns, columns)] += np.einsum("nqd,ndr->qr", LW, by_parameter)
        self.gradient[columns] += np.einsum("nqd,nd->q", LW, residual)
        cross = np.swapaxes(LW @ by_latent, 1, 2)
        self._cross[:, :, columns] += _summed(windows.weights, windows.first, cross, len(self._cross))

    def add_prior(self, stencil: Array, latents: Array, precision: Array) -> None:
        """A difference of neighbouring latents is about zero. stencil: (s,). precision: (width, width)."""
        n = self.size - len(stencil) + 1
        off = np.sum([c * latents[j : j + n] for j, c in enumerate(stencil)], axis=0)
        for j, a in enumerate(stencil):
            self._pull[j : j + n] -= a * off @ precision
            for k in range(j + 1):
                self._band[k : k + n, j - k] += a * stencil[k] * precision

    def hold(self, knot: int, precision: float) -> None:
        """Keep one latent about where it is."""
        self._band[knot, 0] += precision * np.eye(self.width)

    def solved(self) -> "Solved":
        """Factorised, and the latents eliminated."""
        return Solved(self)


class Solved:
    """What is left for the parameters once the latents are eliminated, and the latents' own covariance.

    information: (p, p) and gradient: (p,) of the parameters. response: (size, width, p) by how much the latents
    move against each parameter.
    """

    def __init__(self, arrow: Arrow) -> None:
        self._size, self._width, self._per = arrow.size, arrow.width, arrow._per
        self._factor = cholesky_banded(_lower(arrow._band), overwrite_ab=True, lower=True, check_finite=False)
        found = self._solve(np.concatenate([arrow._pull[:, :, None], arrow._cross], axis=2))
        self._alone, self.response = found[: self._size, :, 0], found[: self._size, :, 1:]
        cross = arrow._cross[: self._size]
        self.information = arrow.information - np.einsum("kdp,kdq->pq", cross, self.response)
        self.gradient = arrow.gradient - np.einsum("kdp,kd->p", cross, self._alone)

    def latents(self, parameters: Array) -> Array:
        """(size, width) how far the latents move when the parameters move by (p,)."""
        return np.asarray(self._alone - self.response @ parameters)

    def schur(self, other: Arrow) -> Array:
        """(p, p) information of another arrow's parameters, its latents eliminated by this one's band."""
        found = self._solve(other._cross)
        return np.asarray(other.information - np.einsum("kdp,kdq->pq", other._cross, found))

    def sample(self, rng: np.random.Generator) -> Array:
        """(size, width) one draw of the latents' error, parameters given."""
        left = rng.normal(size=self._factor.shape[1])
        found, _ = dtbtrs(self._factor, left, uplo="L", trans="T")
        return np.asarray(found).reshape(-1, self._width)[: self._size]

    def covariance(self, windows: Windows, left: Array | None = None) -> Array:
        """(n, width, width) of what the readings see of the latents, parameters given.

        left: other weights (n, m) of the side that is written first.
        """
        right, d = windows.weights, self._width
        left = right if left is None else left
        n, m = right.shape
        out = np.empty((n, d, d))
        block, place = np.divmod(windows.first, self._per)
        for p in range(self._per):
            own, of = np.flatnonzero(place == p), slice(p * d, (p + m) * d)
            near = self._inverse[block[own], of, of].reshape(-1, m, d * m * d)
            half = (left[own, None, :] @ near).reshape(-1, d, m, d)
            out[own] = np.einsum("nimj,nm->nij", half, right[own])
        return out

    @cached_property
    def _inverse(self) -> Array:
        """(n, 2b, 2b) of the band's inverse, each block of latents with the next one (Takahashi's recursion)."""
        L, C = _blocks(self._factor, self._per * self._width)
        n, b, _ = L.shape
        inner = np.linalg.inv(L)
        own, through = np.swapaxes(inner, 1, 2) @ inner, C @ inner[:-1]
        found = np.zeros((n, 2 * b, 2 * b))
        later = found[-1, :b, :b] = own[-1]
        for k in range(n - 2, -1, -1):
            below = -later @ through[k]
            found[k, b:, b:], found[k, b:, :b] = later, below
            later = found[k, :b, :b] = own[k] - through[k].T @ below
        found[:-1, :b, b:] = np.swapaxes(found[:-1, b:, :b], 1, 2)
        return found

    def _solve(self, rhs: Array) -> Array:
        """The band's system for (padded, width, q) right-hand sides."""
        flat = rhs.reshape(self._factor.shape[1], rhs.shape[2])
        return np.asarray(cho_solve_banded((self._factor, True), flat, check_finite=False)).reshape(rhs.shape)


def _summed(weights: Array, first: Index, values: Array, size: int) -> Array:
    """(size, ...) sums of values (n, ...), each by its weights (n, m) for m neighbours from the first (n,) on."""
    n, m = weights.shape
    latents = (first[:, None] + np.arange(m)).ravel()
    matrix = csc_array((weights.ravel(), latents, np.arange(0, n * m + 1, m)), shape=(size, n))
    return np.asarray(matrix @ values.reshape(n, math.prod(values.shape[1:]))).reshape(size, *values.shape[1:])


def _lower(band: Array) -> Array:
    """(reach * d, size * d) lower form of a band (size, reach, d, d), as LAPACK has it."""
    size, reach, d, _ = band.shape
    out = np.zeros((reach * d, size, d))
    for row in range(d):
        for column in range(d):
            of = slice(0 if row >= column else 1, reach)  # above the diagonal there is its mirror image
            out[of.start * d + row - column :: d, :, column][: reach - of.start] = band[:, of, row, column].T
    return out.reshape(reach * d, -1)


def _blocks(factor: Array, b: int) -> tuple[Array, Array]:
    """Diagonal blocks (n, b, b) of a lower factor in LAPACK's form, and those below them (n - 1, b, b)."""
    of, (row, column) = factor.reshape(len(factor), -1, b), np.indices((b, b))

    def shifted(by: int) -> Array:
        off = row - column + by
        held = (off >= 0) & (off < len(of))
        return np.where(held, np.moveaxis(of[np.where(held, off, 0), :, column], 2, 0), 0.0)

    return shifted(0), shifted(b)[:-1]
