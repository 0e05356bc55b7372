"""Registration of two lidar scans: coarse to fine, and how far its answer can be believed.

Scans sample the ground along rings that travel with the scanner, so that matching nearest points at once finds
no motion at all. Matching against the averages of large cells first does not see the rings.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib_toolkit import se3

Array = NDArray[np.float64]

FAR_LEVELS = (2.0, 1.0, 0.5)
"""Cell sizes, metres, when nothing is known of the motion: found 3 m and several degrees on real scans."""
NEAR_LEVELS = (0.5,)
"""Cell size, metres, when the motion is foreseen to a few decimetres."""
NEIGHBOURS = 15
"""Of each point, for its normal: on the ground they reach the rings of other sweeps."""
REACH = 0.5
"""Farthest neighbour, metres, whose plane may be a point's."""
FAINT = 0.012
"""Mean squared cosine of the normals with a direction, below which it is not seen.

Errors of normals alone feign 0.001 on a plain and 0.008 between two bare walls; real streets show 0.019 and more.
"""


@dataclass(frozen=True)
class Surface:
    """A scan as registration needs it: thinned to one point a cell, each with its normal; made once a scan.

    points, normals: (n, 3) metres, frame of the scan. cloud, tree: small_gicp's own form of them.
    """

    points: Array
    normals: Array
    cloud: Any
    tree: Any


def thinned(points: Array, cell: float) -> Array:
    """(m, 3) the means of (n, 3) points in each cell of ``cell`` metres."""
    import small_gicp

    return np.array(small_gicp.voxelgrid_sampling(points, cell).points()[:, :3])


