"""A drive that never happened: motion-level readings of a simulated vehicle whose truth is exact.

A folder with a ``simulated.toml`` (``seconds``, ``seed``, ``drive``, and one ``[sensors.NAME]`` table each) is a
recording like any other; its reference calibration is the truth that the readings were made with.
"""

import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from calib_toolkit import Calibration, DataError, Dataset, Log, MotionReading, ReadContext, Stream, hookimpl, se3

Array = NDArray[np.float64]
GRID = 0.005
"""Seconds between the points of the vehicle's true path."""
DRIVES = ("street", "rough", "planar", "straight", "turn", "static")
LONGEST = 7200.0


@hookimpl
def calib_register_datasets() -> list[Dataset]:
    """Simulated drives."""
    return [Dataset("simulated", "a folder with simulated.toml", _matches, read)]


@dataclass(frozen=True)
class TruePath:
    """A true path. stamps: (m,) every ``GRID`` seconds; T_world_vehicle: (m, 4, 4)."""

    stamps: Array
    T_world_vehicle: Array

    def at(self, stamps: Array) -> Array:
        """Poses (n, 4, 4) at any stamps inside the drive."""
        k = np.clip(np.searchsorted(self.stamps, stamps, side="right") - 1, 0, len(self.stamps) - 2)
        T = self.T_world_vehicle[k]
        part = ((stamps - self.stamps[k]) / GRID)[:, None]
        step = se3.vector(se3.relative(T, self.T_world_vehicle[k + 1]))
        return T @ se3.matrix(part * step)


@dataclass(frozen=True)
class SimulatedSensor:
    """One sensor of a simulated rig.

    T_vehicle_sensor: (4, 4). dt: seconds added to its stamps to get vehicle time. rate: Hz. sigma: (6,) of each
    motion, metres and radians. stated: what it claims its sigma to be, as a multiple of the true one.
    outliers: share of readings that are wrong by up to twenty sigma.
    """

    name: str
    T_vehicle_sensor: Array
    dt: float = 0.0
    rate: float = 10.0
    sigma: tuple[float, ...] = (0.01, 0.01, 0.01, 5e-4, 5e-4, 5e-4)
    has_scale: bool = True
    stated: float = 1.0
    outliers: float = 0.0

    def __post_init__(self) -> None:
        if not np.all(np.isfinite(self.T_vehicle_sensor)) or not np.isfinite(self.dt):
            raise ValueError(f"the pose and dt of {self.name} must be finite numbers")
        if not 0.1 <= self.rate <= 1 / GRID:
            raise ValueError(f"the rate of {self.name} must be from 0.1 to {1 / GRID:g} Hz")
        if len(self.sigma) != 6 or not all(s > 0 for s in self.sigma):
            raise ValueError(f"the sigma of {self.name} must be six positive numbers")


def path(seconds: float, seed: int, drive: str = "street") -> TruePath:
    """The vehicle's path. drive: street (like KITTI drive 27), rough, planar, straight, turn or static.

    Turns, stops and speeds are drawn at random; roll, pitch and heave are those of a car on its suspension.
    """
    if drive not in DRIVES:
        raise ValueError(f"there is no drive '{drive}'; there are: {', '.join(DRIVES)}")
    if not 1.0 <= seconds <= LONGEST:
        raise ValueError(f"a drive takes from 1 to {LONGEST:g} s")
    rng = np.random.default_rng(seed)
    stamps = np.arange(-2.0, seconds + 2.0, GRID)
    speed, yaw_rate = _speed(stamps, rng), _yaw_rate(stamps, rng)
    swing = {"street": 1.0, "rough": 4.0}.get(drive, 0.0)
    if drive in ("straight", "static"):
        yaw_rate[:] = 0.0
    if drive == "turn":
        speed[:], yaw_rate[:] = 6.0, 0.3
    if drive == "static":
        speed[:] = 0.0
    yaw = np.cumsum(yaw_rate) * GRID
    roll = swing * np.radians(_noise(stamps, rng, 0.15) * 0.35 + _noise(stamps, rng, 1.5) * 0.26)
    pitch = swing * np.radians(_noise(stamps, rng, 0.15) * 0.3 + _noise(stamps, rng, 3.0) * 0.18)
    still = np.clip(speed / 2.0, 0.0, 1.0)
    R = Rotation.from_euler("ZYX", np.column_stack([yaw, pitch * still, roll * still])).as_matrix()
    ahead = np.column_stack([np.cos(yaw), np.sin(yaw), np.zeros(len(yaw))]) * speed[:, None]
    t = np.cumsum(ahead, axis=0) * GRID
    t[:, 2] += swing * still * _noise(stamps, rng, 0.2) * 0.02
    return TruePath(stamps, se3.rigid(R, t))


