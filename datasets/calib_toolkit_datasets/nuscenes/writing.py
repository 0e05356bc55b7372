"""A log as nuScenes: one scene of all that it holds, keyframes every half second, tokens made of what they stand for.

What nuScenes' tables have no column for stands in columns of its own: ``camera_distortion``, as TIER IV's T4 tables
have it, ``times_filename``, ``fix`` and ``covariance``; a channel of modality ``ego`` has the poses as they were
measured, and every other reading one between those.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib_toolkit import Log, Progress, Scan, Stream, Written, tables
from calib_toolkit.errors import DataError
from calib_toolkit.types import PoseReading
from calib_toolkit_datasets import stamps
from calib_toolkit_datasets.nuscenes import ego
from calib_toolkit_datasets.nuscenes.readings import write_sweep
from calib_toolkit_datasets.nuscenes.tables import NAME, TableWriter

Array = NDArray[np.float64]

VERSION = "v1.0-converted"
SCENE = "scene-0001"
MODALITIES = {"velodyne": "lidar", "monocular": "camera", "ladybug": "camera"}
KEYFRAMES_NS = 500_000_000
MAP = "maps/none.png"
"""nuScenes' own toolkit wants a map of each log; this one is black."""
EMPTY = ("category", "attribute", "visibility", "instance", "sample_annotation")
"""Tables of annotations, which a log has none of."""


def write(log: Log, path: Path, progress: Progress) -> Written:
    """The folder of a recording with its tables. Raises DataError."""
    vehicle = _vehicle(log)
    measured = [s for s in log.streams.values() if s.kind in MODALITIES]
    lost = [
        f"{n}: nuScenes has no {s.kind} beside {vehicle.name}"
        for n, s in log.streams.items()
        if s not in (vehicle, *measured)
    ]
    us = {s.name: _microseconds(log, s, lost) for s in (vehicle, *measured)}
    for stream in (vehicle, *measured):
        progress.begin(stream.name, len(stream))
    read = list(_readings(vehicle, progress, lost))
    if not read:
        raise DataError(f"sensor {vehicle.name}: none of its readings can be read; choose another format")
    poses = ego.poses([reading for _, reading in read])
    counts = dict.fromkeys(log.streams, 0)
    (path / VERSION).mkdir(parents=True)
    with TableWriter(path / VERSION, EMPTY) as put:
        samples = _samples(us, [*measured, vehicle])
        keys = {name: _keys(stamps_us * 1000, samples) for name, stamps_us in us.items()}
        scene = _Scene(log, path, put, vehicle, us, keys, samples)
        made = (
            ({"filename": "", "fileformat": ""}, k, ego.to_row(r, T)) for (k, r), T in zip(read, poses, strict=True)
        )
        counts[vehicle.name] = scene.channel(vehicle, ego.MODALITY, made, lost)
        known = us[vehicle.name][[k for k, _ in read]]
        for stream in measured:
            T = ego.between(known * 1000, poses, us[stream.name] * 1000)
            files = ((scene.files(stream, k, r), k) for k, r in _readings(stream, progress, lost))
            made = ((columns, k, ego.pose_row(T[k])) for columns, k in files)
            counts[stream.name] = scene.channel(stream, MODALITIES[stream.kind], made, lost)
        scene.close()
    if log.reference is not None:
        lost.append("the reference's clock offsets and covariance: nuScenes has no place for them")
    return Written(counts, tuple(dict.fromkeys(lost)))


