"""Least squares with a signal that nobody saw (many latents, each met by neighbours only) and a few parameters.

The normal equations look like an arrow: a band for the latents, a narrow border for the parameters. Neighbouring
latents are put together until the band is block-tridiagonal; cost and memory grow with the length of the drive.
"""

from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular

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
        """A difference of neighbouring latents (size, width) is about zero. stencil: (s,). precision: (width,)."""
        n = self.size - len(stencil) + 1
        off = sum(c * latents[j : j + n] for j, c in enumerate(stencil))
        for j, a in enumerate(stencil):
            self._pull[j : j + n] -= a * precision * off
            for k in range(j + 1):
                self._band[k : k + n, j - k] += a * stencil[k] * np.diag(precision)

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
            left[k] = solve_triangular(L[k], behind, lower=True, trans=1, check_finite=False)
        return left.reshape(-1, self._width)[: self._size]

    def covariance(self, windows: Windows, left: Array | None = None) -> Array:
        """(n, width, width) of what the readings see of the latents, parameters given.

        left: other weights (n, m) of the side that is written first.
        """
        right = windows.weights
        left = right if left is None else left
        out = np.zeros((len(right), self._width, self._width))
        for j in range(right.shape[1]):
            for k in range(j + 1):
                block = self._between(windows.first + j, windows.first + k)
                out += (left[:, j] * right[:, k])[:, None, None] * block
                if k < j:
                    out += (left[:, k] * right[:, j])[:, None, None] * np.swapaxes(block, 1, 2)
        return out

    @cached_property
    def _inverse(self) -> tuple[Array, Array]:
        """The blocks of the band's inverse on and below the diagonal (Takahashi's recursion)."""
        L, C = self._factors
        diagonal, below = np.empty_like(L), np.empty_like(C)
        eye = np.eye(L.shape[1])
        for k in range(len(L) - 1, -1, -1):
            inner = solve_triangular(L[k], eye, lower=True, check_finite=False)
            diagonal[k] = inner.T @ inner
            if k < len(C):
                through = C[k] @ inner
                below[k] = -diagonal[k + 1] @ through
                diagonal[k] += through.T @ diagonal[k + 1] @ through
        return diagonal, below

    def _between(self, a: Index, b: Index) -> Array:
        """(n, width, width) covariance of latents a with b, a not before b and at most a block after."""
        per, d = self._per, self._width
        diagonal, below = (m.reshape(len(m), per, d, per, d) for m in self._inverse)
        out = np.empty((len(a), d, d))
        same = a // per == b // per
        i, j = a[same], b[same]
        out[same] = diagonal[i // per, i % per, :, j % per, :]
        i, j = a[~same], b[~same]
        out[~same] = below[j // per, i % per, :, j % per, :]
        return out

    def _solve(self, rhs: Array) -> Array:
        """The band's system for (padded, width, q) right-hand sides."""
        L, C = self._factors
        y = rhs.reshape(len(L), L.shape[1], -1).copy()
        for k in range(len(L)):
            left = y[k] - C[k - 1] @ y[k - 1] if k else y[k]
            y[k] = solve_triangular(L[k], left, lower=True, check_finite=False)
        for k in range(len(L) - 1, -1, -1):
            left = y[k] - C[k].T @ y[k + 1] if k < len(C) else y[k]
            y[k] = solve_triangular(L[k], left, lower=True, trans=1, check_finite=False)
        return y.reshape(rhs.shape)


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
            C[k] = solve_triangular(L[k], below[k].T, lower=True, check_finite=False).T
    return L, C
