"""The vehicle's own poses: the rows of ego_pose, and what of a GPS/INS they do not hold."""

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from calib_toolkit import Fix, se3, tables
from calib_toolkit.errors import DataError
from calib_toolkit.types import PoseReading
from calib_toolkit_datasets import stamps
from calib_toolkit_datasets.nuscenes.tables import Found, Place, Row
from calib_toolkit_datasets.simulation import earth

Array = NDArray[np.float64]

NAME, TABLE = "ego", "ego_pose"
MODALITY = "ego"
"""Of a channel that holds the vehicle's poses as they were measured; nuScenes has none."""
SPACING_NS = 45_000_000
"""Least time between two poses of nuScenes' own: one for each reading of each sensor, some hardly apart, are drawn
from fewer, and steps that are shorter than between those tell of the drawing and not of the vehicle."""
FIX = ("lat", "lon", "alt", "roll", "pitch", "yaw")


def read(place: Place, rows: Sequence[Row], channel: str) -> tuple[Found | None, str]:
    """The poses that rows of sample_data name, and why there are none. Raises DataError.

    channel: that of the rows, if it is one of measured poses, which are all taken; "" if they are of other sensors.
    """
    wanted = {row.text("ego_pose_token") for row in rows if "ego_pose_token" in row.values}
    if not wanted:
        return None, f"no row of {place.tables / 'sample_data.json'} names an ego pose"
    if not (place.tables / "ego_pose.json").is_file():
        return None, f"{place.tables / 'ego_pose.json'} is missing"
    found = {token: row for row in place.rows("ego_pose") if (token := row.text("token")) in wanted}
    for row in rows:
        named = row.values.get("ego_pose_token")
        if named is not None and named not in found:
            raise DataError(f"{row.place}: ego_pose.json has no '{named[:60]}'; fetch the tables again")
    stamped = sorted(((row.stamp(), row) for row in found.values()), key=lambda pair: pair[0])
    ns = np.array([t for t, _ in stamped], dtype=np.int64)
    keep = np.flatnonzero((ns != tables.BLANK) & tables.increasing(ns))
    if not channel:
        keep = keep[stamps.spaced(ns[keep], SPACING_NS)]
    if not len(keep):
        return None, f"{place.tables / 'ego_pose.json'} has no pose with a stamp"
    kept = [stamped[k][1] for k in keep]
    kind = "gps_ins" if "fix" in kept[0].values else "odometry"
    readings = [_fix(row) if kind == "gps_ins" else _pose(row) for row in kept]
    return Found(kind, ns[keep], readings, topic=channel or TABLE), ""


def to_row(reading: Fix | PoseReading, T_world_ego: Array) -> dict[str, Any]:
    """What a row says of a pose, beside its token and stamp: ``fix`` and ``covariance`` are none of nuScenes' own."""
    row = pose_row(T_world_ego)
    if isinstance(reading, Fix):
        row["fix"] = {k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in asdict(reading).items()}
    elif reading.cov is not None:
        row["covariance"] = np.asarray(reading.cov, dtype=float).tolist()
    return row


def pose_row(T: Array) -> dict[str, Any]:
    """``translation``, and ``rotation`` as a quaternion w x y z."""
    x, y, z, w = Rotation.from_matrix(T[:3, :3]).as_quat(canonical=True).tolist()
    return {"translation": T[:3, 3].tolist(), "rotation": [w, x, y, z]}


def poses(readings: Sequence[Fix | PoseReading]) -> Array:
    """``T_world_ego`` (n, 4, 4) of readings; that of fixes in east, north and up of the first."""
    if not isinstance(readings[0], Fix):
        return np.stack([np.asarray(r.T_world_sensor, dtype=float) for r in readings if isinstance(r, PoseReading)])
    rows = np.array([[getattr(r, key) for key in FIX] for r in readings])
    axes = earth.enu_axes(rows[:, :3])
    R = axes @ Rotation.from_euler("ZYX", rows[:, :2:-1]).as_matrix()
    T_earth_ego = se3.rigid(R, earth.ecef(rows[:, :3]))
    return se3.invert(se3.rigid(axes[0], T_earth_ego[0, :3, 3])) @ T_earth_ego


def between(ns: tables.Nanoseconds, T: Array, wanted: tables.Nanoseconds) -> Array:
    """Poses (m, 4, 4) at wanted stamps (m,), of poses (n, 4, 4) at stamps (n,); before and after them the nearest."""
    if len(ns) < 2:
        return np.repeat(T, len(wanted), axis=0)
    at, known = np.clip(wanted - ns[0], 0, ns[-1] - ns[0]) / 1e9, (ns - ns[0]) / 1e9
    R = Slerp(known, Rotation.from_matrix(T[:, :3, :3]))(at).as_matrix()
    t = np.stack([np.interp(at, known, T[:, axis, 3]) for axis in range(3)], axis=-1)
    return se3.rigid(R, t)


def _pose(row: Row) -> PoseReading:
    return PoseReading(row.pose(), row.numbers("covariance", 6, 6) if "covariance" in row.values else None)


def _fix(row: Row) -> Fix:
    """Of a row that has the fix that its pose was made of."""
    values = row.values.get("fix")
    inner = Row(row.file, row.number, values if isinstance(values, dict) else {})
    lat, lon, alt, roll, pitch, yaw = (float(inner.numbers(key)) for key in FIX)
    sigma = {k: inner.numbers(k, 3) for k in ("sigma_position", "sigma_rpy") if inner.values.get(k) is not None}
    return Fix(lat, lon, alt, roll, pitch, yaw, **sigma)
