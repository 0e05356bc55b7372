"""A spinning lidar: every ray starts where the scanner is at its instant, so sweeps are bent as real ones are."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib_toolkit import Scan, se3
from calib_toolkit_datasets.simulation.surfaces import MATERIALS, Hits, Scene
from calib_toolkit_datasets.simulation.texture import reflectance
from calib_toolkit_datasets.simulation.vehicle import TruePath

Array = NDArray[np.float64]

GLASS_RETURNS = 0.1
DETECTABLE = 0.02
"""Signal, as reflectance at normal incidence 40 m away, of which about two thirds of the returns are found."""


@dataclass(frozen=True)
class LidarModel:
    """elevations: of the beams, radians, lowest first. columns: firings of all beams in one turn.

    rate: turns a second. range_sigma: metres along the ray. max_range: metres. dropout: share of the returns that
    are lost without a reason.
    """

    elevations: tuple[float, ...]
    columns: int
    rate: float = 10.0
    range_sigma: float = 0.02
    max_range: float = 120.0
    dropout: float = 0.01

    @property
    def rays(self) -> int:
        """Most points of one sweep."""
        return self.columns * len(self.elevations)


def _degrees(*blocks: tuple[float, float, int]) -> tuple[float, ...]:
    """Elevations of blocks of (lowest, highest, beams)."""
    return tuple(np.radians(np.concatenate([np.linspace(*block) for block in blocks])).tolist())


VELODYNE_16 = LidarModel(_degrees((-15.0, 15.0, 16)), 1800, range_sigma=0.03, max_range=100.0)
VELODYNE_32 = LidarModel(_degrees((-30.67, 10.67, 32)), 2170, max_range=100.0)
VELODYNE_64 = LidarModel(_degrees((-24.33, -8.83, 32), (-25 / 3, 2.0, 32)), 1900)
VELODYNE_128 = LidarModel(_degrees((-25.0, 15.0, 128)), 1800, range_sigma=0.03, max_range=200.0)
"""VLP-16, HDL-32E, HDL-64E with its two blocks of lasers, and one like the VLS-128."""


def sweep(
    model: LidarModel, scene: Scene, path: TruePath, T_vehicle_lidar: Array, stamp: float, rng: np.random.Generator
) -> Scan:
    """One turn, clockwise seen from above, from rear to rear; it looks ahead (x) at ``stamp``, true seconds.

    A point at azimuth a is measured ``-a / (2 pi)`` of a turn after the stamp, as KITTI's scanner does. Points are
    in the axes of the scanner at their own instant; intensity is from 0 to 1 in steps of 1/255.
    """
    azimuth = np.pi - 2 * np.pi * (np.arange(model.columns) + 0.5) / model.columns
    times = -azimuth / (2 * np.pi * model.rate)
    rays = _rays(azimuth, np.array(model.elevations))
    T_world_lidar = path.at(stamp + times) @ T_vehicle_lidar
    directions = se3.turn_vectors(T_world_lidar[:, :3, :3], rays).reshape(-1, 3)
    beams = len(model.elevations)
    origins, instants = (np.repeat(x, beams, axis=0) for x in (T_world_lidar[:, :3, 3], stamp + times))
    hits = scene.cast(origins, directions, instants)
    within = np.flatnonzero(hits.distance <= model.max_range)
    seen, distance, intensity = _echoes(model, hits[within], directions[within], rng)
    kept = within[seen]
    return Scan(
        (rays.reshape(-1, 3)[kept] * distance[:, None]).astype(np.float32),
        np.repeat(times, beams)[kept].astype(np.float32),
        intensity,
        np.tile(np.arange(beams, dtype=np.int32), model.columns)[kept],
    )


def _rays(azimuth: Array, elevation: Array) -> Array:
    """(columns, beams, 3) unit vectors in the scanner's axes."""
    out = np.empty((len(azimuth), len(elevation), 3))
    out[..., 0] = np.outer(np.cos(azimuth), np.cos(elevation))
    out[..., 1] = np.outer(np.sin(azimuth), np.cos(elevation))
    out[..., 2] = np.sin(elevation)
    return out


def _echoes(
    model: LidarModel, hits: Hits, directions: Array, rng: np.random.Generator
) -> tuple[NDArray[np.bool_], Array, NDArray[np.float32]]:
    """Which rays come back, (n,); and of those the measured distance and intensity, (m,) each.

    Weak echoes (dark, grazing, far) are missed, and glass lets most light through. The scanner evens out most of
    the loss of light with distance before it writes intensity, in 8 bit.
    """
    incidence = np.abs(np.einsum("ij,ij->i", hits.normal_world, directions))
    brightness = reflectance(hits)
    signal = brightness * incidence * (40.0 / np.maximum(hits.distance, 1.0)) ** 2
    chance = (1.0 - model.dropout) * -np.expm1(-signal / DETECTABLE)
    chance *= np.where(hits.material == MATERIALS.index("glass"), GLASS_RETURNS, 1.0)
    seen = rng.random(len(chance)) < chance
    distance = hits.distance[seen] + model.range_sigma * rng.standard_normal(int(seen.sum()))
    # compressed so that a street reads as in KITTI: half of all points from 0.2 to 0.4
    level = 0.8 * np.sqrt(brightness[seen] * np.sqrt(incidence[seen])) / (1.0 + (distance / 80.0) ** 2)
    level *= 1.0 + 0.05 * rng.standard_normal(len(level))
    return seen, distance, (np.round(255 * np.clip(level, 0.0, 1.0)) / 255).astype(np.float32)
