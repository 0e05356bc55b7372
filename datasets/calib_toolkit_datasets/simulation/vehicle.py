"""The vehicle: a non-holonomic path with turns and stops, and a body that rolls, pitches and heaves on its springs.

Speeds, and how much of each turning rate lies at which frequency, are those measured on KITTI's drive 27 (its
100 Hz gyroscopes) and, for ``court``, on a small robot that circles a courtyard at walking speed.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from calib_toolkit import se3
from calib_toolkit_datasets.simulation.terrain import terrain

Array = NDArray[np.float64]
Bands = Sequence[tuple[float, float, float]]
"""Noise by frequency: from Hz, to Hz, standard deviation."""

GRID = 0.005
"""Seconds between the points of the vehicle's true path."""
MARGIN = 2.0
"""Seconds of path before the drive begins and after it ends."""
DRIVES = ("street", "rough", "court", "highway", "planar", "straight", "turn", "static")
SHORTEST, LONGEST = 60.0, 7200.0
"""Seconds: of the path that is drawn at least, and of the longest drive."""

ROLL: Bands = ((0.2, 0.5, 0.73), (0.5, 1, 0.74), (1, 2, 0.81), (2, 3, 0.48), (3, 5, 0.29), (5, 10, 0.17))
PITCH: Bands = ((0.2, 0.5, 0.46), (0.5, 1, 0.85), (1, 2, 1.54), (2, 3, 0.53), (3, 5, 0.17), (5, 10, 0.11))
YAW: Bands = ((0.02, 0.2, 3.0), (0.2, 0.5, 1.5), (0.5, 1, 0.7), (1, 2, 0.27), (2, 5, 0.12))
"""Degrees per second on a street."""
HEAVE: Bands = ((0.5, 1, 0.028), (1, 2, 0.038), (2, 3, 0.014), (3, 5, 0.005))
"""Metres per second."""
COURT_ROLL: Bands = ((0.2, 0.5, 0.35), (0.5, 1, 0.48), (1, 2, 1.1), (2, 3, 0.7), (3, 5, 0.22), (5, 10, 0.3))
COURT_PITCH: Bands = ((0.2, 0.5, 1.2), (0.5, 1, 1.6), (1, 2, 2.3), (2, 3, 0.46), (3, 5, 0.22), (5, 10, 0.17))
COURT_YAW: Bands = ((0.2, 0.5, 1.4), (0.5, 1, 1.0), (1, 2, 0.67), (2, 3, 0.4), (3, 5, 0.4), (5, 10, 0.3))
LEAN = 0.006
"""Radians of roll for each metre per second squared in a bend."""


@dataclass(frozen=True)
class TruePath:
    """A true path. stamps: (m,) every ``GRID`` seconds; T_world_vehicle: (m, 4, 4).

    The vehicle's axes are x ahead, y left, z up, from the ground below it. Between two stamps its rates are constant.
    """

    stamps: Array
    T_world_vehicle: Array

    def at(self, stamps: Array) -> Array:
        """Poses (n, 4, 4) at any stamps inside the drive."""
        k = np.clip(np.searchsorted(self.stamps, stamps, side="right") - 1, 0, len(self.stamps) - 2)
        T = self.T_world_vehicle[k]
        part = ((stamps - self.stamps[k]) / GRID)[:, None]
        step = se3.vector(se3.relative(T, self.T_world_vehicle[k + 1]))
        return T @ se3.matrix(part * step)


def path(seconds: float, seed: int, drive: str = "street") -> TruePath:
    """The vehicle's path, from ``MARGIN`` before 0 to ``MARGIN`` after ``seconds``.

    drive: street (like KITTI drive 27), rough (a street four times as bumpy), court (a small robot on unpaved
    ground), highway, and the failure cases planar, straight, turn (a circle) and static.
    """
    if drive not in DRIVES:
        raise ValueError(f"there is no drive '{drive}'; there are: {', '.join(DRIVES)}")
    if not 1.0 <= seconds <= LONGEST:
        raise ValueError(f"a drive takes from 1 to {LONGEST:g} s")
    rng = np.random.default_rng(seed)
    # slow changes need room: a short drive is the beginning of a longer one
    stamps = np.arange(-MARGIN, max(seconds, SHORTEST) + MARGIN, GRID)
    speed, yaw_rate = _course(stamps, rng, drive)
    yaw = np.cumsum(yaw_rate) * GRID
    ahead = np.column_stack([np.cos(yaw), np.sin(yaw)])
    xy = np.cumsum(ahead * speed[:, None], axis=0) * GRID
    xy -= xy[np.searchsorted(stamps, 0.0)]
    ground = terrain(seed, drive)
    R_world_ground = _on_slope(ground.gradient(xy), ahead)
    roughness = {"street": 1.0, "rough": 4.0, "court": 1.0, "highway": 0.7}.get(drive, 0.0)
    bumps = roughness * np.clip(speed / (0.3 if drive == "court" else 2.0), 0.0, 1.0)
    roll_bands, pitch_bands = (COURT_ROLL, COURT_PITCH) if drive == "court" else (ROLL, PITCH)
    roll = np.radians(_swing(stamps, rng, roll_bands)) + LEAN * speed * yaw_rate
    pitch = np.radians(_swing(stamps, rng, pitch_bands))
    R_ground_body = Rotation.from_euler("YX", np.column_stack([bumps * pitch, bumps * roll])).as_matrix()
    z = ground.height(xy) + bumps * _swing(stamps, rng, HEAVE)
    T_world_vehicle = se3.rigid(R_world_ground @ R_ground_body, np.column_stack([xy, z]))
    kept = stamps < seconds + MARGIN
    return TruePath(stamps[kept], T_world_vehicle[kept])


