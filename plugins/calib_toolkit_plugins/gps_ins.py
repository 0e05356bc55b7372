"""GPS/INS: fixes of position and attitude become poses with covariance (the paper's section V-C); fixes of a receiver
that tells no attitude, positions.

The world frame is the earth's own (ECEF, WGS-84): it needs no anchor, so every slice of a drive and every drive
share it, and coordinates of 6e6 m cost no more than a nanometre.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from calib_toolkit import DataError, Sensor, SensorTable, hookimpl, se3, tables
from calib_toolkit.types import Fix, Log, Stream, Trajectory

Array = NDArray[np.float64]

SEMI_MAJOR_AXIS, FLATTENING = 6378137.0, 1 / 298.257223563
"""The WGS-84 ellipsoid; metres."""

COLUMNS = ("stamp", "lat_deg", "lon_deg", "alt", "roll_deg", "pitch_deg", "yaw_deg")
ALONE = COLUMNS[:4]
"""Of a receiver that tells positions alone."""
SIGMA_COLUMNS = ("sigma_east", "sigma_north", "sigma_up", "sigma_roll_deg", "sigma_pitch_deg", "sigma_yaw_deg")


@dataclass(frozen=True)
class GpsInsOptions:
    """What is believed of a fix that does not state its own accuracy, and what counts as a jump.

    sigma_position: metres, each axis. sigma_rpy_deg: degrees, each angle (0.01 is what the paper's author took for
    KITTI, 0.03 for Shrimp). lean_deg: by how much roll, pitch and heading are off for minutes at least, whatever the
    fixes state (data sheets of good receivers). samples: draws of the Monte-Carlo conversion. max_speed: metres per
    second; a faster step is a jump of the position solution.
    """

    sigma_position: float = 0.05
    sigma_rpy_deg: float = 0.01
    lean_deg: tuple[float, float, float] = (0.03, 0.03, 0.1)
    samples: int = 100
    max_speed: float = 100.0


def estimate(stream: Stream, options: GpsInsOptions) -> Trajectory:
    """Poses in the earth frame from readings that are ``Fix``, with covariance by Monte Carlo (section V-C).

    As in the paper, the errors of two fixes are taken as independent, although most of the error that an INS
    states is shared by the fixes around it: relative motions are then better than claimed. A step faster than
    ``max_speed`` is a jump: it is kept, with a drift sigma of its own length, so that it weighs nothing.
    Where no fix tells an attitude (nan), the trajectory has none.
    Raises DataError for fixes that are not numbers or not in radians.
    """
    if len(stream) < 2:
        raise DataError(f"sensor {stream.name}: a motion takes two fixes, and there are {len(stream)}")
    fixes = [stream.readings[i] for i in range(len(stream))]
    rows = np.array([[f.lat, f.lon, f.alt, f.roll, f.pitch, f.yaw] for f in fixes])
    sigma = np.array([_sigma(f, options) for f in fixes])
    alone = bool(np.isnan(rows[:, 3:]).all())
    rows[:, 3:] = 0.0 if alone else rows[:, 3:]
    _check(stream, rows, sigma)
    R_world_enu = enu_axes(rows[:, 0], rows[:, 1])
    R_enu_sensor = _attitude(rows[:, 3:])
    T = se3.rigid(R_world_enu @ R_enu_sensor, ecef(rows[:, 0], rows[:, 1], rows[:, 2]))
    cov = _to_world(R_world_enu, _monte_carlo(rows[:, 3:], sigma, options.samples))
    drift = np.zeros_like(cov)
    step = np.linalg.norm(np.diff(T[:, :3, 3], axis=0), axis=1)
    jump = np.where(step > options.max_speed * np.diff(stream.stamps), step, 0.0)
    drift[1:, :3, :3] = jump[:, None, None] ** 2 * np.eye(3)
    lean = np.maximum(np.median(sigma[:, 3:], axis=0), np.radians(options.lean_deg))
    return Trajectory(stream.stamps, T, cov, drift, has_attitude=not alone, lean=lean)


def ecef(lat: Array, lon: Array, alt: Array) -> Array:
    """Earth-centred, earth-fixed positions of WGS-84 geodetic ones. Radians and metres, (n,) each -> (n, 3)."""
    e2 = FLATTENING * (2 - FLATTENING)
    N = SEMI_MAJOR_AXIS / np.sqrt(1 - e2 * np.sin(lat) ** 2)
    r = (N + alt) * np.cos(lat)
    return np.stack([r * np.cos(lon), r * np.sin(lon), (N * (1 - e2) + alt) * np.sin(lat)], axis=-1)


def enu_axes(lat: Array, lon: Array) -> Array:
    """``R_ecef_enu``, whose columns are east, north and up. Radians, (n,) each -> (n, 3, 3)."""
    s, c, so, co = np.sin(lat), np.cos(lat), np.sin(lon), np.cos(lon)
    east = np.stack([-so, co, np.zeros_like(s)], axis=-1)
    north = np.stack([-s * co, -s * so, c], axis=-1)
    up = np.stack([c * co, c * so, s], axis=-1)
    return np.stack([east, north, up], axis=-1)


def open_table(table: SensorTable) -> Log:
    """The stream of one GPS/INS table of a rig.toml. Raises DataError.

    ``fixes = FILE.csv``, whose first line names its columns: ``stamp,lat_deg,lon_deg,alt,roll_deg,pitch_deg,yaw_deg``
    and at will ``sigma_east,sigma_north,sigma_up`` (metres) and ``sigma_roll_deg,sigma_pitch_deg,sigma_yaw_deg``;
    of a receiver that tells positions alone the columns of angles are left out.
    """
    tables.refuse_unknown(table, ["fixes"])
    file = tables.table_file(table, "fixes")
    header = tables.read_rows(file, len(ALONE), len(COLUMNS + SIGMA_COLUMNS))[0]
    names = tuple(w.lower() for w in header.words)
    alone = names in (ALONE, ALONE + SIGMA_COLUMNS[:3])
    with_angles = names[:7] == COLUMNS and names[7:] in (SIGMA_COLUMNS, SIGMA_COLUMNS[:3], SIGMA_COLUMNS[3:], ())
    if not alone and not with_angles:
        raise DataError(
            f"{file}: its first line must be {','.join(COLUMNS)} and then, at will, "
            f"{','.join(SIGMA_COLUMNS[:3])} and {','.join(SIGMA_COLUMNS[3:])}, or the same without angles; it is "
            f"{','.join(header.words)}"
        )
    rows = tables.read_rows(file, len(names), len(names), titles=True)[1:]
    ns, numbers = tables.to_nanoseconds(rows), tables.to_numbers(rows, len(names))
    keep, notes = tables.usable_rows(ns, numbers, rows)
    epoch_ns = int(ns[keep[0]])
    columns = {c: np.deg2rad(x) if c.endswith("_deg") else x for c, x in zip(names, numbers[keep].T, strict=True)}
    values = np.stack([columns.get(c, np.full(len(keep), np.nan)) for c in COLUMNS[1:]], axis=1)
    position, rpy = (
        np.stack([columns[c] for c in group], axis=1) if group[0] in columns else [None] * len(keep)
        for group in (SIGMA_COLUMNS[:3], SIGMA_COLUMNS[3:])
    )
    fixes = [
        Fix(v[0], v[1], v[2], v[3], v[4], v[5], p, a) for v, p, a in zip(values.tolist(), position, rpy, strict=True)
    ]
    notes += () if rows[-1].cut else tables.unfinished(file)
    stream = Stream(table.name, "gps_ins", tables.seconds(ns[keep], epoch_ns), fixes, notes=notes)
    return Log(file, {table.name: stream}, epoch_ns)


def _attitude(rpy: Array) -> Array:
    """``R_enu_sensor`` of roll, pitch and yaw. (..., 3) -> (..., 3, 3)."""
    R: Array = Rotation.from_euler("ZYX", rpy[..., ::-1].reshape(-1, 3)).as_matrix()
    return R.reshape(*rpy.shape, 3)


def _sigma(fix: Fix, options: GpsInsOptions) -> Array:
    """(6,) east, north, up, roll, pitch, yaw: as stated, or where nothing or zero is stated as in the options."""
    believed = np.repeat([options.sigma_position, np.deg2rad(options.sigma_rpy_deg)], 3)
    stated = [np.zeros(3) if s is None else np.asarray(s, dtype=float) for s in (fix.sigma_position, fix.sigma_rpy)]
    sigma = np.concatenate(stated)
    return np.where(sigma == 0.0, believed, sigma)


def _check(stream: Stream, rows: Array, sigma: Array) -> None:
    """Refuses what can not be a fix, by name."""
    degrees = (np.abs(rows[:, [0, 4]]).max(axis=1) > 1.6) | (np.abs(rows[:, [1, 3, 5]]).max(axis=1) > 6.3)
    for bad, what in (
        (~np.isfinite(rows).all(axis=1), "holds nan or inf; drop that fix"),
        (
            ~(np.isfinite(sigma) & (sigma > 0.0)).all(axis=1),
            "states a sigma that is not positive; correct or drop it",
        ),
        (
            degrees,
            "has an angle beyond a full turn (or a latitude or pitch beyond 90 degrees); angles are in radians",
        ),
    ):
        if bad.any():
            k = int(np.argmax(bad))
            raise DataError(f"sensor {stream.name}: fix {k} at {stream.stamps[k]:.3f} s {what}")


def _monte_carlo(rpy: Array, sigma: Array, samples: int) -> Array:
    """(n, 6, 6) covariance of ``(dt, delta)`` in east-north-up axes, from sigmas of position, roll, pitch, yaw.

    Every fix gets the same draws, whose mean and covariance are made exactly those asked for: what is left to
    chance is only how the angles bend.
    """
    half = np.random.default_rng(0).standard_normal((max(samples // 2, 6), 6))
    draws = np.concatenate([half, -half])
    draws = draws @ np.linalg.inv(np.linalg.cholesky(draws.T @ draws / len(draws))).T
    error = draws * sigma[:, None, :]
    R_drawn = _attitude(rpy[:, None, :] + error[..., 3:])
    R_sensor_enu = np.swapaxes(_attitude(rpy), 1, 2)
    error[..., 3:] = se3.log_so3(R_drawn @ R_sensor_enu[:, None])
    return np.swapaxes(error, 1, 2) @ error / len(draws)


def _to_world(R_world_enu: Array, cov: Array) -> Array:
    turn = np.zeros_like(cov)
    turn[:, :3, :3] = turn[:, 3:, 3:] = R_world_enu
    return se3.rotate_cov(turn, cov)


@hookimpl
def calib_register_sensors() -> list[Sensor]:
    """GPS/INS, whatever the receiver."""
    return [Sensor("gps_ins", estimate, GpsInsOptions, open_table, chunk=1000, version="2")]
