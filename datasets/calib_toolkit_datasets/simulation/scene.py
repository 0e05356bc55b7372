"""The world of a simulated drive: what stands and moves there, and what rays meet in it."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib_toolkit_datasets.simulation.layouts import LAYOUTS as _LAYOUTS
from calib_toolkit_datasets.simulation.layouts import furnished
from calib_toolkit_datasets.simulation.shapes import Array, Mesh, merge
from calib_toolkit_datasets.simulation.surfaces import Floats, Hits
from calib_toolkit_datasets.simulation.terrain import Terrain
from calib_toolkit_datasets.simulation.traffic import Mover, traffic
from calib_toolkit_datasets.simulation.vehicle import TruePath

LAYOUTS = tuple(_LAYOUTS)
FARTHEST = 100.0
"""Metres beyond which moving things are not looked for."""
SCATTERED = 5.0
"""Metres by which rays' origins are spread so that one cone for all would hold nearly every ray."""


def build(path: TruePath, ground: Terrain, layout: str, seed: int) -> "World":
    """The world round a path: the same for the same arguments. layout: one of ``LAYOUTS``.

    Raises ValueError for a layout that there is not.
    """
    if layout not in LAYOUTS:
        raise ValueError(f"there is no scene '{layout}'; there are: {', '.join(LAYOUTS)}")
    site = furnished(path, ground, layout, seed)
    shapes, movers = traffic(path, site, layout)
    standing = merge(site.meshes)
    # a long drive's pieces are not kept beside the whole
    site.meshes.clear()
    return World(standing, shapes, movers)


class World:
    """A scene to cast rays into. Casts run on one thread.

    Rays are single precision: positions are good to 6e-5 m within a kilometre of the origin.
    """

    def __init__(self, standing: Mesh, shapes: list[Mesh], movers: list[Mover]) -> None:
        self.movers = movers
        self._standing = _Solid(standing)
        self._shapes = [_Solid(shape) for shape in shapes]

    def __len__(self) -> int:
        """Triangles of everything that stands still."""
        return len(self._standing.material)

    def cast(self, origins: Array, directions: Array, stamps: Array) -> Hits:
        """What each ray meets at its own instant. (n, 3) world metres, (n, 3) unit, (n,) seconds -> n hits."""
        rays = np.empty((len(origins), 6), dtype=np.float32)
        rays[:, :3], rays[:, 3:] = origins, directions
        distance, face = self._standing.cast(rays)
        solid = self._standing
        reached: Floats = np.where(np.isfinite(distance), distance, np.float32(0))
        normal = _facing(solid.normal.take(face, axis=0, mode="clip"), rays[:, 3:])
        hits = Hits(
            distance,
            rays[:, :3] + reached[:, None] * rays[:, 3:],
            normal,
            normal.copy(),
            solid.material.take(face, mode="clip"),
            solid.tone.take(face, mode="clip"),
        )
        if len(stamps):
            bundle = _Bundle(rays, stamps)
            for mover in self.movers:
                if mover.start <= bundle.first and mover.end >= bundle.last:
                    self._meet(mover, bundle.toward(mover, self._shapes[mover.mesh]), hits, origins, rays, stamps)
        return hits

    def _meet(
        self, mover: Mover, chosen: NDArray[np.int64], hits: Hits, origins: Array, rays: Floats, stamps: Array
    ) -> None:
        """Puts a moving thing into the hits of those chosen rays that meet it before anything else."""
        if not len(chosen):
            return
        solid = self._shapes[mover.mesh]
        pose = mover.at(stamps[chosen])
        cos, sin = np.cos(pose[:, 3]), np.sin(pose[:, 3])
        own = np.column_stack(
            [_turn(origins[chosen] - pose[:, :3], cos, -sin), _turn(rays[chosen, 3:], cos, -sin)]
        ).astype(np.float32)
        distance, face = solid.cast(own)
        nearer = distance < hits.distance[chosen]
        k, own, face, distance = chosen[nearer], own[nearer], face[nearer], distance[nearer]
        hits.distance[k] = distance
        hits.position[k] = own[:, :3] + distance[:, None] * own[:, 3:]
        hits.normal[k] = _facing(solid.normal[face], own[:, 3:])
        hits.normal_world[k] = _turn(hits.normal[k], cos[nearer], sin[nearer])
        hits.material[k] = solid.material[face]
        hits.tone[k] = mover.tone


