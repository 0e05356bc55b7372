"""The roads: one along the vehicle's path, side streets off it, and where things may stand beside them."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from calib_toolkit_datasets.simulation.vehicle import TruePath

Array = NDArray[np.float64]
STEP = 0.5
"""Metres between the points of a line."""
CELL = 0.5
"""Metres: the size of the smallest plot."""
CLEAR = 2.2
"""Metres on either side of the vehicle's path where nothing stands."""


@dataclass(frozen=True)
class Line:
    """A line along a road. s: (n,) metres along it, every ``STEP``; xy: (n, 2); yaw: (n,) radians, unwrapped."""

    s: Array
    xy: Array
    yaw: Array

    def at(self, s: ArrayLike, left: ArrayLike) -> Array:
        """Places beside the line: (k,) metres along it and to its left -> (k, 3) of x, y and yaw."""
        s = np.asarray(s, dtype=float)
        yaw = np.interp(s, self.s, self.yaw)
        x, y = (np.interp(s, self.s, self.xy[:, k]) for k in (0, 1))
        return np.stack([x - left * np.sin(yaw), y + left * np.cos(yaw), yaw], axis=-1)

    def offset(self, left: float) -> "Line":
        """The same line moved to its left; ``s`` keeps its meaning."""
        return Line(self.s, self.at(self.s, left)[:, :2], self.yaw)


@dataclass(frozen=True)
class Roads:
    """Everything that is driven on. lines: the middle of each carriageway; driven: (m, 2) where the vehicle goes."""

    lines: list[Line]
    driven: cKDTree
    _tree: cKDTree = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "_tree", cKDTree(np.concatenate([line.xy for line in self.lines])))

    def distance(self, xy: Array) -> Array:
        """Metres to the middle of the nearest road, (n, 2) -> (n,)."""
        return np.asarray(self._tree.query(xy)[0], dtype=float)

    def joined(self, line: Line, reach: float) -> NDArray[np.bool_]:
        """Where another road, or the same one further on, is within reach: (n,) for the line's points."""
        others = [other.xy for other in self.lines if other is not line]
        near = np.zeros(len(line.s), dtype=bool)
        if others:
            near = cKDTree(np.concatenate(others)).query(line.xy, distance_upper_bound=reach)[0] < reach
        for i, found in enumerate(cKDTree(line.xy).query_ball_point(line.xy, reach)):
            near[i] |= bool(np.any(np.abs(line.s[found] - line.s[i]) > 3 * reach))
        return near


class Plots:
    """Ground that is still free. Things ask for theirs in turn, so the first ones to ask decide."""

    def __init__(self, roads: Roads) -> None:
        self._roads = roads
        self._taken: set[tuple[int, int]] = set()

    def claim(self, places: Array, size: tuple[float, float], apart: float) -> NDArray[np.bool_]:
        """Which of the places (k, 3) x, y, yaw are free for a rectangle of ``size`` (along, across); they are taken.

        apart: metres that must stay between it and the middle of every road; ``CLEAR`` to the vehicle's own path.
        """
        points = _footprint(places, size)
        flat = points.reshape(-1, 2)
        free = (self._roads.distance(flat) >= apart) & (self._roads.driven.query(flat)[0] >= CLEAR)
        allowed = free.reshape(points.shape[:2]).all(axis=1)
        cells = np.floor(points / CELL).astype(int)
        for k in np.flatnonzero(allowed):
            wanted = set(map(tuple, cells[k].tolist()))
            allowed[k] = self._taken.isdisjoint(wanted)
            if allowed[k]:
                self._taken |= wanted
        return allowed


def along(path: TruePath, extension: float) -> Line:
    """The line that the vehicle drives, and straight on for ``extension`` metres at both ends."""
    T = path.T_world_vehicle[::10]
    xy = T[:, :2, 3]
    s = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(xy, axis=0), axis=1))])
    moved = np.concatenate([[True], np.diff(s) > 1e-6])
    at = np.arange(0.0, max(s[-1], STEP), STEP)
    middle = np.column_stack([np.interp(at, s[moved], xy[moved, k]) for k in (0, 1)])
    ahead = STEP * np.arange(1, int(extension / STEP) + 1)[:, None]
    first, last = (T[k, :2, 0] / np.linalg.norm(T[k, :2, 0]) for k in (0, -1))
    points = np.concatenate([middle[0] - ahead[::-1] * first, middle, middle[-1] + ahead * last])
    return _line(points, -len(ahead) * STEP)


def side_street(line: Line, s: float, side: int, length: float) -> Line:
    """A straight road that leaves a line at ``s``, to its left (side 1) or right (-1)."""
    x, y, yaw = line.at(s, 0.0)
    heading = yaw + side * np.pi / 2
    out = np.arange(0.0, length, STEP)[:, None]
    return _line(np.array([x, y]) + out * [np.cos(heading), np.sin(heading)], 0.0)


def _line(xy: Array, start: float) -> Line:
    toward = np.gradient(xy, axis=0) if len(xy) > 1 else np.array([[1.0, 0.0]])
    yaw = np.unwrap(np.arctan2(toward[:, 1], toward[:, 0]))
    return Line(np.asarray(start + STEP * np.arange(len(xy)), dtype=float), xy, yaw)


def _footprint(places: Array, size: tuple[float, float]) -> Array:
    """Points a cell apart all over rectangles at places (k, 3): (k, n, 2).

    They keep off the edges by half the diagonal of a cell, so that neighbours may touch.
    """
    inner = [max(d - 1.42 * CELL, 0.1) for d in size]
    u, v = (np.linspace(-d / 2, d / 2, int(np.ceil(d / CELL)) + 1) for d in inner)
    x, y = (a.reshape(-1) for a in np.meshgrid(u, v))
    cos, sin = np.cos(places[:, 2:]), np.sin(places[:, 2:])
    return np.stack([places[:, :1] + cos * x - sin * y, places[:, 1:2] + sin * x + cos * y], axis=-1)
