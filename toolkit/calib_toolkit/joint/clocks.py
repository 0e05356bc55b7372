"""Clocks that are late and run at a slightly different speed."""

from collections.abc import Hashable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Clocks:
    """of: (n,) which clock each sensor has, 0 the base's. dt, skew: (q,) of each clock, zero for the base's.

    A stamp s of clock c is base time ``s + dt[c] + skew[c] (s - t_ref)``.
    """

    of: NDArray[np.int64]
    dt: Array
    skew: Array
    t_ref: float

    @staticmethod
    def starting(names: Sequence[Hashable], dt: Array, t_ref: float) -> "Clocks":
        """From each sensor's clock by name (n,) and its offset (n,): sensors on one clock take the first's."""
        order = list(dict.fromkeys(names))
        of = np.array([order.index(c) for c in names], dtype=np.int64)
        first = np.array([int(np.flatnonzero(of == c)[0]) for c in range(len(order))])
        offsets = dt[first]
        offsets[0] = 0.0
        return Clocks(of, offsets, np.zeros(len(order)), t_ref)

    def __len__(self) -> int:
        return len(self.dt)

    def base_time(self, sensor: int, stamps: Array) -> Array:
        """A sensor's stamps in base time."""
        c = self.of[sensor]
        return np.asarray(stamps + self.dt[c] + self.skew[c] * (stamps - self.t_ref))

    def moved(self, dt: Array, skew: Array) -> "Clocks":
        """By so much (q,) each."""
        return replace(self, dt=self.dt + dt, skew=self.skew + skew)

    def within(self, other: "Clocks", most: float) -> "Clocks":
        """No further than so many seconds from others."""
        return replace(self, dt=np.clip(self.dt, other.dt - most, other.dt + most))


@dataclass(frozen=True)
class Late:
    """An offset known beforehand. clock: which. dt, sigma: seconds."""

    clock: int
    dt: float
    sigma: float