class _Solid:
    """A mesh that rays can be cast into, with the normal, material and tone of each of its triangles."""

    def __init__(self, mesh: Mesh) -> None:
        import open3d as o3d

        normal = np.cross(mesh.corners[:, 1] - mesh.corners[:, 0], mesh.corners[:, 2] - mesh.corners[:, 0])
        area = np.linalg.norm(normal, axis=1)
        kept = area > 1e-8
        corners = mesh.corners[kept].astype(np.float32)
        index = np.arange(3 * len(corners), dtype=np.uint32).reshape(-1, 3)
        self._tensor: Any = o3d.core.Tensor.from_numpy
        self._scene: Any = o3d.t.geometry.RaycastingScene(nthreads=1)
        self._scene.add_triangles(self._tensor(corners.reshape(-1, 3)), self._tensor(index))
        self.normal = (normal[kept] / area[kept, None]).astype(np.float32)
        self.material = mesh.material[kept]
        self.tone = mesh.tone[kept].astype(np.float32)
        self.radius = float(np.linalg.norm(corners, axis=2).max())

    def cast(self, rays: Floats) -> tuple[Floats, NDArray[np.uint32]]:
        """Distance (inf for a miss) and triangle of each ray (n, 6)."""
        found = self._scene.cast_rays(self._tensor(rays), nthreads=1)
        return found["t_hit"].numpy(), found["primitive_ids"].numpy()


class _Bundle:
    """Rays of one reading: where and when they start, and which of them go towards something."""

    def __init__(self, rays: Floats, stamps: Array) -> None:
        self.first, self.last = float(stamps.min()), float(stamps.max())
        ends = np.array([[column.min(), column.max()] for column in rays[:, :3].T])
        self._from = ends.mean(axis=1)
        self._spread = float(np.linalg.norm(np.ptp(ends, axis=1))) / 2
        self._directions = rays[:, 3:]
        if self._spread > SCATTERED:
            self._origins = rays[:, :3] - self._from.astype(np.float32)
            self._along = np.einsum("ij,ij->i", self._origins, self._directions)
            self._squared = np.einsum("ij,ij->i", self._origins, self._origins)

    def toward(self, mover: Mover, solid: _Solid) -> NDArray[np.int64]:
        """Rays that may meet a moving thing: those that pass the ball that it stays in meanwhile."""
        ends = mover.at(np.array([self.first, self.last]))[:, :3]
        ball = solid.radius + float(np.linalg.norm(ends[1] - ends[0])) / 2
        way = ends.mean(axis=0) - self._from
        away = float(np.linalg.norm(way))
        if away > FARTHEST + self._spread:
            return np.zeros(0, dtype=np.int64)
        centre = way.astype(np.float32)
        if self._spread > SCATTERED:
            along = self._directions @ centre - self._along
            passing = self._squared - 2 * (self._origins @ centre) + np.float32(away**2)
            return np.flatnonzero((passing - along**2 < ball**2) & (along > -ball))
        reach = ball + self._spread
        if away <= reach:
            return np.arange(len(self._directions))
        cosine = np.sqrt(1 - (reach / away) ** 2)
        return np.flatnonzero(self._directions @ (centre / np.float32(away)) >= cosine)


def _facing(normal: Floats, direction: Floats) -> Floats:
    along = normal[:, 0] * direction[:, 0] + normal[:, 1] * direction[:, 1] + normal[:, 2] * direction[:, 2]
    return np.asarray(np.copysign(np.float32(1), -along)[:, None] * normal, np.float32)


def _turn(v: Any, cos: Array, sin: Array) -> Array:
    return np.column_stack([cos * v[:, 0] - sin * v[:, 1], sin * v[:, 0] + cos * v[:, 1], v[:, 2]])
