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
from scipy.spatial.transform import Rotation

from calib_toolkit import Calibration, DataError, Dataset, Log, MotionReading, ReadContext, Stream, hookimpl, se3
from calib_toolkit_datasets.simulation.vehicle import GRID, MARGIN, TruePath, path

Array = NDArray[np.float64]


@hookimpl
def calib_register_datasets() -> list[Dataset]:
    """Simulated drives."""
    return [Dataset("simulated", "a folder with simulated.toml", _matches, read)]


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


def measure(true: TruePath, sensor: SimulatedSensor, seed: int) -> Stream:
    """What the sensor makes of the drive: stamped motions with noise, as an ``odometry`` stream."""
    rng = np.random.default_rng([seed, *sensor.name.encode()])
    first, last = true.stamps[0] + MARGIN, true.stamps[-1] - MARGIN
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
