"""Where the search for an antenna begins: the clock offset at which its travel and the base's go together."""

import numpy as np
from numpy.typing import NDArray

from calib_toolkit.antenna import blocks
from calib_toolkit.antenna.blocks import Base
from calib_toolkit.types import Trajectory

Array = NDArray[np.float64]

MOST_LATE, TICK = 90.0, 0.5
"""Seconds: how far clocks may be apart, and by how much offsets that are tried differ."""
SELDOM = 1.0
"""Seconds between positions that are looked at."""
OVERLAP = 0.5
"""Of the positions that any offset brings together, how many another one must."""
AGREED = 0.35
"""Most of what a usual offset leaves unexplained, in squares, that the best one may leave."""


def lag(base: Base, positions: Trajectory) -> float | None:
    """Seconds to add to the stamps of positions, to half a second; None where no offset stands out."""
    tried = np.arange(-MOST_LATE, MOST_LATE + TICK / 2, TICK)
    tried = tried[np.argsort(np.abs(tried), kind="stable")]
    left, count = np.array([_unexplained(base, positions, dt) for dt in tried]).T
    allowed = (count > 0) & (count >= OVERLAP * count.max())
    if allowed.sum() < 3:
        return None
    mean = left[allowed] / count[allowed]
    best = int(np.argmin(mean))
    return float(tried[allowed][best]) if mean[best] < AGREED * np.median(mean) else None


def _unexplained(base: Base, positions: Trajectory, dt: float) -> tuple[float, int]:
    """Summed squares (m^2) of positions against the base's path, by stretches, and how many there are."""
    rows = blocks.cut(base, positions, dt, SELDOM)
    if not rows:
        return 0.0, 0
    R, p, q = blocks.turned(base, positions, rows, dt, np.zeros(3))
    total = sum(float(np.sum((a @ Q - b) ** 2)) for a, b, Q in zip(p, q, R, strict=True))
    return total, sum(map(len, rows))