def picked(points: Array, times: Array, cell: float) -> NDArray[np.int64]:
    """(m,) rows of points (n, 3), one of each ``cell`` metres: that in the middle by time (n,), of two the later.

    Where a scanner swings by millimetres, means of cells would hide some hundredths of that: the cells come along.
    """
    cells = np.floor(points / cell).astype(np.int64) @ np.array([1, 1 << 20, 1 << 40])
    order = np.lexsort((times, cells))
    start = np.flatnonzero(np.diff(cells[order], prepend=cells[order[0]] - 1))
    return np.asarray(order[(start + np.append(start[1:], len(order))) // 2])


def surface(points: Array, cell: float) -> Surface:
    """The surface through (n, 3) points, thinned to the mean of each ``cell`` metres."""
    import small_gicp

    cloud = small_gicp.voxelgrid_sampling(points, cell)
    tree = small_gicp.KdTree(cloud)
    small_gicp.estimate_normals_covariances(cloud, tree, NEIGHBOURS)
    return Surface(np.asarray(cloud.points())[:, :3], np.asarray(cloud.normals())[:, :3], cloud, tree)


def register(prev: Surface, curr: Surface, T_seed: Array, levels: Sequence[float], gate: float) -> Array:
    """``T_prev_curr`` (4, 4) from a first guess: voxelised GICP at each cell size, then GICP between points that come
    within ``gate`` metres of each other.

    Deterministic: one thread. Koide et al., "Voxelized GICP", ICRA 2021; Segal et al., "Generalized-ICP", RSS 2009.
    """
    import small_gicp

    # small_gicp stops at steps below 0.1 degrees and 1 mm: tighter takes 15 % longer, and steps err by as much
    T = T_seed
    for cell in levels:
        cells = small_gicp.GaussianVoxelMap(cell)
        cells.insert(prev.cloud)
        T = small_gicp.align(cells, curr.cloud, T, num_threads=1, max_iterations=30).T_target_source
    clouds = prev.cloud, curr.cloud, prev.tree
    fine = small_gicp.align(*clouds, T, "GICP", gate, num_threads=1, max_iterations=30)
    return np.asarray(fine.T_target_source)


@dataclass(frozen=True)
class PlaneResiduals:
    """Distances of one scan's points from the planes of the other, linearised in the motion.

    T_prev_curr: (4, 4) where they were taken. rows: (m,) of the points that lie within the gate of a plane; points:
    (m, 3) those, frame of the current scan. planes: (m,) the row of each one's neighbour in the previous scan;
    targets, normals: (m, 3) its point and normal. errors: (m,) metres. overlap: m as a share of all.
    """

    T_prev_curr: Array
    rows: NDArray[np.int64]
    points: Array
    planes: NDArray[np.int64]
    targets: Array
    normals: Array
    errors: Array
    overlap: float

    @property
    def jacobian(self) -> Array:
        """(m, 6) of the errors by ``vec`` of ``T_prev_curr``."""
        lever = self.points @ self.T_prev_curr[:3, :3].T
        turn = se3.left_jacobian(se3.log_so3(self.T_prev_curr[:3, :3]))
        return np.hstack([self.normals, np.cross(lever, self.normals) @ turn])


def plane_residuals(prev: Surface, points: Array, T_prev_curr: Array, gate: float) -> PlaneResiduals:
    """Point-to-plane residuals below ``gate`` metres (paper V-A) of points (n, 3) at a motion."""
    moved = points @ T_prev_curr[:3, :3].T + T_prev_curr[:3, 3]
    rows, squared = prev.tree.batch_knn_search(moved, 1)
    planes = np.minimum(rows[:, 0], len(prev.points) - 1).astype(np.int64)
    errors = np.einsum("ij,ij->i", moved - prev.points[planes], prev.normals[planes])
    near = (squared[:, 0] < REACH**2) & (np.abs(errors) < gate) & (np.abs(prev.normals[planes]).max(axis=1) > 0.0)
    kept = planes[near]
    return PlaneResiduals(
        T_prev_curr,
        np.flatnonzero(near),
        points[near],
        kept,
        prev.points[kept],
        prev.normals[kept],
        errors[near],
        float(near.mean()),
    )


def point_to_plane(prev: Surface, curr: Surface, T_seed: Array, gate: float, iterations: int = 3) -> Array:
    """``T_prev_curr`` by iterated point-to-plane least squares with the gate of paper V-A."""
    vec = se3.vector(T_seed)
    for _ in range(iterations):
        residuals = plane_residuals(prev, curr.points, se3.matrix(vec), gate)
        vec = vec - np.linalg.lstsq(residuals.jacobian, residuals.errors, rcond=None)[0]
    return se3.matrix(vec)


def range_covariance(residuals: PlaneResiduals, sigma: float, unseen_sigma: float) -> Array:
    """(6, 6) covariance of ``vec`` of ``T_prev_curr`` that range noise of ``sigma`` metres causes.

    The delta method on an estimate that minimises ``J``: ``cov = H^-1 G (sigma^2 I) G^T H^-1`` with
    ``H = d2J/dx2`` and ``G = d2J/dx dz``, ``z`` the ranges of all points of both scans along their beams
    (paper V-A and VI-D; Censi, "An accurate closed-form estimate of ICP's covariance", ICRA 2007). Normals are
    taken as known; since they are not, a direction that they show only faintly (along a bare tunnel, turning on
    an open plain) is not measured at all: it gets ``unseen_sigma`` metres, a rotation that much at the points'
    mean distance.
    """
    R, n, A = residuals.T_prev_curr[:3, :3], residuals.normals, residuals.jacobian
    beams = _unit(residuals.points) @ R.T
    by_point = np.einsum("ij,ij->i", n, beams)[:, None] * A
    by_point[:, 3:] += residuals.errors[:, None] * (np.cross(beams, n) @ se3.left_jacobian(se3.log_so3(R)))
    by_pair = np.einsum("ij,ij->i", n, _unit(residuals.targets))[:, None] * A
    by_target = np.zeros((int(residuals.planes.max()) + 1, 6))
    np.add.at(by_target, residuals.planes, by_pair)  # several points may share one plane
    metres = np.ones(6)  # of motion at the points' distance, for each unit of vec
    metres[3:] = np.sqrt(np.mean(residuals.points**2) * 3)
    information, axes = np.linalg.eigh(A.T @ A / np.outer(metres, metres) / len(A))
    seen = information > FAINT
    inverse = axes[:, seen] / information[seen] @ axes[:, seen].T / len(A)
    spread = (by_point.T @ by_point + by_target.T @ by_target) / np.outer(metres, metres)
    cov = sigma**2 * inverse @ spread @ inverse + unseen_sigma**2 * axes[:, ~seen] @ axes[:, ~seen].T
    cov /= np.outer(metres, metres)
    return np.asarray((cov + cov.T) / 2)


def _unit(v: Array) -> Array:
    return v / np.linalg.norm(v, axis=1, keepdims=True)
