"""A sensor type under test: how to simulate it, and how well it can be expected to do."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib_toolkit import se3
from calib_toolkit.hookspecs import Sensor
from calib_toolkit.testing.drives import Drive
from calib_toolkit.types import Motions, Stream, Trajectory

Array = NDArray[np.float64]

Simulate = Callable[[Array, Array, int], Stream]
"""``T_world_sensor (n, 4, 4), stamps (n,), seed`` to the stream that such a sensor would record."""


@dataclass(frozen=True, eq=False)
class SensorCase:
    """One sensor type under test.

    simulate: makes its stream out of true poses. options: defaults to those of the sensor.
    T_vehicle_sensor: (4, 4) how it is mounted (a camera looks along its z); vehicle x forward, z up.
    readings, period: length of each drive and seconds between readings; few, where readings are dear.
    slope: how far the regression of measured on true motion may be from one.
    still: how far the median motion at rest may be from none, metres and radians.
    nees: bounds of the mean squared error in claimed sigmas, per degree of freedom (one is ideal).
    skip: check name to the reason why it does not apply.
    """

    sensor: Sensor
    simulate: Simulate
    name: str = ""
    options: Any = None
    T_vehicle_sensor: Array = field(default_factory=lambda: np.eye(4))
    readings: int = 41
    period: float = 0.1
    slope: float = 0.1
    still: tuple[float, float] = (0.05, 0.005)
    nees: tuple[float, float] = (0.3, 3.0)
    skip: Mapping[str, str] = field(default_factory=dict)

    @property
    def id(self) -> str:
        """What the case is called in test names."""
        return self.name or self.sensor.id

    def stream(self, drive: Drive, seed: int = 0) -> Stream:
        """What the sensor records on a drive."""
        stamps = self.period * np.arange(self.readings, dtype=np.float64)
        return self.simulate(drive.pose(stamps) @ self.T_vehicle_sensor, stamps, seed)

    def estimate(self, stream: Stream) -> Motions | Trajectory:
        """What the sensor makes of a stream, with the options of the case, else the stream's, else its own."""
        options = self.options if self.options is not None else self.sensor.options(**stream.options)
        return self.sensor.estimate(stream, options)

    @lru_cache(maxsize=8)  # noqa: B019  a case lives as long as its test module
    def found(self, drive: Drive) -> Motions | Trajectory:
        """What the sensor makes of a drive; made once for all checks."""
        return self.estimate(self.stream(drive))

    def measured(self, drive: Drive) -> Motions:
        """The motions it measures on a drive."""
        found = self.found(drive)
        return found.motions() if isinstance(found, Trajectory) else found

    def truth(self, drive: Drive, motions: Motions) -> Array:
        """(n, 6) the true motions between the same stamps; unit translations if the sensor has no scale."""
        T_start, T_end = (drive.pose(t) @ self.T_vehicle_sensor for t in (motions.start, motions.end))
        vec = se3.vector(se3.relative(T_start, T_end))
        if not motions.has_scale:
            length = np.linalg.norm(vec[:, :3], axis=1, keepdims=True)
            vec[:, :3] /= np.where(length > 0.0, length, 1.0)
        return vec
