"""Spinning lidar: motion by registration of successive sweeps (paper, section V-A)."""

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib_toolkit import DataError, Motions, Sensor, SensorTable, hookimpl, se3, tables
from calib_toolkit.types import LazyReadings, Log, Scan, Stream
from calib_toolkit_plugins import registration
from calib_toolkit_plugins.registration import Surface

Array = NDArray[np.float64]

KEYS = ("scans", "times", "turns")
TURNS = {"clockwise": -1.0, "counterclockwise": 1.0}
SUFFIXES = (".bin", ".npy", ".ply", ".pcd")


@dataclass(frozen=True)
class VelodyneOptions:
    """How sweeps are registered; lengths in metres.

    min_range, max_range: points outside are dropped (the vehicle itself; beams too far apart).
    cell: one point is kept of each cell of this size. gate: farthest match at the end, and largest
    point-to-plane residual (the paper's 0.2 m).
    range_sigma: noise along the beam from which the covariance follows (the paper's 0.1 m).
    max_jump: how far a step may be from the one before it; also the sigma of what the surroundings do not show.
    min_overlap: share of a sweep that must lie on the surfaces of the sweep before. min_points: with fewer left
    of it, a sweep is not used. deskew: move points to where the scanner was at the stamp. smoothing: weight of
    all earlier motions beside the previous one in doing so; 0 is the paper's, but one step's roll and pitch say
    little of the next. point_to_plane: answer with the paper's point-to-plane minimum instead of the
    plane-to-plane one, which is the more accurate.
    """

    min_range: float = 2.0
    max_range: float = 100.0
    cell: float = 0.25
    gate: float = 0.2
    range_sigma: float = 0.1
    max_jump: float = 3.0
    min_overlap: float = 0.5
    min_points: int = 200
    deskew: bool = True
    smoothing: float = 0.5
    point_to_plane: bool = False


@hookimpl
def calib_register_sensors() -> list[Sensor]:
    """The ``velodyne`` sensor."""
    return [Sensor(id="velodyne", estimate=estimate, options=VelodyneOptions, open_table=open_table, version="1")]


def estimate(stream: Stream, options: VelodyneOptions) -> Motions:
    """``T_prev_curr`` between the stamps of successive ``Scan`` readings, with the covariance of range noise.

    The previous motion is the first guess, and moves the points of a sweep to its stamp. A step that fails (too
    few points, too little overlap, a jump) is left out, and the one after it starts from nothing again.
    Raises DataError with fewer than two readings, or one that is not a scan.
    """
    if len(stream) < 2:
        raise DataError(f"sensor {stream.name}: a motion takes two scans, and there are {len(stream)}")
    steps = []
    prev, velocity, steady = _Sweep.read(stream, 0, options), None, None
    for k in range(1, len(stream)):
        curr, dt = _Sweep.read(stream, k, options), float(stream.stamps[k] - stream.stamps[k - 1])
        step = _step(prev, curr, dt, velocity, steady, options)
        if step is None:
            prev, velocity, steady = curr, None, None
        else:
            T_prev_curr, cov, prev = step
            vec = se3.vector(T_prev_curr)
            velocity = vec / dt
            steady = velocity if steady is None else options.smoothing * steady + (1 - options.smoothing) * velocity
            steps.append((stream.stamps[k - 1], stream.stamps[k], vec, cov))
    if not steps:
        return Motions(np.zeros(0), np.zeros(0), np.zeros((0, 6)), np.zeros((0, 6, 6)))
    start, end, vec, cov = (np.array(column) for column in zip(*steps, strict=True))
    return Motions(start, end, vec, cov)


def deskew(points: Array, times: Array, velocity: Array) -> Array:
    """Points, each as measured, moved to where the scanner was at the stamp (paper V-A).

    points: (n, 3) metres. times: (n,) seconds from the stamp. velocity: (6,) of ``vec`` per second. The rotation
    is taken to second order in the angle turned since the stamp: under a millimetre at 50 m and 20 degrees/s.
    """
    W = se3.skew(velocity[3:])
    t = times[:, None]
    return points + t * (points @ W.T + velocity[:3] + (0.5 * t) * (points @ (W @ W).T))


@dataclass(frozen=True)
class _Sweep:
    """The usable points of a scan as measured, or moved by a velocity once its surface is made."""

    points: Array
    times: Array | None
    options: VelodyneOptions
    made: Surface | None = None

    @staticmethod
    def read(stream: Stream, k: int, options: VelodyneOptions) -> "_Sweep":
        scan = stream.readings[k]
        where = f"sensor {stream.name}, scan {k} (stamp {stream.stamps[k]:.6f} s)"
        points = np.asarray(getattr(scan, "points", None), dtype=np.float64)
        times = None if getattr(scan, "times", None) is None else np.asarray(scan.times, dtype=np.float64)
        if points.ndim != 2 or points.shape[1] != 3:
            raise DataError(f"{where}: a velodyne reads Scans of (n, 3) points, not {type(scan).__name__}")
        if times is not None and times.shape != points.shape[:1]:
            raise DataError(f"{where}: {times.size} times for {len(points)} points; each point needs one or none")
        squared = np.einsum("ij,ij->i", points, points)
        usable = (squared > options.min_range**2) & (squared < options.max_range**2)  # False for nan
        if times is not None:
            usable &= np.isfinite(times)
            times = times[usable]
        return _Sweep(points[usable], times if options.deskew else None, options)

    @property
    def enough(self) -> bool:
        return len(self.points) >= self.options.min_points

    def surface(self, velocity: Array | None) -> Surface:
        """Made once, and then the same for both steps that the sweep is part of."""
        if self.made is not None:
            return self.made
        if velocity is None or self.times is None:
            return registration.surface(self.points, self.options.cell)
        return registration.surface(deskew(self.points, self.times, velocity), self.options.cell)

    def keeping(self, made: Surface) -> "_Sweep":
        return _Sweep(self.points, self.times, self.options, made)


