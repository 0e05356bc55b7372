"""Meshes of simple solids: triangles by the array, from which everything beside the road is put together."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calib_toolkit_datasets.simulation.surfaces import MATERIALS

Array = NDArray[np.float64]
MATERIAL = {name: k for k, name in enumerate(MATERIALS)}


@dataclass(frozen=True)
class Mesh:
    """Triangles. corners: (m, 3, 3) metres; material: (m,) index of ``MATERIALS``; tone: (m,) from 0 to 1."""

    corners: Array
    material: NDArray[np.uint8]
    tone: Array

    def __len__(self) -> int:
        return len(self.corners)


def triangles(corners: ArrayLike, material: ArrayLike) -> Mesh:
    """Triangles (m, 3, 3) of one material or of one each."""
    c = np.asarray(corners, dtype=float).reshape(-1, 3, 3)
    return Mesh(c, np.broadcast_to(np.asarray(material, dtype=np.uint8), len(c)), np.zeros(len(c)))


def quads(corners: ArrayLike, material: str | ArrayLike) -> Mesh:
    """Quadrilaterals (k, 4, 3), corners in order round the edge, of one material or of one each."""
    c = np.asarray(corners, dtype=float).reshape(-1, 4, 3)
    made_of = MATERIAL[material] if isinstance(material, str) else np.repeat(np.asarray(material), 2)
    return triangles(np.stack([c[:, [0, 1, 2]], c[:, [0, 2, 3]]], axis=1), made_of)


def merge(meshes: Sequence[Mesh]) -> Mesh:
    """All of them in one, in the order given."""
    return Mesh(
        np.concatenate([np.zeros((0, 3, 3)), *(m.corners for m in meshes)]),
        np.concatenate([np.zeros(0, dtype=np.uint8), *(m.material for m in meshes)]),
        np.concatenate([np.zeros(0), *(m.tone for m in meshes)]),
    )


def place(
    mesh: Mesh, poses: ArrayLike, tone: ArrayLike, size: ArrayLike = (1.0, 1.0, 1.0), slope: ArrayLike = 0.0
) -> Mesh:
    """One copy of a mesh at each pose.

    poses: (k, 4) of x, y, z in metres and yaw in radians. tone: (k,) or one. size: (k, 3) or (3,), factors along
    the mesh's own axes. slope: (k,) or one, metres that it rises for each metre along its x.
    """
    p = np.atleast_2d(np.asarray(poses, dtype=float))
    cos, sin = np.cos(p[:, 3, None, None]), np.sin(p[:, 3, None, None])
    c = mesh.corners * np.broadcast_to(np.asarray(size, dtype=float), (len(p), 3))[:, None, None]
    up = c[..., 2] + np.broadcast_to(np.asarray(slope, dtype=float), len(p))[:, None, None] * c[..., 0]
    turned = np.stack([cos * c[..., 0] - sin * c[..., 1], sin * c[..., 0] + cos * c[..., 1], up], axis=-1)
    corners = (turned + p[:, None, None, :3]).reshape(-1, 3, 3)
    shade = np.repeat(np.broadcast_to(np.asarray(tone, dtype=float), len(p)), len(mesh))
    return Mesh(corners, np.tile(mesh.material, len(p)), shade)


def loft(rings: ArrayLike, material: str | ArrayLike) -> Mesh:
    """A skin over k cross-sections of n points each, (k, n, 3), with both ends closed (sections must be convex).

    material: a name, or (k - 1, n) indices, one for each face between section i, i + 1 and point j, j + 1. The ends
    take the material of the first point of the nearest section.
    """
    r = np.asarray(rings, dtype=float)
    around = np.roll(r, -1, axis=1)
    faces = np.stack([r[:-1], around[:-1], around[1:], r[1:]], axis=2)
    index = MATERIAL[material] if isinstance(material, str) else np.asarray(material)
    made_of = np.broadcast_to(index, faces.shape[:2])
    skin = quads(faces, made_of.reshape(-1))
    ends = [fan(ring, int(m)) for ring, m in ((r[0], made_of[0, 0]), (r[-1], made_of[-1, 0]))]
    return merge([skin, *ends])


def box(low: ArrayLike, high: ArrayLike, material: str) -> Mesh:
    """A box with edges along the axes, from one corner (3,) to the opposite one."""
    a, b = np.asarray(low, dtype=float), np.asarray(high, dtype=float)
    ring = np.array([[a[0], a[1]], [b[0], a[1]], [b[0], b[1]], [a[0], b[1]]])
    return loft([np.column_stack([ring, np.full(4, z)]) for z in (a[2], b[2])], material)


def tube(points: ArrayLike, radii: ArrayLike, material: str, sides: int = 6) -> Mesh:
    """A round bar through points (k, 3) with a radius at each (k,)."""
    p = np.asarray(points, dtype=float)
    along = np.gradient(p, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    aside = np.cross(along, np.where(np.abs(along[:, 2:]) > 0.7, [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]))
    aside /= np.linalg.norm(aside, axis=1, keepdims=True)
    turn = np.linspace(0, 2 * np.pi, sides, endpoint=False)[:, None]
    across = np.cos(turn) * aside[:, None] + np.sin(turn) * np.cross(along, aside)[:, None]
    return loft(p[:, None] + across * np.reshape(np.asarray(radii, dtype=float), (-1, 1, 1)), material)


def blob(
    centre: ArrayLike, radii: ArrayLike, material: str, rng: np.random.Generator, bumps: float, rows: int = 5
) -> Mesh:
    """A ball stretched to radii (3,) whose surface is uneven by a share ``bumps`` of its radius.

    It has ``rows`` rows of faces and two more faces round each.
    """
    lat = np.linspace(-0.47 * np.pi, 0.47 * np.pi, rows + 1)[:, None]
    lon = np.linspace(0, 2 * np.pi, rows + 2, endpoint=False)[None]
    ball = np.stack([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat) + 0 * lon], axis=-1)
    ball = ball * (1 + bumps * rng.uniform(-1, 1, (rows + 1, rows + 2, 1)))
    return loft(np.asarray(centre) + ball * np.asarray(radii), material)


def leaves(centre: ArrayLike, radii: ArrayLike, count: int, size: float, rng: np.random.Generator) -> Mesh:
    """Loose flat tufts of leaves, ``size`` metres across, scattered near the surface of a ball stretched to radii."""
    out = rng.normal(size=(count, 3))
    out /= np.linalg.norm(out, axis=1, keepdims=True)
    at = np.asarray(centre) + out * np.asarray(radii) * rng.uniform(0.75, 1.12, (count, 1))
    u, v = rng.normal(size=(2, count, 3)) * size / 3
    return quads(np.stack([at - u - v, at + u - 0.7 * v, at + 0.8 * u + v, at - u + v], axis=1), "leaves")


def ring(outer: Array, inner: Array) -> Array:
    """The four sides between two sets of quadrilaterals (k, 4, 3), as quadrilaterals (4 k, 4, 3)."""
    sides = np.stack([outer, np.roll(outer, -1, axis=1), np.roll(inner, -1, axis=1), inner], axis=2)
    return sides.reshape(-1, 4, 3)


def fan(edge: Array, material: int) -> Mesh:
    """A flat convex face with corners (n, 3), of the material with this index."""
    n = len(edge)
    return triangles(np.stack([np.repeat(edge[:1], n - 2, axis=0), edge[1:-1], edge[2:]], axis=1), material)
