"""Simulated rigs drawn at random, what an estimator makes of each, and how many are solved side by side.

The outcome of one rig is a dictionary of plain numbers; what it holds is said at :func:`solve`.
"""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import joblib
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from calib_toolkit import Calibration, CalibrationError, Config, Motions, bars, calibrate_motions, se3
from calib_toolkit_datasets.simulated import SimulatedSensor, measure, truth
from calib_toolkit_datasets.simulation.vehicle import GRID, MARGIN, TruePath, path

Array = NDArray[np.float64]
Outcome = dict[str, Any]

AXES = ("x", "y", "z", "rx", "ry", "rz", "dt")
NORMAL = ("street", "court", "rough")
"""Kinds of drive that tell everything."""
CONSTANT = "straight-constant"
"""Straight on at 9 m/s, which the simulator's ``straight`` is not: there the speed changes."""
MOST_DT = 0.05
"""Seconds: clock offsets are drawn up to this."""


@dataclass(frozen=True)
class Rig:
    """A rig and the drive it was on; the first sensor is the base."""

    seed: int
    drive: str
    seconds: float
    sensors: tuple[SimulatedSensor, ...]

    @property
    def path(self) -> TruePath:
        """The drive's true path."""
        if self.drive != CONSTANT:
            return path(self.seconds, self.seed, self.drive)
        stamps = np.arange(-MARGIN, self.seconds + MARGIN, GRID)
        ahead = np.column_stack([9.0 * stamps, np.zeros((len(stamps), 2))])
        return TruePath(stamps, se3.rigid(np.broadcast_to(np.eye(3), (len(stamps), 3, 3)), ahead))


@dataclass(frozen=True)
class Place:
    """Where sensors of a kind sit, about. pose: x y z metres, roll pitch yaw degrees. rates: Hz, one is drawn."""

    name: str
    pose: tuple[float, ...]
    rates: tuple[float, ...]
    has_scale: bool = True


PLACES = (
    Place("velo", (0.0, 0.0, 1.7, 0, 0, 0), (10.0,)),
    Place("ins", (-0.8, 0.3, 0.9, 0, 0, 0), (20.0, 12.5)),
    Place("cam0", (0.3, 0.1, 1.6, -90, 0, -90), (15.0, 10.0), has_scale=False),
    Place("velo1", (1.2, -0.6, 0.5, 5, -4, 120), (10.0, 20.0)),
    Place("cam1", (0.2, 0.8, 1.1, -90, 0, 0), (15.0, 10.0), has_scale=False),
    Place("ins1", (-1.0, 0.0, 2.0, 0, 0, 180), (20.0, 12.5)),
)
CAMERAS = tuple(
    Place(f"cam{i}", (np.cos(yaw), np.sin(yaw), 1.6, -90, 0, np.degrees(yaw) - 90), (10.0, 15.0), has_scale=False)
    for i, yaw in enumerate(np.arange(6) * np.pi / 3)
)


def draw(
    seed: int, drive: str, count: int, seconds: float = 60.0, places: Sequence[Place] = PLACES, level: bool = False
) -> Rig:
    """The first ``count`` places, each sensor up to 0.2 m from there and some 5 degrees turned, its clock off.

    level: the base stands upright and looks ahead. The base's clock is the vehicle's.
    """
    rng = np.random.default_rng([seed, count])
    sensors = []
    for i, place in enumerate(places[:count]):
        upright = level and i == 0
        turn = np.radians(5.0) * rng.normal(size=3) * (not upright)
        R = Rotation.from_rotvec(turn) * Rotation.from_euler("ZYX", place.pose[:2:-1], degrees=True)
        T = se3.rigid(R.as_matrix(), np.array(place.pose[:3]) + rng.uniform(-0.2, 0.2, 3))
        dt = rng.uniform(-MOST_DT, MOST_DT) * (i > 0)
        sensors.append(
            SimulatedSensor(place.name, T, float(dt), float(rng.choice(place.rates)), has_scale=place.has_scale)
        )
    return Rig(seed, drive, seconds, tuple(sensors))


