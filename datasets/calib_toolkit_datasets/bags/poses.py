"""Odometry and poses as poses, NavSatFix and Imu as the fixes of a GPS/INS."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from calib_toolkit import Fix, PoseReading, se3
from calib_toolkit.errors import DataError
from calib_toolkit_datasets.bags.index import Key, Source
from calib_toolkit_datasets.bags.messages import load, place

Array = NDArray[np.float64]

ODOMETRY, POSE = "nav_msgs/msg/Odometry", "geometry_msgs/msg/PoseStamped"
POSE_COV = "geometry_msgs/msg/PoseWithCovarianceStamped"
FIX, IMU = "sensor_msgs/msg/NavSatFix", "sensor_msgs/msg/Imu"
LAST_PLACE = np.array([90.0, 360.0, 1e5])
"""Degrees, degrees and metres: nothing on earth is beyond."""
HUGE = 1e9
"""Metres, and their squares: no pose and no covariance is beyond."""
UNIT = 0.01
"""How far from one the length of a quaternion may be."""


@dataclass(frozen=True)
class FixKey:
    """A NavSatFix, the Imu messages before and after it, and how far it is from the one to the other (0 to 1)."""

    fix: Key
    before: Key
    after: Key
    share: float


def load_pose(key: Key, source: Source, topic: str, kind: str, encoding: str, stated: bool) -> PoseReading:
    """One pose of an Odometry, PoseStamped or PoseWithCovarianceStamped. Raises DataError.

    stated: whether to believe its covariance, which ROS gives about the fixed axes of the parent frame, as here.
    """
    where, message = place(key, source, topic), load(key, source, topic, kind, encoding)
    pose = message.pose if kind == POSE else message.pose.pose
    R = rotation(pose.orientation, where).as_matrix()
    T = se3.rigid(R, np.array([pose.position.x, pose.position.y, pose.position.z]))
    if not np.all(np.abs(T) < HUGE):
        raise DataError(f"{where} holds a pose that is nowhere; leave it out")
    return PoseReading(T, np.array(message.pose.covariance, dtype=float).reshape(6, 6) if stated else None)


def covariance_is_usable(first: Any, last: Any) -> bool:
    """Whether the covariances of the first and last pose are errors of each pose alone.

    Those of a dead reckoning grow along the drive, and tell nothing of a step.
    """
    sizes = []
    for message in (first, last):
        cov = np.array(message.pose.covariance, dtype=float).reshape(6, 6)
        if not np.all(np.abs(cov) < HUGE) or not np.allclose(cov, cov.T) or np.linalg.eigvalsh(cov)[0] <= 0:
            return False
        sizes.append(np.array([np.trace(cov[:3, :3]), np.trace(cov[3:, 3:])]))
    return bool(np.all(sizes[1] < 4 * sizes[0]))


def load_fix(key: FixKey, source: Source, topics: tuple[str, str], encodings: tuple[str, str]) -> Fix:
    """Position, and attitude between two Imu messages. Raises DataError, naming file, topic and place."""
    fix = place_of(load(key.fix, source, topics[0], FIX, encodings[0]), place(key.fix, source, topics[0]))
    where = place(key.before, source, topics[1])
    ends = [load(k, source, topics[1], IMU, encodings[1]) for k in dict.fromkeys((key.before, key.after))]
    turns = Rotation.concatenate([rotation(m.orientation, where) for m in ends])
    between = Slerp([0.0, 1.0], turns)([key.share])[0] if len(ends) == 2 else turns[0]
    yaw, pitch, roll = between.as_euler("ZYX")
    variance = np.diag(np.array(ends[0].orientation_covariance, dtype=float).reshape(3, 3))
    sigma = np.sqrt(variance) if np.all(np.isfinite(variance) & (variance > 0)) else None
    return replace(fix, roll=float(roll), pitch=float(pitch), yaw=float(yaw), sigma_rpy=sigma)


def load_place(key: Key, source: Source, topic: str, encoding: str) -> Fix:
    """Position alone. Raises DataError, naming file, topic and place."""
    return place_of(load(key, source, topic, FIX, encoding), place(key, source, topic))


def place_of(message: Any, where: str) -> Fix:
    """The position of a NavSatFix, without attitude. Raises DataError for what is no place on earth."""
    at = np.array([message.latitude, message.longitude, message.altitude])
    if not np.isfinite(at).all() or np.any(np.abs(at) > LAST_PLACE):
        raise DataError(f"{where} holds no place on earth ({', '.join(map(str, at))}); leave it out")
    variance = np.diag(np.array(message.position_covariance, dtype=float).reshape(3, 3))
    stated = message.position_covariance_type and np.all(np.isfinite(variance) & (variance > 0))
    lat, lon = np.radians(at[:2])
    return Fix(float(lat), float(lon), float(at[2]), np.nan, np.nan, np.nan, np.sqrt(variance) if stated else None)


def has_orientation(message: Any) -> bool:
    """Whether an Imu message holds an attitude: ROS marks one that does not by a covariance of -1."""
    q = message.orientation
    level = (q.x, q.y, q.z, q.w) == (0.0, 0.0, 0.0, 1.0)  # what drivers without attitude leave
    return bool(message.orientation_covariance[0] != -1 and _unit(q) and not level)


def rotation(q: Any, where: str) -> Rotation:
    """Of a quaternion of length one. Raises DataError; the sentence begins with ``where``."""
    parts = [q.x, q.y, q.z, q.w]
    if not _unit(q):
        raise DataError(f"{where} holds a quaternion that is not of length one; leave it out")
    return Rotation.from_quat(parts)


def _unit(q: Any) -> bool:
    parts = np.array([q.x, q.y, q.z, q.w])
    return bool(np.all(np.abs(parts) < 2) and abs(np.linalg.norm(parts) - 1) < UNIT)


def between(received: NDArray[np.int64], wanted: NDArray[np.int64]) -> tuple[NDArray[np.int64], Array]:
    """Of each wanted stamp (m,) the row before it among stamps (n,) that increase, and how far it is to the next.

    Rows are -1 where a stamp lies outside.
    """
    row = np.searchsorted(received, wanted, side="right") - 1
    last = len(received) - 1
    inside = (row >= 0) & ((row < last) | (wanted == received[-1]))
    row = np.where(inside, np.minimum(row, last), 0)
    after = np.minimum(row + 1, last)
    step = np.maximum(received[after] - received[row], 1)
    return np.where(inside, row, -1), np.clip((wanted - received[row]) / step, 0.0, 1.0)
