"""Scans laid along a path: straightened by it, and how far apart their surfaces then lie."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from calib_toolkit import DataError, Motions, Stream, poses_at, se3
from calib_toolkit_plugins import registration

Array = NDArray[np.float64]

NEAREST, FARTHEST = 2.0, 80.0
"""Metres: nearer points are the vehicle itself, farther ones lie too far apart for a normal."""
POINTS = 60_000
"""Of a scan, as many are kept (every second, every third, ...): enough to fill the cells."""
CELL = 0.25
"""Metres: one point is kept of each cell of this size."""
MATCHES = 5_000
"""Points of one scan that are matched with another."""
KNOT = 0.01
"""Seconds between the poses along which a scan is straightened; between them it moves evenly."""
NEIGHBOURS = 12
"""Of a point, by which it lies on a plane."""
THICK, WIDE = 0.06, 0.1
"""They may be scattered this far across the plane, metres, and must spread within it in two directions: this is the
least ratio of their variances."""
EDGE = 0.5
"""Where the mean of a point's neighbours lies farther from it than this share of their spread, the plane ends: what
is nearest to it there may belong to what lies beyond, and was not seen twice."""
IN_COMMON = 50
"""Matches, with fewer of which two scans show nothing of each other."""
ALIKE = 0.9
"""Least cosine of the angle between the planes of two points that are matched."""
FEWEST = 200
"""Points, below which a scan is not used."""


@dataclass(frozen=True)
class Track:
    """A lidar whose scans are laid along a path.

    dt: seconds, added to its stamps to get the path's. fixed: its mount on the path is known (it made the path).
    """

    stream: Stream
    dt: float
    fixed: bool


@dataclass(frozen=True)
class Sweep:
    """The points of one scan, each as measured. points: (n, 3) metres. times: (n,) seconds on the path's clock, all
    ``stamp`` where the lidar does not tell."""

    points: NDArray[np.float32]
    times: Array
    stamp: float


@dataclass(frozen=True)
class Misfit:
    """What two scans say of an error of the motion between them.

    The error is ``(dt, delta)`` in ``t_true = t + dt``, ``R_true = Exp(delta) R`` of ``T_target_source``, axes of the
    target. information: (6, 6). gradient: (6,) of half the squared residuals. rms: metres.
    """

    information: Array
    gradient: Array
    rms: float


@dataclass(frozen=True)
class Patch:
    """What a scan saw, one point a cell, frame of the scan.

    points: (n, 3) metres. normals: (n, 3), zero where neighbours lie on no plane. inside: (n,) points with neighbours
    on all sides. tree: of the points.
    """

    points: Array
    normals: Array
    inside: NDArray[np.bool_]
    tree: cKDTree


def read_sweep(track: Track, k: int) -> Sweep | None:
    """Reading k of a lidar; None if too little of it can be used. Raises DataError."""
    scan = track.stream.readings[k]
    points = np.asarray(getattr(scan, "points", None))
    if points.ndim != 2 or points.shape[1] != 3:
        raise DataError(
            f"sensor {track.stream.name}, scan {k} (stamp {track.stream.stamps[k]:.6f} s): it holds no (n, 3) points "
            f"but a {type(scan).__name__}; read it with the velodyne plugin's reader or leave the sensor out"
        )
    stamp = float(track.stream.stamps[k]) + track.dt
    times = np.zeros(len(points)) if scan.times is None else np.asarray(scan.times, dtype=np.float64)
    squared = np.einsum("ij,ij->i", points, points)
    usable = np.flatnonzero((squared > NEAREST**2) & (squared < FARTHEST**2) & np.isfinite(times))
    # an odd step meets all beams of an even number
    usable = usable[:: -(-len(usable) // POINTS) | 1]
    return Sweep(points[usable], stamp + times[usable], stamp) if len(usable) >= FEWEST else None


def straighten(sweep: Sweep, motion: Motions, T_path_lidar: Array) -> Patch | None:
    """What a scan saw, as from where the lidar was at its stamp; None where the path is not known."""
    first, last = float(sweep.times.min()), float(sweep.times.max())
    knots = np.linspace(first, last, max(2, int(np.ceil((last - first) / KNOT)) + 1))
    T = se3.invert(T_path_lidar) @ poses_at(motion, knots, sweep.stamp) @ T_path_lidar
    if not np.isfinite(T).all():
        return None
    place = (sweep.times - first) / max(last - first, 1e-9) * (len(knots) - 1)
    k = np.minimum(place.astype(np.int64), len(knots) - 2)
    part = (place - k)[:, None]
    before, after = (
        np.einsum("nij,nj->ni", T[i, :3, :3], sweep.points.astype(np.float64)) + T[i, :3, 3] for i in (k, k + 1)
    )
    straight = (1 - part) * before + part * after
    return _planes(straight[registration.picked(straight, sweep.times, CELL)])


def _planes(points: Array) -> Patch:
    """The points, with normals only where neighbours lie on a plane, and not in a line along one ring."""
    tree = cKDTree(points)
    around = points[np.minimum(tree.query(points, NEIGHBOURS)[1], len(points) - 1)]
    centre = around.mean(axis=1)
    offset = around - centre[:, None]
    variance, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", offset, offset) / NEIGHBOURS)
    flat = (variance[:, 0] < THICK**2) & (variance[:, 1] > WIDE * variance[:, 2])
    aside = np.einsum("ni,ni->n", points - centre, points - centre)
    inside = aside < EDGE**2 * variance.sum(axis=1)
    return Patch(points, axes[:, :, 0] * flat[:, None], inside, tree)


def misfit(target: Patch, source: Patch, T_target_source: Array, gate: float) -> Misfit | None:
    """How far the points of one scan lie off the surfaces of another, at a motion; None if hardly any is near one.

    Only points within ``gate`` metres of the other scan count, and the farther off a surface, the less (Tukey's
    weights, whose scale is the residuals' own).
    """
    flat = np.flatnonzero(source.normals.any(axis=1))
    flat = flat[:: max(1, len(flat) // MATCHES)]
    points, facing = (v[flat] @ T_target_source[:3, :3].T for v in (source.points, source.normals))
    distance, rows = target.tree.query(points + T_target_source[:3, 3], distance_upper_bound=gate)
    planes = np.minimum(rows, len(target.points) - 1)
    near = np.isfinite(distance) & target.inside[planes]
    near &= np.abs(np.einsum("ij,ij->i", target.normals[planes], facing)) > ALIKE
    if near.sum() < IN_COMMON:
        return None
    normals, lever = target.normals[planes[near]], points[near]
    errors = np.einsum("ij,ij->i", normals, lever + T_target_source[:3, 3] - target.points[planes[near]])
    scale = 1.4826 * float(np.median(np.abs(errors))) + 1e-6
    weights = np.maximum(1 - (errors / (4.685 * scale)) ** 2, 0.0) ** 2
    variance = float(weights @ errors**2 / weights.sum())
    J = np.hstack([normals, np.cross(lever, normals)])
    weighted = J * (weights / variance)[:, None]
    return Misfit(J.T @ weighted, weighted.T @ errors, float(np.sqrt(variance)))


def covered(target: Patch, source: Patch, T_target_source: Array, gate: float) -> float:
    """Share of the points of one scan that lie within ``gate`` metres of another's."""
    points = source.points[:: max(1, len(source.points) // MATCHES)]
    moved = points @ T_target_source[:3, :3].T + T_target_source[:3, 3]
    return float(np.isfinite(target.tree.query(moved, distance_upper_bound=gate)[0]).mean())
