"""What a gyroscope tells on its own: turns without travel."""

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from calib_toolkit import MotionReading
from calib_toolkit.errors import DataError

Array = NDArray[np.float64]

STEP = 0.05
"""Seconds that the turns of a gyroscope are added up to."""
NOISE = 0.002
"""Radians a second by which turn rates are off: of a cheap gyroscope, its drift included."""
QUIET = 2.0
"""Seconds of rest from which a bias is told."""
STILL, SHAKEN = 0.02, 0.06
"""By which turn rates (rad/s) and accelerations (m/s^2) vary less at rest; driving straight on shakes."""
LARGEST_BIAS = 0.1
FASTEST, LARGEST_SHAKE = 100.0, 1e4
"""Radians a second, metres a second squared: what is beyond is no measurement."""


def turns(
    name: str, stamps: Array, rates: Array, accelerations: Array
) -> tuple[NDArray[np.int64], list[MotionReading], tuple[str, ...]]:
    """Rows that are readings, the readings, and sentences on what they do not tell. Raises DataError.

    Arguments as of :func:`gyro_steps`; accelerations that are no measurement count as not known.
    """
    if len(stamps) < 3:
        raise DataError(f"{name} has {len(stamps)} readings of turn rates, too few; leave it out")
    if not np.all(np.abs(rates) < FASTEST) or not np.any(rates):
        raise DataError(f"{name} holds no turn rates, or some beyond {FASTEST:g} rad/s; leave it out")
    usable = np.where(np.abs(accelerations) < LARGEST_SHAKE, accelerations, 0.0)
    rows, readings, bias = gyro_steps(stamps, rates, usable)
    notes = [f"{name} tells turns alone: where the Imu sits is not determined by it, only how it is turned"]
    if bias is None:
        notes.append(f"{name}: no time of rest was found, so a bias of its turn rates is not taken off")
    return rows, readings, tuple(notes)


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
