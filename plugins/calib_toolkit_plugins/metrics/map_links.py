"""Which scans are laid on which, and how the path moved between them."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from calib_toolkit import Motions, Pair, Trajectory, poses_at, se3
from calib_toolkit_plugins.metrics.map_scans import Track
from calib_toolkit_plugins.metrics.map_solve import LATE, Links

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

SPACING, REACH = 0.4, 3
"""Seconds between the scans of one lidar that are compared, and how many on either side of a selected one.

A path's errors grow with time; those of matching are largest where a scan has hardly moved, since it samples the
ground along rings that move with it (at 0.2 s they drew the height of an INS 2 cm towards the lidar's).
"""
AROUND = (0.0, -1.0, 1.0, -2.0, 2.0, -4.0, 4.0)
"""Seconds from a scan of one lidar to those of the other on which it is laid."""


@dataclass(frozen=True)
class Problem:
    """Scans to be laid on each other along a path.

    targets, sources: the lidar that the first and the second scan of each link is of. readings: (n, 2) their numbers.
    T, cov: the motion stage's ``T_path_lidar`` and its covariance. inverted: the pair asks for ``T_lidar_path``.
    attitude: (3, 3) covariance of an error of the path's attitude that lasts, in its axes.
    """

    motion: Motions
    targets: Track
    sources: Track
    readings: Indices
    links: Links
    T: Array
    cov: Array
    inverted: bool
    attitude: Array

    def __getitem__(self, part: NDArray[np.bool_]) -> "Problem":
        return replace(self, readings=self.readings[part], links=self.links[part])

    def scans(self) -> Iterator[tuple[tuple[str, int], tuple[str, int]]]:
        """Lidar and number of both scans of each link."""
        for i, j in self.readings.tolist():
            yield (self.targets.stream.name, i), (self.sources.stream.name, j)

    def track(self, name: str) -> Track:
        """The lidar of that name."""
        return self.targets if name == self.targets.stream.name else self.sources


def problem_of(pair: Pair) -> Problem:
    """The scans of a lidar along a pose sensor's path, or those of lidar b in the neighbourhood of lidar a's."""
    two = pair.a.kind == pair.b.kind
    inverted = pair.a.kind == "velodyne" and not two
    path, lidar, rows = (
        (pair.motion_b, pair.a, pair.selected[:, 0]) if inverted else (pair.motion_a, pair.b, pair.selected[:, 1])
    )
    motion = path.motions() if isinstance(path, Trajectory) else path
    T, cov = pair.prior.T_a_b, pair.prior.cov
    if inverted:
        J = se3.relative_jacobians(T, np.eye(4))[0]
        T, cov = se3.invert(T), J @ cov @ J.T
    sources = Track(lidar, -pair.dt_a_b if inverted else pair.dt_a_b, fixed=False)
    targets = Track(pair.a, 0.0, fixed=True) if two else sources
    readings, group = _around(targets, pair.selected) if two else _runs(sources, rows)
    by_dt = (0.0, 1.0) if two else (-1.0, -1.0) if inverted else (1.0, 1.0)
    links = _links(motion, targets, sources, readings, group, by_dt)
    known = np.asarray(np.isfinite(links.T_path + links.T_late).all(axis=(1, 2)))
    return Problem(motion, targets, sources, readings, links, T, cov, inverted, _attitude(path))[known]


def _attitude(path: Motions | Trajectory) -> Array:
    """What lasts of a trajectory's attitude, and what it states as if all of that lasted: an INS's heading is off for
    minutes, which no drive tells from the mount."""
    if isinstance(path, Motions):
        return np.zeros((3, 3))
    R_sensor_world = np.swapaxes(path.T_world_sensor[:, :3, :3], 1, 2)
    return np.asarray(np.diag(path.lean**2) + np.median(se3.rotate_cov(R_sensor_world, path.cov[:, 3:, 3:]), axis=0))


def _runs(track: Track, centres: Indices) -> tuple[Indices, Indices]:
    """Scans ``SPACING`` apart around each selected one: (n, 2) readings, and (n,) the run of each; no link twice."""
    step = max(1, round(SPACING / track.stream.period))
    group: dict[tuple[int, int], int] = {}
    for g, k in enumerate(np.sort(centres).tolist()):
        k += -k % step  # so that runs that meet have their scans in common
        run = [i for i in range(k - REACH * step, k + REACH * step + 1, step) if 0 <= i < len(track.stream)]
        for link in pairwise(run):
            group.setdefault(link, g)
    return np.array(list(group), dtype=np.int64).reshape(-1, 2), np.array(list(group.values()), dtype=np.int64)


def _around(targets: Track, rows: Indices) -> tuple[Indices, Indices]:
    """For each selected scan of the second lidar, those of the first ``AROUND`` it."""
    stamps = targets.stream.stamps[rows[:, :1]] + np.array(AROUND)
    k = np.clip(np.searchsorted(targets.stream.stamps, stamps), 0, len(targets.stream) - 1)
    readings = np.stack([k, np.broadcast_to(rows[:, 1:], k.shape)], axis=2).reshape(-1, 2)
    group = np.repeat(np.arange(len(rows)), len(AROUND))
    readings, first = np.unique(readings, axis=0, return_index=True)
    return readings, group[first]


def _links(
    motion: Motions, targets: Track, sources: Track, readings: Indices, group: Indices, by_dt: tuple[float, float]
) -> Links:
    """The path's motion over each link. by_dt: what a second more of ``dt_a_b`` adds to the instants of both ends."""
    first, second = (t.stream.stamps[k] + t.dt for t, k in zip((targets, sources), readings.T, strict=True))
    T, T_late = (_between(motion, first + h * by_dt[0], second + h * by_dt[1]) for h in (0.0, LATE))
    span = np.maximum(np.abs(second - first), sources.stream.period)
    return Links(T, T_late, second, span, group, targets == sources)


def _between(motion: Motions, first: Array, second: Array) -> Array:
    """``T_first_second`` along the path, (n, 4, 4)."""
    T = [poses_at(motion, [s], f)[0] for f, s in zip(first, second, strict=True)]
    return np.array(T).reshape(-1, 4, 4)