def measured(rig: Rig) -> dict[str, Motions]:
    """What each sensor of the rig measures, on its own stamps."""
    true, found = rig.path, {}
    for sensor in rig.sensors:
        stream = measure(true, sensor, rig.seed)
        vec, cov = (np.array([getattr(r, part) for r in list(stream.readings)[1:]]) for part in ("vec", "cov"))
        found[sensor.name] = Motions(stream.stamps[:-1], stream.stamps[1:], vec, cov, sensor.has_scale)
    return found


def solve(rig: Rig, method: str, motions: Mapping[str, Motions] | None = None) -> Outcome:
    """What the method makes of the rig.

    Always seed and cpu seconds and ``refused``, the sentence or "". Unless refused: the sensors but the base as
    ``names`` (n,), ``error`` (n, 7) in the order of ``AXES`` (truth less estimate; turns are ``delta``),
    ``covariance`` (7n, 7n), ``determined`` (n, 7), ``flagged`` directions, and the method's ``statistics``.
    """
    motions = motions or measured(rig)
    start = time.process_time()
    try:
        result = calibrate_motions(motions, Config(method=method))
    except CalibrationError as e:
        return {"seed": rig.seed, "cpu": time.process_time() - start, "refused": str(e)}
    except Exception as e:
        e.add_note(f"{method} on the {rig.drive} of {rig.seconds:g} s, seed {rig.seed}, {len(rig.sensors)} sensors")
        raise
    c = result.calibration
    return {
        "seed": rig.seed,
        "cpu": time.process_time() - start,
        "refused": "",
        "names": list(c.names[1:]),
        "error": difference(c, truth(list(rig.sensors)))[1:].tolist(),
        "covariance": c.covariance[7:, 7:].tolist(),
        "determined": c.determined[1:].tolist(),
        "flagged": [dict(u.direction) for u in c.undetermined],
        "statistics": dict(result.statistics),
    }


def difference(found: Calibration, true: Calibration) -> Array:
    """(n, 7) truth less estimate of every sensor: metres, ``delta`` in radians, seconds."""
    T, T_true = found.T_base_sensor, true.T_base_sensor
    turn = se3.log_so3(T_true[:, :3, :3] @ np.swapaxes(T[:, :3, :3], 1, 2))
    shift, dt = T_true[:, :3, 3] - T[:, :3, 3], true.dt_base_sensor - found.dt_base_sensor
    return np.column_stack([shift, turn, dt])


def solve_all(task: Callable[[Any], Outcome], cases: Sequence[Any], jobs: int, what: str) -> list[Outcome]:
    """The outcome of every case, in their order, with a bar; one thread each."""
    found = []
    with bars() as progress, joblib.parallel_config(backend="loky", inner_max_num_threads=1):
        progress.begin(what, len(cases))
        pool = joblib.Parallel(n_jobs=jobs, return_as="generator")
        for outcome in pool(joblib.delayed(task)(case) for case in cases):
            found.append(outcome)
            progress.advance(what, 1)
    return found


def solved(outcomes: Sequence[Outcome]) -> list[Outcome]:
    """Those that were not refused."""
    return [o for o in outcomes if not o["refused"]]


def nees(outcome: Outcome, sensors: Sequence[int], axes: Sequence[int]) -> float:
    """Normalised estimation error squared of some axes of some sensors together; nan if any is undetermined."""
    rows = [7 * i + k for i in sensors for k in axes]
    error, cov = np.ravel(outcome["error"])[rows], np.array(outcome["covariance"])[np.ix_(rows, rows)]
    if not np.ravel(outcome["determined"])[rows].all():
        return float("nan")
    return float(error @ np.linalg.solve(cov, error))


def pulls(outcome: Outcome) -> Array:
    """(n, 7) errors as multiples of their stated sigma; nan where undetermined."""
    sigma = np.sqrt(np.diag(outcome["covariance"])).reshape(-1, 7)
    return np.array(outcome["error"]) / np.where(outcome["determined"], sigma, np.nan)
