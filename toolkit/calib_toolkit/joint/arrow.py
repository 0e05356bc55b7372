"""Least squares with a signal that nobody saw (many latents, each met by neighbours only) and a few parameters.

The normal equations look like an arrow: a band for the latents, a narrow border for the parameters. Neighbouring
latents are put together until the band is block-tridiagonal; cost and memory grow with the length of the drive.
"""

from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.blas import dtrsm

from calib_toolkit.joint.windows import Index, Windows

Array = NDArray[np.float64]

CHUNK = 4096
"""Readings whose latents are looked up at once."""


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
        w = windows.weights
        for j in range(w.shape[1]):
            _scatter(self._pull, windows.first + j, w[:, j, None] * pull)
            for k in range(j + 1):
                _scatter(self._band[:, j - k], windows.first + k, (w[:, j] * w[:, k])[:, None, None] * hessian)

    def add_parameters(
        self, columns: Index, by_parameter: Array, windows: Windows, by_latent: Array, weight: Array, residual: Array
    ) -> None:
        """The same readings once more, by some of the parameters: by_parameter (n, d, q) for the columns (q,)."""
        LW = np.swapaxes(by_parameter, 1, 2) @ weight
        self.information[np.ix_(columns, columns)] += np.einsum("nqd,ndr->qr", LW, by_parameter)
        self.gradient[columns] += np.einsum("nqd,nd->q", LW, residual)
        cross = np.swapaxes(LW @ by_latent, 1, 2)
        summed = np.zeros((*self._pull.shape, len(columns)))
        for j in range(windows.weights.shape[1]):
            _scatter(summed, windows.first + j, windows.weights[:, j, None, None] * cross)
        self._cross[:, :, columns] += summed

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
        self._factors = _factorise(*_blocks(arrow._band, arrow._per))
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
        L, C = self._factors
        left = rng.normal(size=(len(L), L.shape[1], 1))
        for k in range(len(L) - 1, -1, -1):
            behind = left[k] if k == len(C) else left[k] - C[k].T @ left[k + 1]
            left[k] = _backward(L[k], behind)
        return left.reshape(-1, self._width)[: self._size]

    def covariance(self, windows: Windows, left: Array | None = None) -> Array:
        """(n, width, width) of what the readings see of the latents, parameters given.

        left: other weights (n, m) of the side that is written first.
        """
        right, d = windows.weights, self._width
        left = right if left is None else left
        n, m = right.shape
        left, right = ((w[:, :, None, None] * np.eye(d)).reshape(n, m * d, d) for w in (left, right))
        out = np.empty((n, d, d))
        for part in (slice(k, k + CHUNK) for k in range(0, n, CHUNK)):
            block, place = np.divmod(windows.first[part], self._per)
            at = (place * d)[:, None] + np.arange(m * d)
            near = self._inverse[block[:, None, None], at[:, :, None], at[:, None, :]]
            out[part] = np.swapaxes(left[part], 1, 2) @ (near @ right[part])
        return out

    @cached_property
    def _inverse(self) -> Array:
        """(n, 2b, 2b) of the band's inverse, each block of latents with the next one (Takahashi's recursion)."""
        L, C = self._factors
        n, b, _ = L.shape
        found, eye = np.zeros((n, 2 * b, 2 * b)), np.eye(b)
        for k in range(n - 1, -1, -1):
            inner = _forward(L[k], eye)
            own = inner.T @ inner
            if k < n - 1:
                through = C[k] @ inner
                later = found[k + 1, :b, :b]
                below = -later @ through
                own -= through.T @ below
                found[k, b:, b:], found[k, b:, :b], found[k, :b, b:] = later, below, below.T
            found[k, :b, :b] = own
        return found

    def _solve(self, rhs: Array) -> Array:
        """The band's system for (padded, width, q) right-hand sides."""
        L, C = self._factors
        y = rhs.reshape(len(L), L.shape[1], -1).copy()
        for k in range(len(L)):
            y[k] = _forward(L[k], y[k] - C[k - 1] @ y[k - 1] if k else y[k])
        for k in range(len(L) - 1, -1, -1):
            y[k] = _backward(L[k], y[k] - C[k].T @ y[k + 1] if k < len(C) else y[k])
        return y.reshape(rhs.shape)


def _forward(L: Array, rhs: Array) -> Array:
    """``L x = rhs``, without what a checked call costs: it is made once for each block."""
    return np.asarray(dtrsm(1.0, L.T, rhs.T, side=1, lower=0).T)


def _backward(L: Array, rhs: Array) -> Array:
    """``L^T x = rhs``."""
    return np.asarray(dtrsm(1.0, L.T, rhs.T, side=1, lower=0, trans_a=1).T)


def _scatter(into: Array, index: Index, values: Array) -> None:
    """``into[index] += values`` for an index that does not decrease."""
    if len(index):
        starts = np.concatenate([[0], np.flatnonzero(np.diff(index)) + 1])
        into[index[starts]] += np.add.reduceat(values, starts, axis=0)


def _blocks(band: Array, per: int) -> tuple[Array, Array]:
    """Diagonal blocks (n, b, b) and those below them (n - 1, b, b) of a band (size, reach, d, d)."""
    size, reach, d, _ = band.shape
    n = size // per
    diagonal, below = np.zeros((n, per * d, per * d)), np.zeros((n - 1, per * d, per * d))
    of = band.reshape(n, per, reach, d, d)
    for k in range(per):
        for j in range(reach):
            row, column = (slice(i % per * d, (i % per + 1) * d) for i in (k + j, k))
            if k + j < per:
                diagonal[:, row, column] = of[:, k, j]
                diagonal[:, column, row] = np.swapaxes(of[:, k, j], 1, 2)
            else:
                below[:, row, column] = of[:-1, k, j]
    return diagonal, below


def _factorise(diagonal: Array, below: Array) -> tuple[Array, Array]:
    """Cholesky factors: (n, b, b) on the diagonal and (n - 1, b, b) below it."""
    L, C = np.empty_like(diagonal), np.empty_like(below)
    for k in range(len(L)):
        left = diagonal[k] - C[k - 1] @ C[k - 1].T if k else diagonal[k]
        L[k] = np.linalg.cholesky(left)
        if k < len(C):
            C[k] = _forward(L[k], below[k].T).T
    return L, C
