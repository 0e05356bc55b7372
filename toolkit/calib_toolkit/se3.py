"""Rigid motions: conversions, composition and the propagation of their covariance.

Conventions (docs/conventions): ``T_a_b`` maps points in b to a and is b's pose in a. A six-vector ``vec`` is
``[x y z rx ry rz]``, metres and radians, translation followed by angle-axis rotation (the paper's section V);
it is not the se(3) logarithm. Group operations come from SciPy's ``Rotation``; what is batched and
differentiated here is what SciPy lacks.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]


def skew(v: Array) -> Array:
    """Cross-product matrices: ``skew(v) @ u == cross(v, u)``. (..., 3) -> (..., 3, 3)."""
    out = np.zeros((*v.shape[:-1], 3, 3))
    out[..., 0, 1], out[..., 0, 2] = -v[..., 2], v[..., 1]
    out[..., 1, 0], out[..., 1, 2] = v[..., 2], -v[..., 0]
    out[..., 2, 0], out[..., 2, 1] = -v[..., 1], v[..., 0]
    return out


def exp_so3(rotvec: ArrayLike) -> Array:
    """Rotation matrices of angle-axis vectors. (..., 3) radians -> (..., 3, 3)."""
    r = np.array(rotvec, dtype=float)  # SciPy writes to what it is given
    return Rotation.from_rotvec(r.reshape(-1, 3)).as_matrix().reshape(*r.shape, 3)


def log_so3(R: ArrayLike) -> Array:
    """Angle-axis vectors of rotation matrices, angle within [0, pi]. (..., 3, 3) -> (..., 3) radians."""
    M = np.asarray(R, dtype=float)
    return Rotation.from_matrix(M.reshape(-1, 3, 3)).as_rotvec().reshape(*M.shape[:-1])


def matrix(vec: ArrayLike) -> Array:
    """Homogeneous matrices of six-vectors. (..., 6) -> (..., 4, 4)."""
    v = np.asarray(vec, dtype=float)
    T = np.zeros((*v.shape[:-1], 4, 4))
    T[..., :3, :3] = exp_so3(v[..., 3:])
    T[..., :3, 3] = v[..., :3]
    T[..., 3, 3] = 1.0
    return T


def vector(T: ArrayLike) -> Array:
    """Six-vectors of homogeneous matrices. (..., 4, 4) -> (..., 6)."""
    M = np.asarray(T, dtype=float)
    return np.concatenate([M[..., :3, 3], log_so3(M[..., :3, :3])], axis=-1)


def rigid(R: ArrayLike, t: ArrayLike) -> Array:
    """Homogeneous matrices of rotations (..., 3, 3) and translations (..., 3)."""
    R, t = np.asarray(R, dtype=float), np.asarray(t, dtype=float)
    T = np.zeros((*R.shape[:-2], 4, 4))
    T[..., :3, :3], T[..., :3, 3], T[..., 3, 3] = R, t, 1.0
    return T


def invert(T: ArrayLike) -> Array:
    """Inverse transforms: ``T_b_a`` of ``T_a_b``. (..., 4, 4) -> (..., 4, 4)."""
    M = np.asarray(T, dtype=float)
    R_inv = np.swapaxes(M[..., :3, :3], -1, -2)
    return rigid(R_inv, -(R_inv @ M[..., :3, 3:])[..., 0])


def left_jacobian(rotvec: ArrayLike) -> Array:
    """``J`` in ``Exp(r + dr) = Exp(J dr) Exp(r)``, to first order. (..., 3) -> (..., 3, 3)."""
    r = np.asarray(rotvec, dtype=float)
    angle = np.linalg.norm(r, axis=-1)[..., None, None]
    small = angle < 1e-4
    a = np.where(small, 1.0, angle)
    c1 = np.where(small, 0.5 - angle**2 / 24, (1 - np.cos(a)) / a**2)
    c2 = np.where(small, 1 / 6 - angle**2 / 120, (a - np.sin(a)) / a**3)
    S = skew(r)
    return np.eye(3) + c1 * S + c2 * (S @ S)


def rotate_cov(R: Array, cov: Array) -> Array:
    """Covariance seen from rotated axes: ``R cov R^T``, batched, (..., 3, 3) each."""
    return R @ cov @ np.swapaxes(R, -1, -2)


def turn_vectors(R: Array, v: Array) -> Array:
    """Many vectors seen from turned axes: (n, 3, 3), (n, m, 3) -> (n, m, 3)."""
    return v @ np.swapaxes(R, 1, 2)


def turn_covs(R: Array, cov: Array) -> Array:
    """Many covariances (or 3x3 blocks) seen from turned axes, ``R cov R^T``: (n, 3, 3), (n, m, 3, 3) -> the same.

    As one product with R (x) R, which for many small matrices is ten times faster than two.
    """
    n, m = cov.shape[:2]
    both = np.einsum("nij,nkl->nikjl", R, R).reshape(n, 9, 9)
    return (cov.reshape(n, m, 9) @ np.swapaxes(both, 1, 2)).reshape(n, m, 3, 3)


def vec_jacobian(vec: ArrayLike) -> Array:
    """``J`` that takes noise of a six-vector to noise of its transform. (..., 6) -> (..., 6, 6).

    Noise of the six-vector is additive per component; noise of the transform is ``(dt, delta)`` in
    ``t_true = t + dt``, ``R_true = Exp(delta) R``, both in the outer axes of the transform.
    """
    v = np.asarray(vec, dtype=float)
    J = np.zeros((*v.shape, 6))
    J[..., :3, :3] = np.eye(3)
    J[..., 3:, 3:] = left_jacobian(v[..., 3:])
    return J


def relative(T_w_a: Array, T_w_b: Array) -> Array:
    """``T_a_b`` of two poses in one world frame. (..., 4, 4) each."""
    return invert(T_w_a) @ T_w_b


def relative_jacobians(T_w_a: Array, T_w_b: Array) -> tuple[Array, Array]:
    """How the noise of two poses enters their relative transform: ``(d T_a_b / d a, d T_a_b / d b)``.

    All noise is ``(dt, delta)`` in the outer axes of its own transform (world axes for the poses, axes of a
    for the result). (..., 4, 4) each -> two of (..., 6, 6).
    """
    R_a_w = np.swapaxes(T_w_a[..., :3, :3], -1, -2)
    lever_w = T_w_b[..., :3, 3] - T_w_a[..., :3, 3]
    J_b = np.zeros((*T_w_a.shape[:-2], 6, 6))
    J_b[..., :3, :3] = R_a_w
    J_b[..., 3:, 3:] = R_a_w
    J_a = -J_b
    # turning a by delta swings b about a: d t_a_b = -R_a_w (delta x lever)
    J_a[..., :3, 3:] = R_a_w @ skew(lever_w)
    return J_a, J_b
