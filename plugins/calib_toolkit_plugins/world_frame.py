"""Clouds that are not as a scanner sees them, but moved to a world frame already: they tell no motion any more."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calib_toolkit import DataError, Stream

Array = NDArray[np.float64]

TRAVEL = 10.0
"""Metres that the middle of clouds must travel before anything is said."""
STEADY = 0.25
"""Share of it that must lie in each half: a bus that stops beside the scanner moves their middle once."""
UNMOVED = 0.1
"""How little of that, as a share, the scanner itself may be seen to move."""
MANY = 2000
"""Points of a cloud that are looked at."""
REMEDY = "calibration needs scans in the frame of their scanner: take them as recorded, or undo the poses first"


def middle_and_nearest(points: ArrayLike) -> Array:
    """(4,) the median of points (n, 3), and the distance within which their nearest twentieth lies; metres."""
    xyz = np.asarray(points, dtype=np.float64)
    xyz = xyz[:: max(len(xyz) // MANY, 1)]
    xyz = xyz[np.isfinite(xyz).all(axis=1)]
    if not len(xyz):
        return np.full(4, np.nan)
    return np.append(np.median(xyz, axis=0), np.quantile(np.linalg.norm(xyz, axis=1), 0.05))


def refuse_moved(stream: Stream, seen: Array, travelled: float, max_range: float) -> None:
    """Refuse scans whose middle travels on while they lie on one another as they are.

    seen: (n, 4) of successive scans, as :func:`middle_and_nearest` says. travelled: metres that registration finds in
    all. A scanner that drives sees the same around it all the time, and its scans lie apart; one that stands does not
    see its surroundings travel. Raises DataError.
    """
    seen = seen[np.isfinite(seen).all(axis=1)]
    if len(seen) < 3:
        return
    where = f"sensor {stream.name}, at {stream.stamps[0]:.3f} s: its clouds"
    if np.all(seen[:, 3] > max_range):
        raise DataError(
            f"{where} begin {seen[:, 3].min():.0f} m from the scanner, beyond its range of {max_range:g} m; they "
            f"look like they were moved to a world frame already, or are not in metres; {REMEDY}"
        )
    first, middle, last = (part.mean(axis=0) for part in np.array_split(seen[:, :3], 3))
    away = float(np.linalg.norm(last - first))
    halves = (middle - first) @ (last - first), (last - middle) @ (last - first)
    if away > TRAVEL and min(halves) > STEADY * away**2 and travelled < UNMOVED * away:
        raise DataError(
            f"{where} look like they were moved to a world frame already: their middle travels {away:.0f} m while "
            f"they lie on one another as they are; {REMEDY}"
        )