def _step(
    prev: _Sweep, curr: _Sweep, dt: float, velocity: Array | None, steady: Array | None, options: VelodyneOptions
) -> tuple[Array, Array, _Sweep] | None:
    """``T_prev_curr``, its covariance, and the current sweep with its surface; None where it fails.

    velocity foresees the motion, steady moves the points; None at the start.
    """
    if not (prev.enough and curr.enough):
        return None
    if velocity is None:
        a, b = prev.surface(None), curr.surface(None)
        T_first = registration.register(a, b, np.eye(4), registration.FAR_LEVELS, options.gate)
        predicted, T_seed, steady = None, T_first, se3.vector(T_first) / dt
    else:
        predicted = T_seed = se3.matrix(velocity * dt)
    a, b = prev.surface(steady), curr.surface(steady)
    T = registration.register(a, b, T_seed, registration.NEAR_LEVELS, options.gate)
    if options.point_to_plane:
        T = registration.point_to_plane(a, b, T, options.gate)
    if predicted is not None and np.linalg.norm(T[:3, 3] - predicted[:3, 3]) > options.max_jump:
        return None
    residuals = registration.plane_residuals(a, b, T, options.gate)
    if residuals.overlap < options.min_overlap or len(residuals.errors) < options.min_points:
        return None
    cov = registration.range_covariance(residuals, options.range_sigma, options.max_jump)
    return (T, cov, curr.keeping(b)) if np.all(np.isfinite(T)) and np.all(np.isfinite(cov)) else None


def open_table(table: SensorTable) -> Log:
    """The stream of one velodyne table of a rig.toml. Raises DataError.

    Keys: ``scans``, a folder of .bin (KITTI: float32 x y z intensity), .npy (n, 3 or 4), .ply or .pcd files;
    ``times``, a file with the stamp of each, in the order of their names, as seconds or as KITTI's dates; at
    will ``turns = "clockwise"`` (seen from above) or ``"counterclockwise"``, which gives each point its time
    from its azimuth, the stamp being when the scanner looks along x.
    """
    tables.refuse_unknown(table, KEYS)
    where, turns = f"sensor {table.name}", table.values.get("turns")
    folder, times = tables.table_folder(table, "scans"), tables.table_file(table, "times")
    if turns is not None and turns not in TURNS:
        raise DataError(f"{where}: turns = {turns!r} is not known; write one of {', '.join(TURNS)}, or leave it out")
    files = sorted(f for f in folder.iterdir() if f.suffix in SUFFIXES)
    if not files:
        raise DataError(f"{where}: {folder} holds no scans ({', '.join(SUFFIXES)})")
    ns = tables.read_stamps(times)
    if len(ns) != len(files):
        raise DataError(f"{where}: {times} holds {len(ns)} stamps and {folder} {len(files)} scans; each needs one")
    if tables.BLANK in ns:
        line = ns.tolist().index(tables.BLANK) + 1
        raise DataError(f"{where}: {times}, line {line} holds no stamp; write one, or remove it and its scan")
    stamps = tables.seconds(ns, int(ns[0]))
    period = float(np.median(np.diff(stamps))) if len(stamps) > 1 else 0.0
    load = partial(_load, rate=TURNS[turns] * period / (2 * np.pi) if turns else None)
    stream = Stream(table.name, "velodyne", stamps, LazyReadings(load, files))
    return Log(times, {table.name: stream}, int(ns[0]))


def _load(file: Path, rate: float | None) -> Scan:
    """One scan file. rate: seconds per radian of azimuth, or None."""
    try:
        rows = _rows(file)
    except ImportError as e:
        raise DataError(f"{file} can not be read without Open3D ({e}); run script/setup or write .npy files") from e
    except (OSError, ValueError) as e:
        raise DataError(f"{file} is not a scan ({e}); write it anew or remove it with its stamp") from e
    if rows.ndim != 2 or rows.shape[1] < 3:
        raise DataError(f"{file} holds an array of shape {rows.shape}; a scan is (n, 3) or (n, 4)")
    points = np.ascontiguousarray(rows[:, :3], dtype=np.float32)
    times = None if rate is None else (rate * np.arctan2(points[:, 1], points[:, 0])).astype(np.float32)
    return Scan(points, times, intensity=rows[:, 3].astype(np.float32) if rows.shape[1] > 3 else None)


def _rows(file: Path) -> NDArray[Any]:
    if file.suffix == ".bin":
        flat = np.fromfile(file, dtype="<f4")
        if flat.size % 4:
            raise ValueError(f"{flat.size} numbers are not rows of four; it seems cut short")
        return flat.reshape(-1, 4)
    if file.suffix == ".npy":
        return np.asarray(np.load(file, allow_pickle=False))
    import open3d

    cloud = open3d.io.read_point_cloud(file)
    if not cloud.has_points():
        raise ValueError("Open3D finds no points in it")
    return np.asarray(cloud.points)
