"""The epipolar geometry of two calibrated views: essential matrix, pose, refinement and its covariance.

Points are *normalised*: undistorted, on the plane z = 1 of camera axes (x right, y down, z forward). With
``T_prev_curr`` = (R, t), ``x_prev^T [t]x R x_curr = 0``; only the direction of t can be seen. Five parameters:
``delta`` of ``R_true = Exp(delta) R`` and two in the tangent plane of the unit direction.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from calib_toolkit import se3

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

EPIPOLE = 20.0  # sigmas around an epipole in which points count less and less
ALIKE = 1e6  # sigmas of a residual, at which all points count alike


@dataclass(frozen=True)
class Points:
    """Normalised points of one image. xy: (n, 2). cov: (n, 2, 2), the noise of each."""

    xy: Array
    cov: Array

    def __getitem__(self, part: Mask) -> "Points":
        return Points(self.xy[part], self.cov[part])

    @property
    def rays(self) -> Array:
        """(n, 3) with z = 1."""
        return np.column_stack([self.xy, np.ones(len(self.xy))])


def tangent(t: Array) -> Array:
    """Two unit vectors across a unit direction: (3, 2)."""
    return np.linalg.svd(t[:, None])[0][:, 1:]


def eight_point(prev: Points, curr: Points) -> Array:
    """Essential matrix (3, 3) by the normalised eight-point algorithm; singular values (1, 1, 0). Needs 8 points."""
    a, N_a = _hartley(prev.rays)
    b, N_b = _hartley(curr.rays)
    A = np.einsum("ni,nj->nij", a, b).reshape(-1, 9)
    F = np.linalg.eigh(A.T @ A)[1][:, 0].reshape(3, 3)
    U, _, Vt = np.linalg.svd(N_a.T @ F @ N_b)
    return U @ np.diag([1.0, 1.0, 0.0]) @ Vt


def pose_of(E: Array, prev: Points, curr: Points) -> tuple[Array, Array]:
    """(R, t) of an essential matrix: of its four poses the one with most points in front of both cameras."""
    U, _, Vt = np.linalg.svd(E)
    W = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    turns = [R * np.linalg.det(R) for R in (U @ W @ Vt, U @ W.T @ Vt)]
    poses = [(R, t) for R in turns for t in (U[:, 2], -U[:, 2])]
    return max(poses, key=lambda pose: np.sum(in_front(prev, curr, *pose)))


def in_front(prev: Points, curr: Points, R: Array, t: Array) -> Mask:
    """(n,) whether the point nearest to both rays has positive depth in both cameras (cheirality)."""
    a, b = prev.rays, curr.rays @ R.T
    aa, bb, ab = np.sum(a * a, 1), np.sum(b * b, 1), np.sum(a * b, 1)
    at, bt = a @ t, b @ t
    return (at * bb - ab * bt > 0) & (ab * at - aa * bt > 0)


def sampson(prev: Points, curr: Points, R: Array, t: Array) -> tuple[Array, Array]:
    """Sampson residuals in sigmas (n,), and their Jacobian (n, 5) over ``[delta, tangent]``.

    The epipolar error ``x_prev^T E x_curr`` over its standard deviation under the points' own noise. At an epipole
    that vanishes to first order, and a minimum would sit on every point; a second-order term, weighted by
    ``EPIPOLE``, quiets the points around it.
    """
    error, in_prev, in_curr, M = _epipolar(prev, curr, R, t)
    to_prev = np.einsum("nij,ni->nj", prev.cov, in_prev[0])
    to_curr = np.einsum("nij,ni->nj", curr.cov, in_curr[0])
    cov_var = np.einsum("kni,ni->nk", in_prev, to_prev) + np.einsum("kni,ni->nk", in_curr, to_curr)
    B = prev.cov @ M[0, :2, :2] @ curr.cov
    cov_var += EPIPOLE**2 * np.einsum("nij,kij->nk", B, M[:, :2, :2])
    var, half_d_var = cov_var[:, :1], cov_var[:, 1:]
    r = error[:, :1] / np.sqrt(var)
    return r[:, 0], error[:, 1:] / np.sqrt(var) - r / var * half_d_var


def refine(prev: Points, curr: Points, R: Array, t: Array, scale: float = ALIKE) -> tuple[Array, Array]:
    """(R, t) of least Sampson error, by Levenberg-Marquardt from a start.

    scale: sigmas of a residual beyond which a point counts less and less (Cauchy's weights).
    """

    def cost(r: Array) -> float:
        return float(scale**2 * np.sum(np.log1p((r / scale) ** 2)))

    r, J = sampson(prev, curr, R, t)
    damping = 1e-6
    for _ in range(20):
        weighted = J / (1 + (r / scale) ** 2)[:, None]
        H = weighted.T @ J
        step = np.linalg.lstsq(H + damping * np.diag(np.diag(H)), -weighted.T @ r, rcond=1e-14)[0]
        R_new, t_new = se3.exp_so3(step[:3]) @ R, t + tangent(t) @ step[3:]
        t_new /= np.linalg.norm(t_new)
        r_new, J_new = sampson(prev, curr, R_new, t_new)
        gain = cost(r) - cost(r_new)
        if gain > 0:
            R, t, r, J, damping = R_new, t_new, r_new, J_new, damping / 10
        else:
            damping *= 100
        if abs(gain) < 1e-4 or damping > 1e4:  # of a cost that is one for each point
            break
    return R, t


def covariance(prev: Points, curr: Points, R: Array, t: Array) -> Array:
    """Covariance (5, 5) of ``[delta, tangent]`` at the optimum, from the noise of the points.

    The approximate delta method (section VI-D1, Censi), ``H^-1 M cov(z) M^T H^-1``. With residuals in sigmas,
    M cov(z) M^T is J^T J, and H is J^T J less what the noise of the points puts into it: where points hardly move,
    noise alone looks like parallax, and claims to know the direction. Where that leaves nothing, the
    direction's variance is infinite.
    """
    _, J = sampson(prev, curr, R, t)
    _, in_prev, in_curr, M = _epipolar(prev, curr, R, t)
    to_prev, to_curr = (np.einsum("nij,kni->knj", p.cov, g) for p, g in ((prev, in_prev), (curr, in_curr)))
    C = np.einsum("kni,lni->nkl", in_prev, to_prev) + np.einsum("kni,lni->nkl", in_curr, to_curr)
    var = C[:, 0, 0] + EPIPOLE**2 * np.einsum("nij,ij->n", prev.cov @ M[0, :2, :2] @ curr.cov, M[0, :2, :2])
    noise = C[:, 1:, 1:] - C[:, 1:, :1] * C[:, :1, 1:] / var[:, None, None]  # what is not correlated with the error
    information = J.T @ J
    H = information - np.sum(noise / var[:, None, None], axis=0)
    if np.linalg.eigvalsh(H)[0] <= 0:
        return block_diag(np.linalg.pinv(information, hermitian=True)[:3, :3], np.diag([np.inf, np.inf]))
    return np.linalg.solve(H, np.linalg.solve(H, information).T)


def _epipolar(prev: Points, curr: Points, R: Array, t: Array) -> tuple[Array, Array, Array, Array]:
    """The epipolar error and its derivatives over the five parameters (n, 6), the gradients of each over the
    points of both images, (6, n, 2) twice, and the essential matrix with its derivatives, (6, 3, 3)."""
    T = se3.skew(t)
    M = np.concatenate([(T @ R)[None], T @ se3.skew(np.eye(3)) @ R, se3.skew(tangent(t).T) @ R])
    lines_prev, lines_curr = curr.rays @ M.transpose(0, 2, 1), prev.rays @ M
    return np.einsum("ni,kni->nk", prev.rays, lines_prev), lines_prev[..., :2], lines_curr[..., :2], M


def _hartley(rays: Array) -> tuple[Array, Array]:
    """Points moved to zero mean and mean distance sqrt(2), and the (3, 3) matrix that does it."""
    centre = rays[:, :2].mean(axis=0)
    scale = np.sqrt(2) / max(float(np.mean(np.linalg.norm(rays[:, :2] - centre, axis=1))), 1e-12)
    N = np.array([[scale, 0, -scale * centre[0]], [0, scale, -scale * centre[1]], [0, 0, 1]])
    return rays @ N.T, N
