"""A GPS/INS: fixes whose errors wander slowly, as an INS's do, and the accuracy that it states."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from calib_toolkit import Fix
from calib_toolkit_datasets.simulation.earth import ecef, enu_axes, geodetic
from calib_toolkit_datasets.simulation.vehicle import TruePath

Array = NDArray[np.float64]

ORIGIN = np.array([np.radians(49.0), np.radians(8.43), 115.0])
"""Where on earth the simulated world lies: latitude, longitude, height. Its x, y, z are east, north, up here."""
OUTAGE_DRIFT = 0.1


@dataclass(frozen=True)
class InsModel:
    """Errors of east, north, up (metres) and roll, pitch, yaw (radians), six numbers each.

    sigma: of the error that wanders; it is what the fixes state. correlation: seconds in which that error forgets
    itself (first-order Gauss-Markov). white: sigma of what is new in every fix. bias: a constant error.
    outages: spans of true seconds without GPS, in which the position drifts away at ``OUTAGE_DRIFT`` m/s (1 sigma
    an axis), stated so. jumps: true second, and the step east, north, up that the position makes then.
    """

    sigma: tuple[float, ...] = (0.03, 0.03, 0.05, 3e-4, 3e-4, 1e-3)
    correlation: float = 100.0
    white: tuple[float, ...] = (5e-4, 5e-4, 5e-4, 1e-5, 1e-5, 1e-5)
    bias: tuple[float, ...] = (0.0,) * 6
    outages: tuple[tuple[float, float], ...] = ()
    jumps: tuple[tuple[float, tuple[float, float, float]], ...] = ()


def fixes(
    model: InsModel, path: TruePath, T_vehicle_ins: Array, stamps: Array, rng: np.random.Generator
) -> list[Fix]:
    """What the INS says at true seconds ``stamps`` (n,), increasing."""
    T_world_ins = path.at(stamps) @ T_vehicle_ins
    R_ecef_world = enu_axes(ORIGIN)
    place = geodetic(ecef(ORIGIN) + T_world_ins[:, :3, 3] @ R_ecef_world.T)
    error, sigma_position = _errors(model, stamps, rng)
    axes = enu_axes(place)
    place = geodetic(ecef(place) + np.einsum("nij,nj->ni", axes, error[:, :3]))
    R_enu_ins = np.swapaxes(axes, 1, 2) @ R_ecef_world @ T_world_ins[:, :3, :3]
    rpy = Rotation.from_matrix(R_enu_ins).as_euler("ZYX")[:, ::-1] + error[:, 3:]
    sigma_rpy = np.array(model.sigma[3:])
    return [
        Fix(lat, lon, alt, roll, pitch, yaw, sigma, sigma_rpy)
        for (lat, lon, alt), (roll, pitch, yaw), sigma in zip(
            place.tolist(), rpy.tolist(), sigma_position, strict=True
        )
    ]


def _errors(model: InsModel, stamps: Array, rng: np.random.Generator) -> tuple[Array, Array]:
    """(n, 6) errors of position and attitude, and (n, 3) the sigma stated for the position."""
    drawn = rng.standard_normal((2, len(stamps), 6))
    kept = np.exp(-np.diff(stamps, prepend=-np.inf) / model.correlation)
    fresh = np.sqrt(1 - kept**2)[:, None] * drawn[0]
    wander = np.empty_like(fresh)
    last = np.zeros(6)
    for k in range(len(stamps)):
        last = wander[k] = kept[k] * last + fresh[k]
    error = model.bias + wander * model.sigma + drawn[1] * model.white
    variance = np.tile(np.square(model.sigma[:3]), (len(stamps), 1))
    for start, end in model.outages:
        without = np.where((stamps >= start) & (stamps < end), stamps - start, 0.0)[:, None] * OUTAGE_DRIFT
        error[:, :3] += without * rng.standard_normal(3)
        variance += without**2
    for start, step in model.jumps:
        error[stamps >= start, :3] += step
    return error, np.sqrt(variance)
