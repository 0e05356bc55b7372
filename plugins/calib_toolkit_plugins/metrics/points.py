"""What a scan alone tells of each of its points: which may be hidden, where intensity and depth change."""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.stats import rankdata

from calib_toolkit import Scan

Array = NDArray[np.float64]
Index = NDArray[np.int64]

NEIGHBOURS = 50
HIDDEN = 0.1
"""Share of a point's distance by which a neighbour may be nearer (paper, VII-A)."""
ENOUGH = 12
"""Neighbours that tell a gradient: as many as reach the next rings of a spinning lidar."""
THIN = 0.02
"""Share of the neighbours' spread below which they lie in one line, and tell nothing across it."""
BESIDE = 16
"""Neighbours among which are the nearest to the left and right."""
BEAMS = 256
"""Of like elevation, where a scan does not number them."""
SAMPLE, AREA = 20_000, 30
"""Points by which beams are compared, and how many around each."""


def may_be_hidden(points: NDArray[np.float32], chosen: Index) -> NDArray[np.bool_]:
    """(m,) whether a point that is chosen of (n, 3) may be hidden: of its 50 neighbours on the sphere the nearest to
    the sensor is far from it, for its distance.
    """
    if len(points) <= NEIGHBOURS:
        return np.ones(len(chosen), dtype=bool)
    unit, length = on_sphere(points)
    near = neighbours(unit, chosen, NEIGHBOURS)
    nearest = np.take_along_axis(near, np.argmin(length[near], axis=1)[:, None], axis=1)[:, 0]
    apart = np.linalg.norm(points[nearest] - points[chosen], axis=1)
    return np.asarray(apart > HIDDEN * length[chosen])


def on_sphere(points: NDArray[np.float32]) -> tuple[Array, Array]:
    """Directions (n, 3) and distances (n,)."""
    p = points.astype(np.float64)
    length = np.linalg.norm(p, axis=1)
    return p / length[:, None], length


def neighbours(unit: Array, chosen: Index, count: int) -> Index:
    """(m, count) of directions (n, 3): the nearest to each that is chosen, itself first."""
    return np.asarray(cKDTree(unit).query(unit[chosen], k=count)[1], np.int64)


def intensity_gradients(points: NDArray[np.float32], intensity: Array, chosen: Index) -> Array:
    """(m, 3) how intensity (n,) changes per radian on the sphere around points (n, 3) that are chosen; lidar axes.

    Least squares over each point's neighbours, in the plane that touches the sphere there.
    """
    unit, _ = on_sphere(points)
    near = neighbours(unit, chosen, min(ENOUGH, len(unit)))
    apart = unit[near] - unit[near].mean(axis=1, keepdims=True)
    change = intensity[near] - intensity[near].mean(axis=1, keepdims=True)
    ray = unit[chosen]
    scatter = np.einsum("mki,mkj->mij", apart, apart)
    size = np.trace(scatter, axis1=1, axis2=2)[:, None, None] + 1e-12
    stiff = scatter + size * (ray[:, :, None] * ray[:, None, :] + THIN * np.eye(3))
    pull = np.einsum("mki,mk->mi", apart, change)
    pull -= np.sum(pull * ray, axis=1, keepdims=True) * ray
    return np.asarray(np.linalg.solve(stiff, pull[:, :, None])[:, :, 0])


def evened(scan: Scan) -> Array:
    """(n,) intensity by rank, 0 to 1, without what each beam adds: how its points usually differ from those around.

    Where the scan does not tell the beam, points of nearly the same elevation are taken to share one.
    """
    unit, _ = on_sphere(scan.points)
    rank = (rankdata(scan.intensity) - 0.5) / len(unit)
    beam = scan.ring if scan.ring is not None else rankdata(unit[:, 2], "ordinal") * BEAMS // (len(unit) + 1)
    some = np.arange(0, len(unit), max(len(unit) // SAMPLE, 1))
    beyond = rank[some] - rank[neighbours(unit, some, min(AREA, len(unit)))].mean(axis=1)
    order = np.argsort(beam[some], kind="stable")
    beams, start = np.unique(beam[some][order], return_index=True)
    added = np.array([np.median(part) for part in np.split(beyond[order], start[1:])])
    return np.asarray(rank - np.interp(beam, beams, added))


def steps_behind(points: NDArray[np.float32], chosen: Index) -> Array:
    """(m,) metres from points that are chosen of (n, 3) back to what is left or right of them; 0 if none.

    Along a line on a plane the inverse of distance is linear: only what falls faster on one side of a point than it
    rises on the other is a step, so that ground and walls seen at a slant have none.
    """
    unit, length = on_sphere(points)
    near = neighbours(unit, chosen, min(BESIDE, len(unit)))
    apart, fall = unit[near] - unit[chosen, None], 1 / length[chosen, None] - 1 / length[near]
    ray = unit[chosen]
    left = np.stack([-ray[:, 1], ray[:, 0], np.zeros(len(ray))], axis=1)
    left /= np.maximum(np.linalg.norm(left, axis=1, keepdims=True), 1e-9)
    across, up = (np.einsum("mki,mi->mk", apart, axis) for axis in (left, np.cross(ray, left)))
    beside = np.stack([side * across > np.abs(up) for side in (1, -1)])
    first = np.argmax(beside, axis=2)[:, :, None]  # neighbours come nearest first
    known = np.take_along_axis(beside, first, axis=2)[:, :, 0]
    far, fallen = (np.take_along_axis(v[None], first, axis=2)[:, :, 0] for v in (np.abs(across), fall))
    slope = np.where(known, fallen / np.maximum(far, 1e-9), 0.0)
    step = np.max(np.maximum(slope + np.minimum(slope[::-1], 0), 0) * far, axis=0)
    behind = 1 / np.maximum(1 / length[chosen] - step, 1 / length.max())
    return np.maximum(behind - length[chosen], 0)
