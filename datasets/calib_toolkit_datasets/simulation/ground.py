"""The ground as a mesh: fine beside the roads and coarse far away, painted with what it is made of."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import Delaunay

from calib_toolkit_datasets.simulation.road import Line, Roads
from calib_toolkit_datasets.simulation.shapes import MATERIAL, Mesh, merge, place, quads, triangles
from calib_toolkit_datasets.simulation.terrain import Terrain

Array = NDArray[np.float64]
REACH = 320.0
"""Metres beyond the roads at which the world ends."""


@dataclass(frozen=True)
class Paint:
    """A material wherever a field, (n, 2) -> (n,), is positive; it covers what was painted before."""

    material: str
    field: Callable[[Array], Array]


@dataclass(frozen=True)
class Ground:
    """The terrain, with the carriageway let into it and hills far from it.

    edge: half the carriageway's width, metres. kerb: height of what lies beside it. bank: height of embankments.
    hill: height of hills far away. waves: where banks and hills are high. finest: 6 for points a metre apart on the
    carriageway (the mesh is within a millimetre of the terrain there), 5 for two metres (four millimetres).
    """

    terrain: Terrain
    roads: Roads
    edge: float
    kerb: float
    bank: float
    hill: float
    waves: Terrain
    finest: int

    def height(self, xy: Array) -> Array:
        """Metres above the origin, kerbs included, (n, 2) -> (n,)."""
        d = self.roads.distance(xy)
        return self._smooth(xy, d) + self.kerb * (d > self.edge)

    def mesh(self, paints: Sequence[Paint]) -> Mesh:
        """The whole ground, its carriageway at the terrain's own height and the rest ``kerb`` above it.

        The last of the paints is the carriageway where there are kerbs.
        """
        xy = self._points()
        distance = self.roads.distance(xy)
        columns = [xy, self._smooth(xy, distance)[:, None], *(p.field(xy)[:, None] for p in paints)]
        soup = np.concatenate(columns, axis=1)[Delaunay(xy).simplices]
        made_of = np.full(len(soup), MATERIAL["grass"], dtype=np.uint8)
        edges = np.zeros((0, 2, soup.shape[2]))
        for k, paint in enumerate(paints):
            soup, source, above, edges = _cut(soup, 3 + k)
            made_of = np.where(above, MATERIAL[paint.material], made_of[source]).astype(np.uint8)
        corners = soup[..., :3].copy()
        if not self.kerb:
            return triangles(corners, made_of)
        corners[~above, :, 2] += self.kerb
        foot, top = edges[..., :3], edges[..., :3] + [0.0, 0.0, self.kerb]
        faces = np.stack([foot[:, 0], foot[:, 1], top[:, 1], top[:, 0]], axis=1)
        return merge([triangles(corners, made_of), quads(faces, "kerb")])

    def stripes(self, line: Line, s: Array, left: Array, length: float, width: float) -> Mesh:
        """Marks on the road at (k,) metres along a line and to its left, a centimetre thick."""
        u, v = np.array([-0.5, 0.5, 0.5, -0.5]) * length, np.array([-0.5, -0.5, 0.5, 0.5]) * width
        xy = line.at((s[:, None] + u).reshape(-1), (left[:, None] + v).reshape(-1))[:, :2]
        z = self.terrain.height(xy) + 0.01
        mesh = quads(np.column_stack([xy, z]).reshape(-1, 4, 3), "marking")
        return place(mesh, [0, 0, 0, 0], 0.5)

    def _smooth(self, xy: Array, distance: Array) -> Array:
        swell = self.waves.height(xy)
        bank = self.bank * swell * _ramp((distance - self.edge - 4) / 12)
        return self.terrain.height(xy) + bank + self.hill * (0.4 + swell) * _ramp((distance - 90) / 200)

    def _points(self) -> Array:
        """Points close together on the carriageway and farther and farther apart beyond; slightly out of line."""
        ends = np.concatenate([line.xy for line in self.roads.lines])
        low, high = ends.min(axis=0) - REACH, ends.max(axis=0) + REACH
        size = 64.0
        grid = np.meshgrid(*(np.arange(a, b + size, size) for a, b in zip(low, high, strict=True)))
        open_, done = np.column_stack([g.reshape(-1) for g in grid]), []
        for limit in (200.0, 90.0, 45.0, 24.0, 13.0, self.edge + 0.5)[: self.finest]:
            near = self.roads.distance(open_) < limit + 0.71 * size
            done.append(open_[~near])
            size /= 2
            quarter = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * size / 2
            open_ = (open_[near, None] + quarter).reshape(-1, 2)
        points = np.concatenate([*done, open_])
        return points + np.random.default_rng(0).uniform(-0.1, 0.1, points.shape)


def waves(rng: np.random.Generator, shortest: float, longest: float) -> Terrain:
    """A random field between about -1 and 1 whose bumps are so many metres long."""
    length, heading = rng.uniform(shortest, longest, 8), rng.uniform(0, 2 * np.pi, 8)
    wave = (2 * np.pi / length)[:, None] * np.column_stack([np.cos(heading), np.sin(heading)])
    return Terrain(np.full(8, 0.28), wave, rng.uniform(0, 2 * np.pi, 8))


def _ramp(x: Array) -> Array:
    t = np.clip(x, 0.0, 1.0)
    return t * t * (3 - 2 * t)


def _cut(soup: Array, column: int) -> tuple[Array, NDArray[np.int64], NDArray[np.bool_], Array]:
    """Cuts triangles (m, 3, c) where a column changes sign.

    Returns the pieces, the triangle that each comes from, whether the column is positive there, and the edges of
    the cut (k, 2, c).
    """
    up = soup[..., column] > 0
    count = up.sum(axis=1)
    whole = np.flatnonzero((count == 0) | (count == 3))
    split = np.flatnonzero((count == 1) | (count == 2))
    lone = np.argmax(np.where(count[split, None] == 1, up[split], ~up[split]), axis=1)
    a, b, c = (soup[split, (lone + k) % 3] for k in range(3))
    p, q = (a + (a[:, column] / (a[:, column] - o[:, column]))[:, None] * (o - a) for o in (b, c))
    pieces = [soup[whole], np.stack([a, p, q], axis=1), np.stack([p, b, c], axis=1), np.stack([p, c, q], axis=1)]
    tip = count[split] == 1
    above = np.concatenate([count[whole] == 3, tip, ~tip, ~tip])
    source = np.concatenate([whole, split, split, split])
    return np.concatenate(pieces), source, above, np.stack([p, q], axis=1)