def _course(stamps: Array, rng: np.random.Generator, drive: str) -> tuple[Array, Array]:
    """Speed and yaw rate."""
    n = len(stamps)
    if drive == "static":
        return np.zeros(n), np.zeros(n)
    if drive == "turn":
        return np.full(n, 6.0), np.full(n, 0.3)
    if drive == "court":
        return _court(stamps, rng)
    if drive == "highway":
        speed = 27.0 + 2.5 * _slow(stamps, rng, 0.03)
        return speed, np.radians(1.2 * _slow(stamps, rng, 0.05) + 0.4 * _banded(stamps, rng, ((0.1, 0.5, 1.0),)))
    speed = _speed(stamps, rng)
    if drive == "straight":
        return speed, np.zeros(n)
    turns = _turns(stamps, rng)
    speed = speed * (1 - 0.5 * np.minimum(np.abs(turns) / 0.6, 1.0))
    moving = np.clip(speed / 2.0, 0.0, 1.0)
    return speed, moving * (turns + np.radians(_banded(stamps, rng, YAW)))


def _speed(stamps: Array, rng: np.random.Generator) -> Array:
    """Mostly between 4 and 13 m/s, with a stop now and then."""
    speed = 9.0 + 2.2 * _slow(stamps, rng, 0.03)
    for stop in np.arange(rng.uniform(20, 60), stamps[-1], rng.uniform(90, 150)):
        speed *= 1 - np.exp(-(((stamps - stop) / 3.0) ** 4))
    return np.maximum(speed, 0.0)


def _turns(stamps: Array, rng: np.random.Generator) -> Array:
    """A quarter turn every ten seconds or so, radians per second."""
    rate, at = np.zeros(len(stamps)), stamps[0]
    while at < stamps[-1]:
        at += rng.uniform(5, 17)
        width = rng.uniform(0.9, 1.6)
        turned = rng.choice([-1, 1]) * np.radians(rng.uniform(50, 100))
        rate += turned / (width * np.sqrt(2 * np.pi)) * np.exp(-0.5 * ((stamps - at) / width) ** 2)
    return rate


def _court(stamps: Array, rng: np.random.Generator) -> tuple[Array, Array]:
    """Round and round within some thirty metres, never twice the same way, at walking speed with short stops."""
    speed = np.clip(0.62 + 0.2 * _slow(stamps, rng, 0.03), 0.15, 1.0)
    for stop in np.arange(rng.uniform(30, 60), stamps[-1], rng.uniform(60, 90)):
        speed *= 1 - np.exp(-(((stamps - stop) / 2.0) ** 4))
    phase = np.linspace(0.0, 2 * np.pi * (1 + stamps[-1] / 80.0), 4 * len(stamps)) * rng.choice([-1, 1])
    b, c = rng.uniform(0.0, 2 * np.pi, 2)
    course = 10.0 * np.exp(1j * phase) + 3.0 * np.exp(1j * (b - 0.62 * phase)) + 1.6 * np.exp(1j * (c + 2.7 * phase))
    steps = np.diff(course)
    along = np.cumsum(np.abs(steps))
    heading = np.interp(np.cumsum(speed) * GRID, along, np.unwrap(np.angle(steps)))
    moving = np.clip(speed / 0.3, 0.0, 1.0)
    return speed, np.gradient(heading, GRID) + moving * np.radians(_banded(stamps, rng, COURT_YAW))


def _on_slope(gradient: Array, ahead: Array) -> Array:
    """Axes of the ground under the vehicle in the world: x along the heading, z upright on the slope. (n, 3, 3)."""
    z = np.column_stack([-gradient, np.ones(len(gradient))])
    z /= np.linalg.norm(z, axis=1, keepdims=True)
    x = np.column_stack([ahead, np.einsum("ij,ij->i", gradient, ahead)])
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    return np.stack([x, np.cross(z, x), z], axis=2)


def _slow(stamps: Array, rng: np.random.Generator, hertz: float) -> Array:
    """Smooth noise of unit standard deviation with little above the given frequency."""
    smooth = gaussian_filter1d(rng.normal(size=len(stamps)), 1 / (2 * np.pi * hertz * GRID), mode="wrap")
    smooth -= smooth.mean()
    return smooth / smooth.std()


def _banded(stamps: Array, rng: np.random.Generator, bands: Bands, integrate: bool = False) -> Array:
    """Noise whose standard deviation in each band of frequencies is the one given; or its integral over time."""
    n = len(stamps)
    hertz = np.fft.rfftfreq(n, GRID)
    density = np.zeros(len(hertz))
    for lowest, highest, sigma in bands:
        density[(hertz >= lowest) & (hertz < highest)] = sigma**2 / (highest - lowest)
    white = rng.normal(size=(2, len(hertz)))
    spectrum = (white[0] + 1j * white[1]) * np.sqrt(density * n / (4 * GRID))
    if integrate:
        spectrum[1:] /= 2j * np.pi * hertz[1:]
    return np.fft.irfft(spectrum, n)


def _swing(stamps: Array, rng: np.random.Generator, rates: Bands) -> Array:
    """What a rate with that noise adds up to."""
    return _banded(stamps, rng, rates, integrate=True)
