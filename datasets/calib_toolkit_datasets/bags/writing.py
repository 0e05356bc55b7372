"""Logs as bags: the standard messages of each kind of sensor, stamped to the nanosecond.

Messages lie in the order of their stamps, which are also their times of receipt; a frame is called as its sensor is.
"""

import heapq
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from calib_toolkit import Calibration, Fix, Log, MotionReading, PoseReading, Progress, Scan, Stream, Written, se3
from calib_toolkit.errors import DataError
from calib_toolkit_datasets.bags import clouds, images, messages

Array = NDArray[np.float64]
Put = Callable[[str, int, Any], None]
"""Writes a message: topic, nanoseconds, message."""

WORLD = "world"


def write_bag1(log: Log, path: Path, progress: Progress) -> Written:
    """A ROS 1 bag. Raises DataError."""
    from rosbags.rosbag1 import Writer

    return _write(log, Writer(path), "ros1", progress)


def write_bag2(log: Log, path: Path, progress: Progress) -> Written:
    """The folder of a ROS 2 bag, stored by SQLite. Raises DataError."""
    from rosbags.rosbag2 import Writer

    return _write(log, Writer(path, version=9), "cdr", progress)


def write_mcap(log: Log, path: Path, progress: Progress) -> Written:
    """One MCAP file, as ROS 2 writes them. Raises DataError."""
    from rosbags.rosbag2 import StoragePlugin, Writer

    folder = path.with_name(f"{path.name}.folder")
    written = _write(log, Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP), "cdr", progress)
    (file,) = folder.glob("*.mcap")
    file.replace(path)
    (folder / "metadata.yaml").unlink()
    folder.rmdir()
    return written


def _write(log: Log, writer: AbstractContextManager[Any], encoding: str, progress: Progress) -> Written:
    writing = _Writing(log, encoding)
    for stream in log.streams.values():
        progress.begin(stream.name, len(stream))
    with writer as bag:
        connections: dict[str, Any] = {}

        def put(topic: str, ns: int, message: Any) -> None:
            if topic not in connections:
                connections[topic] = bag.add_connection(topic, message.__msgtype__, typestore=writing.store)
            bag.write(connections[topic], ns, messages.encode(message, encoding))

        if log.reference is not None and log.streams:
            put("/tf_static", log.epoch_ns + round(log.span[0] * 1e9), writing.transforms(log.reference))
        for stream, k in _in_order(log):
            writing.reading(stream, k, put)
            progress.advance(stream.name, 1)
    return Written(writing.counts, writing.lost())


def _in_order(log: Log) -> Iterator[tuple[Stream, int]]:
    """Every reading of every stream, earliest first."""
    rows = [[(float(t), i, k) for k, t in enumerate(s.stamps)] for i, s in enumerate(log.streams.values())]
    streams = list(log.streams.values())
    return ((streams[i], k) for _, i, k in heapq.merge(*rows))