def measure(true: TruePath, sensor: SimulatedSensor, seed: int) -> Stream:
    """What the sensor makes of the drive: stamped motions with noise, as an ``odometry`` stream."""
    rng = np.random.default_rng([seed, *sensor.name.encode()])
    first, last = true.stamps[0] + 2.0, true.stamps[-1] - 2.0
    at = np.arange(first + rng.uniform(0, 1 / sensor.rate), last, 1 / sensor.rate)
    poses = true.at(at) @ sensor.T_vehicle_sensor
    vec = se3.vector(se3.relative(poses[:-1], poses[1:]))
    sigma = np.array(sensor.sigma)
    noise = rng.normal(size=vec.shape) * sigma
    wrong = rng.random(len(vec)) < sensor.outliers
    noise[wrong] += rng.uniform(-20, 20, size=(int(wrong.sum()), 6)) * sigma
    stated = np.diag((sigma * sensor.stated) ** 2)
    length = np.linalg.norm(vec[:, :3], axis=1, keepdims=True)
    if not sensor.has_scale:
        # a camera knows the direction to an angle, however far it went
        vec[:, :3] = vec[:, :3] / np.maximum(length, 1e-9)
    vec = vec + noise
    if not sensor.has_scale:
        vec[:, :3] /= np.linalg.norm(vec[:, :3], axis=1, keepdims=True)
    readings = [MotionReading(None), *(MotionReading(v, stated) for v in vec)]
    return Stream(sensor.name, "odometry", at - sensor.dt, readings, has_scale=sensor.has_scale)


def truth(sensors: list[SimulatedSensor]) -> Calibration:
    """The calibration that the readings were made with; the first sensor is the base."""
    base = sensors[0]
    T = np.array([se3.relative(base.T_vehicle_sensor, s.T_vehicle_sensor) for s in sensors])
    n = len(sensors)
    return Calibration(
        base.name,
        tuple(s.name for s in sensors),
        T,
        np.array([s.dt - base.dt for s in sensors]),
        np.zeros((7 * n, 7 * n)),
        np.array([s.has_scale for s in sensors]),
        np.ones((n, 7), dtype=bool),
    )


def read(folder: Path, context: ReadContext) -> Log:
    """The drive that a simulated.toml describes. Raises DataError."""
    file = folder / "simulated.toml"
    try:
        table = tomllib.loads(file.read_text())
        sensors = [_sensor(name, values) for name, values in table["sensors"].items()]
        if not sensors:
            raise ValueError("it has no sensors")
        seed = int(table["seed"])
        true = path(float(table["seconds"]), seed, str(table.get("drive", "street")))
        return Log(folder, {s.name: measure(true, s, seed) for s in sensors}, reference=truth(sensors))
    except (OSError, KeyError, TypeError, ValueError, ArithmeticError, AttributeError, RecursionError) as e:
        raise DataError(f"{file} does not describe a simulated drive ({type(e).__name__}: {e})") from e


def _matches(folder: Path) -> bool:
    return (folder / "simulated.toml").is_file()


def _sensor(name: str, values: dict[str, Any]) -> SimulatedSensor:
    values = dict(values)
    pose = np.array(values.pop("pose"), dtype=float)
    pose[3:] = np.radians(pose[3:])
    T = se3.rigid(Rotation.from_euler("ZYX", pose[:2:-1]).as_matrix(), pose[:3])
    if "sigma" in values:
        values["sigma"] = tuple(float(s) for s in values["sigma"])
    return SimulatedSensor(name, T, **values)


def _noise(stamps: Array, rng: np.random.Generator, hertz: float) -> Array:
    """Smooth noise of unit standard deviation with little above the given frequency."""
    smooth = gaussian_filter1d(rng.normal(size=len(stamps)), 1 / (2 * np.pi * hertz * GRID), mode="wrap")
    smooth -= smooth.mean()
    return smooth / smooth.std()


def _speed(stamps: Array, rng: np.random.Generator) -> Array:
    """Between 5 and 12 m/s, with a stop now and then."""
    speed = 8.5 + 2.0 * _noise(stamps, rng, 0.03)
    for stop in np.arange(rng.uniform(20, 60), stamps[-1], rng.uniform(50, 90)):
        speed *= 1 - np.exp(-(((stamps - stop) / 3.0) ** 4))
    return np.maximum(speed, 0.0)


def _yaw_rate(stamps: Array, rng: np.random.Generator) -> Array:
    """Bends of a road, and a quarter turn every ten seconds or so."""
    rate = np.radians(2.5) * _noise(stamps, rng, 0.1)
    at = stamps[0]
    while at < stamps[-1]:
        at += rng.uniform(5, 15)
        width = rng.uniform(1.2, 2.0)
        turned = rng.choice([-1, 1]) * np.radians(rng.uniform(50, 100))
        rate += turned / (width * np.sqrt(2 * np.pi)) * np.exp(-0.5 * ((stamps - at) / width) ** 2)
    return rate
