"""What a gyroscope or a receiver tells on its own: turns without travel, and travel that tells the heading."""

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from calib_toolkit import Fix, MotionReading

Array = NDArray[np.float64]

STEP = 0.05
"""Seconds that the turns of a gyroscope are added up to."""
NOISE = 0.002
"""Radians a second by which turn rates are off: of a cheap gyroscope, its drift included."""
QUIET = 2.0
"""Seconds of rest from which a bias is told."""
STILL, SHAKEN = 0.02, 0.06
"""By which turn rates (rad/s) and accelerations (m/s^2) vary less at rest; driving straight on shakes.
"""
LARGEST_BIAS = 0.1
SLIP = np.radians(2.0)
"""By how much a vehicle points elsewhere than it goes."""
LEVER = 1.5
"""Metres that an antenna may be from the axle; in a bend it goes elsewhere than the vehicle points."""
LEAN = np.radians(5.0)
"""Sigma of roll and pitch, which positions do not tell."""
UNKNOWN = np.pi
"""Sigma of the heading of a vehicle that stands."""
FAR = 0.5
"""Seconds before and after a position over which its course is told."""


def gyro_steps(
    stamps: Array, rates: Array, accelerations: Array
) -> tuple[NDArray[np.int64], list[MotionReading], Array | None]:
    """Turns integrated from angular rates: rows that are readings, the readings, and the bias that was taken off.

    stamps: (n,) seconds. rates: (n, 3) radians a second; accelerations: (n, 3), zero if not known.
    Translations say nothing: length one in some direction with a variance of one, to be used without scale.
    Bias: (3,), None if no time of rest was found.
    """
    bias = _bias(stamps, rates, accelerations)
    rates = rates - (0.0 if bias is None else bias)
    dt = np.diff(stamps)
    together = max(1, round(STEP / max(float(np.median(dt)), 1e-4)))
    rows = np.arange(0, len(stamps), together)
    turns = Rotation.from_rotvec((rates[1:] + rates[:-1]) / 2 * dt[:, None])
    readings = [MotionReading(None)]
    for a, b in pairwise(rows):
        turn = Rotation.identity()
        for k in range(a, b):
            turn = turn * turns[k]
        took = stamps[b] - stamps[a]
        cov = np.diag([1.0, 1.0, 1.0, *np.repeat((NOISE * took) ** 2 + 1e-10, 3)])
        readings.append(MotionReading(np.concatenate([[1.0, 0.0, 0.0], turn.as_rotvec()]), cov))
    return rows, readings, bias


def with_course(stamps: Array, fixes: list[Fix], usual: float) -> list[Fix]:
    """The positions with the course over ground as heading, level but for the climb, and sigmas of both.

    stamps: (n,) seconds. usual: sigma of a position that states none, metres. The heading of a point of the vehicle
    that goes through a bend is off by what its lever arm subtends, which the sigma says.
    """
    lat, lon, alt = (np.array([getattr(f, name) for f in fixes]) for name in ("lat", "lon", "alt"))
    radius = 6371000.0 + alt
    flat = np.stack([(lon - lon[0]) * radius * np.cos(lat), (lat - lat[0]) * radius, alt - alt[0]], axis=1)
    before, after = (np.searchsorted(stamps, stamps + d) for d in (-FAR, FAR))
    before, after = (
        np.minimum(before, np.arange(len(stamps)) - 1).clip(0),
        np.minimum(np.maximum(after, np.arange(len(stamps)) + 1), len(stamps) - 1),
    )
    went = flat[after] - flat[before]
    took = np.maximum(stamps[after] - stamps[before], 1e-6)
    ahead = np.linalg.norm(went[:, :2], axis=1)
    yaw, pitch = np.arctan2(went[:, 1], went[:, 0]), -np.arctan2(went[:, 2], np.maximum(ahead, 1e-3))
    sigma = np.array([np.full(3, usual) if f.sigma_position is None else f.sigma_position for f in fixes])
    noise = np.sqrt(2) * np.hypot(sigma[:, 0], sigma[:, 1]) / np.sqrt(2)
    steady = np.maximum(ahead, 1e-6)
    turn = np.abs(np.gradient(np.unwrap(yaw), stamps)) if len(stamps) > 1 else np.zeros(1)
    bend = LEVER * turn * took / steady
    sigma_yaw = np.minimum(np.sqrt((noise / steady) ** 2 + SLIP**2 + bend**2), UNKNOWN)
    sigma_yaw[ahead < 3 * noise] = UNKNOWN
    pitch = np.where(sigma_yaw < UNKNOWN, pitch, 0.0)
    return [
        Fix(f.lat, f.lon, f.alt, 0.0, float(p), float(y), s, np.array([LEAN, LEAN, float(sy)]))
        for f, p, y, s, sy in zip(fixes, pitch, yaw, sigma, sigma_yaw, strict=True)
    ]


def _bias(stamps: Array, rates: Array, accelerations: Array) -> Array | None:
    """(3,) mean of the quietest stretches, the vehicle standing."""
    size = int(np.searchsorted(stamps, stamps[0] + QUIET))
    if size < 10 or len(stamps) < size or not np.any(accelerations):
        return None
    parts, shakes = (x[: len(x) // size * size].reshape(-1, size, 3) for x in (rates, accelerations))
    mean, spread = parts.mean(axis=1), parts.std(axis=1).max(axis=1)
    still = (spread < STILL) & (np.abs(mean).max(axis=1) < LARGEST_BIAS)
    still &= shakes.std(axis=1).max(axis=1) < SHAKEN
    return np.median(mean[still], axis=0) if still.any() else None