class _Writing:
    """Turns readings into messages and counts them."""

    def __init__(self, log: Log, encoding: str) -> None:
        self.log, self.encoding = log, encoding
        self.store = messages.types(encoding)
        self.types = self.store.types
        self.counts = dict.fromkeys(log.streams, 0)
        self.poses: dict[str, Array] = {}
        self.gone: dict[str, dict[str, int]] = {}

    def reading(self, stream: Stream, k: int, put: Put) -> None:
        """One reading as its messages; one that can not be read or has no message is counted."""
        ns = self.log.epoch_ns + round(float(stream.stamps[k]) * 1e9)
        if not 0 <= ns < 2**32 * 10**9:
            raise DataError(
                f"sensor {stream.name}: its stamp {ns / 1e9:.3f} s is none that ROS can write (1970 to 2106); "
                "give it unix time"
            )
        try:
            reading = stream.readings[k]
        except DataError as e:
            self.lose(stream.name, f"unreadable, the first because {e}")
            return
        name, header = f"/{stream.name}", self.header(ns, stream.name)
        if isinstance(reading, Scan):
            put(f"{name}/points", ns, clouds.to_message(reading, header, self.types))
        elif isinstance(reading, Fix):
            self.fix(name, ns, reading, header, put)
        elif isinstance(reading, PoseReading):
            self.pose(stream.name, ns, reading.T_world_sensor, reading.cov, put)
        elif isinstance(reading, MotionReading):
            if not stream.has_scale:
                self.lose(stream.name, "motions without scale, for which ROS has no message")
                return
            if reading.vec is None and k:
                self.lose(stream.name, "steps that failed: the poses of the whole stream hang together without them")
                return
            step = np.eye(4) if reading.vec is None else se3.matrix(reading.vec)
            pose = self.poses[stream.name] = self.poses.get(stream.name, np.eye(4)) @ step
            self.pose(stream.name, ns, pose, None, put)
        elif isinstance(reading, np.ndarray):
            put(f"{name}/image_raw", ns, images.to_message(reading, header, self.types))
            if stream.intrinsics:
                size = (reading.shape[1], reading.shape[0])
                put(f"{name}/camera_info", ns, images.to_info(stream.intrinsics, size, header, self.types))
        else:
            self.lose(stream.name, f"readings of kind {type(reading).__name__}, for which ROS has no message")
            return
        self.counts[stream.name] += 1

    def fix(self, name: str, ns: int, fix: Fix, header: Any, put: Put) -> None:
        """A NavSatFix, and the Imu that holds its attitude if it has one."""
        place, attitude = fix.sigma_position, fix.sigma_rpy
        status = self.types["sensor_msgs/msg/NavSatStatus"](0, 1)
        put(
            f"{name}/fix",
            ns,
            self.types["sensor_msgs/msg/NavSatFix"](
                header,
                status,
                *(float(np.degrees(fix.lat)), float(np.degrees(fix.lon)), float(fix.alt)),
                _diagonal(place),
                0 if place is None else 2,
            ),
        )
        if np.isnan(fix.yaw):
            return
        turn = Rotation.from_euler("ZYX", [fix.yaw, fix.pitch, fix.roll]).as_quat()
        vector, unknown = self.types["geometry_msgs/msg/Vector3"], np.array([-1.0, *np.zeros(8)])
        put(
            f"{name}/imu",
            ns,
            self.types["sensor_msgs/msg/Imu"](
                header,
                self.types["geometry_msgs/msg/Quaternion"](*turn.tolist()),
                _diagonal(attitude),
                *(vector(0.0, 0.0, 0.0), unknown, vector(0.0, 0.0, 0.0), unknown),
            ),
        )

    def pose(self, name: str, ns: int, T: Array, cov: Array | None, put: Put) -> None:
        """An Odometry whose child frame is the sensor."""
        types = self.types
        point, turn = types["geometry_msgs/msg/Point"](*T[:3, 3].tolist()), _quaternion(T, types)
        vector, zero = types["geometry_msgs/msg/Vector3"], np.zeros(36)
        pose = types["geometry_msgs/msg/Pose"](point, turn)
        twist = types["geometry_msgs/msg/Twist"](vector(0.0, 0.0, 0.0), vector(0.0, 0.0, 0.0))
        put(
            f"/{name}/odom",
            ns,
            types["nav_msgs/msg/Odometry"](
                self.header(ns, WORLD),
                name,
                types["geometry_msgs/msg/PoseWithCovariance"](pose, zero if cov is None else np.ravel(cov)),
                types["geometry_msgs/msg/TwistWithCovariance"](twist, zero),
            ),
        )

    def transforms(self, reference: Calibration) -> Any:
        """The reference calibration, from the base to each sensor."""
        stamped = []
        ns = self.log.epoch_ns + round(self.log.span[0] * 1e9)
        for name, T in zip(reference.names, reference.T_base_sensor, strict=True):
            if name != reference.base and np.isfinite(T).all():
                moved = self.types["geometry_msgs/msg/Transform"](
                    self.types["geometry_msgs/msg/Vector3"](*T[:3, 3].tolist()), _quaternion(T, self.types)
                )
                header = self.header(ns, reference.base)
                stamped.append(self.types["geometry_msgs/msg/TransformStamped"](header, name, moved))
        return self.types["tf2_msgs/msg/TFMessage"](stamped)

    def header(self, ns: int, frame: str) -> Any:
        """Of a message; ROS 1 counts them, which nobody reads."""
        stamp = self.types["builtin_interfaces/msg/Time"](ns // 10**9, ns % 10**9)
        count = (0,) if self.encoding == "ros1" else ()
        return self.types["std_msgs/msg/Header"](*count, stamp, frame)

    def lose(self, name: str, why: str) -> None:
        """Count a reading that is not written; of sentences with a first one, only that is kept."""
        reasons = self.gone.setdefault(name, {})
        known = next((w for w in reasons if w.startswith(why.partition(",")[0])), why)
        reasons[known] = reasons.get(known, 0) + 1

    def lost(self) -> tuple[str, ...]:
        """A sentence for everything that was not written."""
        sentences = [f"{n}: {count} {why}" for n, reasons in self.gone.items() for why, count in reasons.items()]
        for s in self.log.streams.values():
            if s.intrinsics is not None and s.intrinsics.mask is not None:
                sentences.append(f"{s.name}: the mask of its images, for which ROS has no message")
            if s.name in self.poses:
                sentences.append(f"{s.name}: the covariances of its motions; their poses were written")
        r = self.log.reference
        if r is not None and (np.any(r.dt_base_sensor) or np.any(r.covariance)):
            sentences.append("the reference's clock offsets and covariance: transforms have no place for them")
        return tuple(sentences)


def _quaternion(T: Array, types: Any) -> Any:
    return types["geometry_msgs/msg/Quaternion"](*Rotation.from_matrix(T[:3, :3]).as_quat().tolist())


def _diagonal(sigma: Array | None) -> Array:
    return np.zeros(9) if sigma is None else np.diag(np.square(np.asarray(sigma, dtype=float))).ravel()
