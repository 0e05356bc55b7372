"""From the messages of topics to the readings of sensors."""

from collections.abc import Mapping, MutableMapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from calib_toolkit import CameraIntrinsics, LazyReadings, tables
from calib_toolkit.errors import DataError
from calib_toolkit_datasets import gyro
from calib_toolkit_datasets.bags import clouds, images, messages, poses
from calib_toolkit_datasets.bags.clocks import Usable
from calib_toolkit_datasets.bags.index import Bag, Key

INFO = "sensor_msgs/msg/CameraInfo"
KINDS = {
    clouds.KIND: "velodyne",
    images.RAW: "monocular",
    images.COMPRESSED: "monocular",
    poses.ODOMETRY: "odometry",
    poses.POSE: "odometry",
    poses.POSE_COV: "odometry",
    poses.FIX: "gps_ins",
    poses.IMU: "odometry",
}
"""Sensor that reads each type of message."""
IMU_GAP = 200_000_000
"""Nanoseconds between Imu messages between which no attitude is told."""


@dataclass(frozen=True)
class Made:
    """What becomes a stream. topics: it is made of. frame: of its messages. clock: topic whose stamps it shares."""

    kind: str
    ns: tables.Nanoseconds
    readings: Sequence[Any]
    topics: tuple[str, ...]
    frame: str = ""
    intrinsics: CameraIntrinsics | None = None
    has_scale: bool = True
    notes: tuple[str, ...] = ()
    clock: str = ""


def streams(bag: Bag, usable: Mapping[str, Usable], why: MutableMapping[str, str]) -> dict[str, Made]:
    """Streams by topic: lidars, cameras, then what tells poses. why: is told what keeps the other topics."""
    reader = _Reader(bag, usable, why)
    made: dict[str, Made] = {}
    for topic in reader.of(clouds.KIND):
        reader.attempt(made, topic, reader.lidar)
    for topic in reader.of(images.RAW, images.COMPRESSED):
        raw = topic.removesuffix("/compressed")
        if raw != topic and raw in made:
            why[topic] = f"it is {raw} once more"
        else:
            reader.attempt(made, topic, partial(reader.camera, made))
    for topic in reader.of(poses.FIX):
        reader.attempt(made, topic, reader.gnss)
    taken = {t for m in made.values() for t in m.topics}
    for topic in reader.of(poses.ODOMETRY, poses.POSE, poses.POSE_COV):
        reader.attempt(made, topic, reader.odometry)
    for topic in reader.of(poses.IMU):
        if topic not in taken:
            reader.attempt(made, topic, reader.gyro)
    for topic in reader.of(INFO):
        why[topic] = why[topic] or "no images go with it"
    for topic in reader.of(*messages.FRAMES):
        why[topic] = "it tells where frames sit, and nothing that a sensor read"
    return made


