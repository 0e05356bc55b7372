"""The earth's shape (WGS-84): from metres around a place to latitude, longitude and height, and back."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

SEMI_MAJOR_AXIS, FLATTENING = 6378137.0, 1 / 298.257223563
ECCENTRICITY2 = FLATTENING * (2 - FLATTENING)


def ecef(geodetic: Array) -> Array:
    """Earth-fixed metres of latitude, longitude (radians) and height (metres). (..., 3) -> (..., 3)."""
    lat, lon, height = np.moveaxis(geodetic, -1, 0)
    N = SEMI_MAJOR_AXIS / np.sqrt(1 - ECCENTRICITY2 * np.sin(lat) ** 2)
    r = (N + height) * np.cos(lat)
    return np.stack([r * np.cos(lon), r * np.sin(lon), (N * (1 - ECCENTRICITY2) + height) * np.sin(lat)], axis=-1)


def geodetic(position: Array) -> Array:
    """Latitude, longitude (radians) and height (metres) of earth-fixed metres. (..., 3) -> (..., 3).

    Bowring's iteration on the reduced latitude: near the ground two rounds leave less than a nanometre.
    """
    x, y, z = np.moveaxis(position, -1, 0)
    r, b = np.hypot(x, y), SEMI_MAJOR_AXIS * (1 - FLATTENING)
    reduced = np.arctan2(z, (1 - FLATTENING) * r)
    for _ in range(3):
        lat = np.arctan2(
            z + ECCENTRICITY2 / (1 - ECCENTRICITY2) * b * np.sin(reduced) ** 3,
            r - ECCENTRICITY2 * SEMI_MAJOR_AXIS * np.cos(reduced) ** 3,
        )
        reduced = np.arctan2((1 - FLATTENING) * np.sin(lat), np.cos(lat))
    height = r * np.cos(lat) + z * np.sin(lat) - SEMI_MAJOR_AXIS * np.sqrt(1 - ECCENTRICITY2 * np.sin(lat) ** 2)
    return np.stack([lat, np.arctan2(y, x), height], axis=-1)


def enu_axes(geodetic: Array) -> Array:
    """``R_ecef_enu``, whose columns are east, north and up at a place. (..., 3) -> (..., 3, 3)."""
    lat, lon = geodetic[..., 0], geodetic[..., 1]
    s, c, so, co = np.sin(lat), np.cos(lat), np.sin(lon), np.cos(lon)
    east = np.stack([-so, co, np.zeros_like(s)], axis=-1)
    north = np.stack([-s * co, -s * so, c], axis=-1)
    up = np.stack([c * co, c * so, s], axis=-1)
    return np.stack([east, north, up], axis=-1)
