"""What one reading of each kind of sensor is, and how readings stay on disk until they are wanted.

A camera's reading is a plain ``uint8`` array, (h, w) grey or (h, w, 3) in OpenCV's BGR order.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, overload

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Scan:
    """One sweep of a lidar.

    points: (n, 3) metres, sensor frame, each as measured (not corrected for motion).
    times: (n,) seconds relative to the reading's stamp, or None when the sensor does not tell.
    intensity: (n,) or None. ring: (n,) integers from the lowest beam up, or None.
    """

    points: NDArray[np.float32]
    times: NDArray[np.float32] | None = None
    intensity: NDArray[np.float32] | None = None
    ring: NDArray[np.int32] | None = None


@dataclass(frozen=True)
class Fix:
    """One fix of a GPS/INS: WGS-84 position and attitude of the sensor, with the accuracies it states.

    lat, lon: radians; alt: metres.
    roll, pitch, yaw: radians, ``R_world_sensor = Rz(yaw) Ry(pitch) Rx(roll)``, world east-north-up, yaw zero
    facing east and counter-clockwise positive (KITTI's OXTS). All three are nan of a receiver that tells
    positions alone.
    sigma_position: (3,) east, north, up in metres; sigma_rpy: (3,) radians; None where not stated.
    """

    lat: float
    lon: float
    alt: float
    roll: float
    pitch: float
    yaw: float
    sigma_position: Array | None = None
    sigma_rpy: Array | None = None


@dataclass(frozen=True)
class PoseReading:
    """A pose that something else estimated. T_world_sensor: (4, 4). cov: (6, 6) or None.

    The covariance is of ``(dt, delta)`` in ``t_true = t + dt``, ``R_true = Exp(delta) R``, world axes.
    """

    T_world_sensor: Array
    cov: Array | None = None


@dataclass(frozen=True)
class MotionReading:
    """The motion since the previous reading, as something else estimated it; None where it failed.

    vec: (6,) of ``T_prev_curr``; cov: (6, 6), noise additive per component of ``vec``.
    """

    vec: Array | None
    cov: Array | None = None


class LazyReadings(Sequence[Any]):
    """Readings that are loaded one at a time: ``readings[i]`` is ``load(keys[i])``.

    Slicing slices the keys; nothing is loaded until one reading is asked for, so a drive may be larger than
    memory. ``load`` must be picklable (a module-level function or a ``functools.partial`` of one).
    """

    def __init__(self, load: Callable[[Any], Any], keys: Sequence[Any]) -> None:
        self.load = load
        self.keys = tuple(keys)

    def __len__(self) -> int:
        return len(self.keys)

    @overload
    def __getitem__(self, i: int) -> Any: ...
    @overload
    def __getitem__(self, i: slice) -> "LazyReadings": ...
    def __getitem__(self, i: int | slice) -> Any:
        if isinstance(i, slice):
            return LazyReadings(self.load, self.keys[i])
        return self.load(self.keys[i])