@dataclass(frozen=True)
class _Scene:
    """The scene that is written. us: microseconds of all readings, by stream. keys: numbers of those that belong to
    keyframes. samples: (n,) nanoseconds of keyframes.
    """

    log: Log
    path: Path
    put: TableWriter
    vehicle: Stream
    us: dict[str, tables.Nanoseconds]
    keys: dict[str, set[int]]
    samples: tables.Nanoseconds

    def channel(
        self,
        stream: Stream,
        modality: str,
        made: Iterable[tuple[dict[str, Any], int, dict[str, Any]]],
        lost: list[str],
    ) -> int:
        """The rows of a sensor and of its readings, each linked to the next; how many readings.

        made: of each what sample_data says of files, its number, and what ego_pose says.
        """
        self._sensor(stream, modality, lost)
        us, written = self.us[stream.name], 0
        sample = _nearest(self.samples, us * 1000)
        before: dict[str, Any] = {}
        for files, k, pose in made:
            own, stamp = _token("sample_data", stream.name, us[k]), int(us[k])
            self.put("ego_pose", {"token": own, "timestamp": stamp, **pose})
            if before:
                self.put("sample_data", {**before, "next": own})
            before = {
                "token": own,
                "sample_token": _token("sample", self.samples[sample[k]]),
                "ego_pose_token": own,
                "calibrated_sensor_token": _token("calibrated_sensor", stream.name),
                "timestamp": stamp,
                "is_key_frame": k in self.keys[stream.name],
                "width": 0,
                "height": 0,
                **files,
                "prev": before.get("token", ""),
                "next": "",
            }
            written += 1
        if before:
            self.put("sample_data", before)
        return written

    def files(self, stream: Stream, k: int, reading: Any) -> dict[str, Any]:
        """A sweep or an image as files; their columns in sample_data."""
        folder = f"{'samples' if k in self.keys[stream.name] else 'sweeps'}/{stream.name}"
        name = f"{folder}/{SCENE}__{stream.name}__{self.us[stream.name][k]}"
        (self.path / folder).mkdir(parents=True, exist_ok=True)
        if isinstance(reading, Scan):
            times = write_sweep(reading, self.path / f"{name}.pcd.bin")
            timed = times.relative_to(self.path).as_posix() if times else ""
            return {"filename": f"{name}.pcd.bin", "fileformat": "pcd", "times_filename": timed}
        import cv2

        file = self.path / f"{name}.png"
        if not isinstance(reading, np.ndarray) or not cv2.imwrite(
            str(file), reading, [cv2.IMWRITE_PNG_COMPRESSION, 1]
        ):
            raise DataError(
                f"sensor {stream.name}, reading {k}: {type(reading).__name__} is nothing that nuScenes can hold"
            )
        return {"filename": f"{name}.png", "fileformat": "png", "height": reading.shape[0], "width": reading.shape[1]}

    def close(self) -> None:
        """The tables of the scene itself, and the map that it has not."""
        tokens = [_token("sample", ns) for ns in self.samples]
        for before, ns, token, after in zip(["", *tokens], self.samples, tokens, [*tokens[1:], ""], strict=False):
            row = {"token": token, "timestamp": int(ns) // 1000, "scene_token": _token("scene")}
            self.put("sample", {**row, "prev": before, "next": after})
        scene = {"token": _token("scene"), "log_token": _token("log"), "name": SCENE, "nbr_samples": len(tokens)}
        ends = {"first_sample_token": tokens[0], "last_sample_token": tokens[-1]}
        self.put("scene", {**scene, **ends, "description": f"converted from {self.log.source.name}"})
        day = str(np.datetime64(int(self.samples[0]), "ns").astype("M8[D]"))
        captured = {"vehicle": self.vehicle.name, "date_captured": day, "location": "unknown"}
        self.put("log", {"token": _token("log"), "logfile": self.log.source.name, **captured})
        drawn = {"token": _token("map"), "log_tokens": [_token("log")], "category": "none", "filename": MAP}
        self.put("map", drawn)
        import cv2

        (self.path / MAP).parent.mkdir()
        cv2.imwrite(str(self.path / MAP), np.zeros((8, 8), dtype=np.uint8))

    def _sensor(self, stream: Stream, modality: str, lost: list[str]) -> None:
        name, lens = stream.name, stream.intrinsics
        self.put("sensor", {"token": _token("sensor", name), "channel": name, "modality": modality})
        row = {"token": _token("calibrated_sensor", name), "sensor_token": _token("sensor", name)}
        distortion = [] if lens is None else np.asarray(lens.distortion, dtype=float).tolist()
        if len(distortion) == 4:
            distortion.append(0.0)  # four would be a fisheye's
        self.put(
            "calibrated_sensor",
            {
                **row,
                **self._pose(name, lost),
                "camera_intrinsic": [] if lens is None else np.asarray(lens.K, dtype=float).tolist(),
                "camera_distortion": distortion,
            },
        )
        if lens is not None and lens.mask is not None:
            lost.append(f"{name}: the mask of its images, for which nuScenes has no place")
        if stream.clock != name:
            lost.append(f"{name}: that it shares the clock of {stream.clock}, for which nuScenes has no place")

    def _pose(self, name: str, lost: list[str]) -> dict[str, Any]:
        """``T_ego_sensor`` of the reference; null where it does not know it."""
        if name == self.vehicle.name:
            return ego.pose_row(np.eye(4))
        known = self.log.reference
        if known is not None and {name, self.vehicle.name} <= set(known.names):
            T_ego_sensor = known.between(self.vehicle.name, name).T_a_b
            if np.isfinite(T_ego_sensor).all():
                return ego.pose_row(T_ego_sensor)
        lost.append(f"{name}: its pose in {self.vehicle.name} is not known; null stands in calibrated_sensor.json")
        return {"translation": None, "rotation": None}


def _vehicle(log: Log) -> Stream:
    """Whose poses are those of the vehicle: the first GPS/INS, or else the first odometry of poses."""
    odd = next((n for n in log.streams if not NAME.fullmatch(n)), None)
    if odd is not None:
        raise DataError(f"sensor {odd!r} can not be a channel; name it by letters, digits, - and _ with --sensors")
    streams = log.streams.values()
    odometries = [s for s in streams if s.kind == "odometry" and len(s) and isinstance(s.readings[0], PoseReading)]
    found = next(iter([*(s for s in streams if s.kind == "gps_ins"), *odometries]), None)
    if found is None:
        raise DataError(
            f"{log.source} has no GPS/INS and no odometry of poses, and nuScenes has a pose of the vehicle for every "
            "reading; choose another format"
        )
    return found


def _microseconds(log: Log, stream: Stream, lost: list[str]) -> tables.Nanoseconds:
    """Stamps (n,) as nuScenes has them. Raises DataError for what it can not tell apart."""
    ns = log.epoch_ns + np.round(stream.stamps * 1e9).astype(np.int64)
    us: tables.Nanoseconds = (ns + 500) // 1000
    if len(us) and us[0] <= 0:
        raise DataError(f"sensor {stream.name}: its stamp {ns[0] / 1e9:.3f} s is not after 1970; give it unix time")
    if np.any(np.diff(us) <= 0):
        raise DataError(
            f"sensor {stream.name}: it has two readings in a microsecond; nuScenes can not tell them apart"
        )
    if np.any(ns % 1000):
        lost.append("what stamps have below a microsecond")
    return us


def _samples(us: dict[str, tables.Nanoseconds], streams: Iterable[Stream]) -> tables.Nanoseconds:
    """Stamps of keyframes: every half second one of the first stream that has readings."""
    ns = next(us[s.name] for s in streams if len(s)) * 1000
    return ns[stamps.spaced(ns, KEYFRAMES_NS)]


def _keys(ns: tables.Nanoseconds, samples: tables.Nanoseconds) -> set[int]:
    """Readings (n,) nearest to a sample (m,), of which its keyframe consists."""
    if not len(ns):
        return set()
    nearest = _nearest(ns, samples)
    return set(nearest[np.abs(ns[nearest] - samples) <= KEYFRAMES_NS // 2].tolist())


def _readings(stream: Stream, progress: Progress, lost: list[str]) -> Iterator[tuple[int, Any]]:
    """The readings that can be read, by their numbers."""
    bad = []
    for k in range(len(stream)):
        try:
            yield k, stream.readings[k]
        except DataError as e:
            bad.append(str(e))
        progress.advance(stream.name, 1)
    if bad:
        lost.append(f"{stream.name}: {len(bad)} unreadable, the first because {bad[0]}")


def _nearest(values: tables.Nanoseconds, wanted: tables.Nanoseconds) -> NDArray[np.int64]:
    """Of values (n,) that increase, the index of the nearest to each wanted one. (m,) -> (m,)."""
    after = np.clip(np.searchsorted(values, wanted), 0, len(values) - 1)
    before = np.maximum(after - 1, 0)
    return np.where(wanted - values[before] <= np.abs(values[after] - wanted), before, after)


def _token(table: str, *key: object) -> str:
    """32 hexadecimal digits, the same for the same thing."""
    return sha256(" ".join(map(str, (table, *key))).encode()).hexdigest()[:32]