class _Reader:
    """Makes the streams of one bag."""

    def __init__(self, bag: Bag, usable: Mapping[str, Usable], why: MutableMapping[str, str]) -> None:
        self.bag, self.usable, self.why = bag, usable, why

    def of(self, *kinds: str) -> list[str]:
        """Topics of these types, in the order of names."""
        return sorted(t for t, u in self.usable.items() if u.recorded.channel.type in kinds)

    def attempt(self, made: dict[str, Made], topic: str, make: Any) -> None:
        """Make a stream, or say why it could not be made."""
        try:
            found = make(topic)
        except DataError as e:
            self.why[topic] = str(e)
        else:
            made[topic] = found

    def keys(self, topic: str) -> list[Key]:
        """Places of the messages that have a stamp."""
        u = self.usable[topic]
        return [tuple(k) for k in u.recorded.keys[u.rows].tolist()]

    def message(self, topic: str, which: int) -> Any:
        """One message that has a stamp."""
        channel = self.usable[topic].recorded.channel
        return messages.load(self.keys(topic)[which], self.bag.source, topic, channel.type, channel.encoding)

    def lidar(self, topic: str) -> Made:
        u, keys, source = self.usable[topic], self.keys(topic), self.bag.source
        encoding = u.recorded.channel.encoding
        period = float(np.median(np.diff(u.ns))) / 1e9 if len(u.ns) > 1 else np.nan
        frame = self.message(topic, 0).header.frame_id
        timing, note = clouds.told_timing(keys[len(keys) // 2], source, topic, encoding, period)
        load = partial(clouds.load_scan, source=source, topic=topic, encoding=encoding, timing=timing)
        notes = (note,) if note else ()
        return Made("velodyne", u.ns, LazyReadings(load, keys), (topic,), frame, notes=notes)

    def camera(self, made: Mapping[str, Made], topic: str) -> Made:
        u, keys, source = self.usable[topic], self.keys(topic), self.bag.source
        channel, frame = u.recorded.channel, self.message(topic, 0).header.frame_id
        shift = 0
        if channel.type == images.RAW:
            shift = images.told_shift(keys[len(keys) // 2], source, topic, channel.encoding)
        info, intrinsics = self.info(topic, frame), None
        notes: tuple[str, ...] = ()
        if info:
            rectified = "rect" in topic.removesuffix("/compressed").rpartition("/")[2]
            intrinsics, why = images.intrinsics(self.message(info, 0), rectified)
            notes = (f"{topic} has no intrinsics: {info}: {why}",) if why else ()
        else:
            notes = (f"{topic} has no intrinsics: there is no CameraInfo beside it",)
        load = partial(
            images.load_image, source=source, topic=topic, kind=channel.type, encoding=channel.encoding, shift=shift
        )
        same = [t for t, m in made.items() if m.kind == "monocular" and np.array_equal(m.ns, u.ns)]
        clock = (made[same[0]].clock or same[0]) if same else ""
        topics = (topic, info) if info else (topic,)
        return Made("monocular", u.ns, LazyReadings(load, keys), topics, frame, intrinsics, False, notes, clock)

    def info(self, topic: str, frame: str) -> str:
        """The topic of a camera's CameraInfo: beside its images, or else the only one of its frame."""
        raw = topic.removesuffix("/compressed")
        beside = f"{raw.rpartition('/')[0]}/camera_info"
        there = self.of(INFO)
        if beside in there:
            return beside
        same = [t for t in there if frame and self.message(t, 0).header.frame_id == frame]
        return same[0] if len(same) == 1 else ""

    def odometry(self, topic: str) -> Made:
        u, keys = self.usable[topic], self.keys(topic)
        channel, first = u.recorded.channel, self.message(topic, 0)
        stated = channel.type != poses.POSE and poses.covariance_is_usable(first, self.message(topic, -1))
        load = partial(
            poses.load_pose,
            source=self.bag.source,
            topic=topic,
            kind=channel.type,
            encoding=channel.encoding,
            stated=stated,
        )
        frame = first.child_frame_id if channel.type == poses.ODOMETRY else ""
        return Made("odometry", u.ns, LazyReadings(load, keys), (topic,), frame)

    def gnss(self, topic: str) -> Made:
        """A GPS/INS where an Imu of its frame or namespace tells attitude, else positions alone."""
        u, source = self.usable[topic], self.bag.source
        keys, encoding = self.keys(topic), u.recorded.channel.encoding
        read = [messages.load(k, source, topic, poses.FIX, encoding) for k in keys]
        fixed = np.array([m.status.status >= 0 for m in read])
        notes = [f"{topic}: {np.sum(~fixed)} of {len(read)} messages have no fix and are left out"]
        notes = notes if not fixed.all() else []
        if fixed.sum() < 2:
            raise DataError("none of its messages has a fix")
        rows = np.flatnonzero(fixed)
        imu = self.imu(topic, read[0].header.frame_id)
        if imu:
            at, share = poses.between(self.usable[imu].ns, u.ns[rows])
            gap = np.diff(self.usable[imu].ns, append=self.usable[imu].ns[-1])[at]
            there = (at >= 0) & ((share == 0) | (share == 1) | (gap < IMU_GAP))
            imu_keys, encodings = self.keys(imu), (encoding, self.usable[imu].recorded.channel.encoding)
            if not there.all():
                notes.append(f"{topic}: {np.sum(~there)} of {len(read)} messages without an Imu around are left out")
            found = [
                poses.FixKey(keys[r], imu_keys[a], imu_keys[min(a + (s > 0), len(imu_keys) - 1)], float(s))
                for r, a, s in zip(rows[there], at[there], share[there], strict=True)
            ]
            load = partial(poses.load_fix, source=source, topics=(topic, imu), encodings=encodings)
            frame = self.message(imu, 0).header.frame_id
            ns = u.ns[rows[there]]
            if len(ns) > 1:
                return Made("gps_ins", ns, LazyReadings(load, found), (topic, imu), frame, notes=tuple(notes))
        notes.append(
            f"{topic} tells positions alone: they determine neither how its antenna is turned nor how high it is"
        )
        load = partial(poses.load_place, source=source, topic=topic, encoding=encoding)
        readings = LazyReadings(load, [keys[r] for r in rows])
        return Made("gps_ins", u.ns[rows], readings, (topic,), read[0].header.frame_id, notes=tuple(notes))

    def imu(self, topic: str, frame: str) -> str:
        """The Imu that tells a receiver's attitude: in its namespace, else of its frame, else the only one."""
        able = [t for t in self.of(poses.IMU) if poses.has_orientation(self.message(t, 0))]
        near = topic.rpartition("/")[0]
        same = [t for t in able if t.rpartition("/")[0] == near and near]
        same = same or [t for t in able if self.message(t, 0).header.frame_id == frame] or able
        return same[0] if len(same) == 1 else ""

    def gyro(self, topic: str) -> Made:
        u, source = self.usable[topic], self.bag.source
        encoding = u.recorded.channel.encoding
        read = [messages.load(k, source, topic, poses.IMU, encoding) for k in self.keys(topic)]
        if read[0].angular_velocity_covariance[0] == -1:
            raise DataError("it holds no turn rates")
        rates = np.array([[m.angular_velocity.x, m.angular_velocity.y, m.angular_velocity.z] for m in read])
        shakes = np.array([[m.linear_acceleration.x, m.linear_acceleration.y, m.linear_acceleration.z] for m in read])
        rows, readings, notes = gyro.turns(topic, tables.seconds(u.ns, int(u.ns[0])), rates, shakes)
        frame = read[0].header.frame_id
        return Made("odometry", u.ns[rows], readings, (topic,), frame, has_scale=False, notes=notes)
