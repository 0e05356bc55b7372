"""nuScenes: a scene as a recording. Lidars, cameras and the vehicle's own poses; radars are listed and not read.

Caesar et al., "nuScenes: a multimodal dataset for autonomous driving", CVPR 2020. Sensors are called as their
channels are, and the vehicle's poses ``ego``.
"""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from os.path import isfile
from pathlib import Path
from typing import TypeVar

import numpy as np

from calib_toolkit import CameraIntrinsics, Dataset, LazyReadings, Log, ReadContext, Stream, hookimpl, tables
from calib_toolkit.errors import DataError
from calib_toolkit.types import Calibration, Topic
from calib_toolkit_datasets import image_files
from calib_toolkit_datasets.nuscenes import ego, writing
from calib_toolkit_datasets.nuscenes.readings import SweepFile, load_sweep
from calib_toolkit_datasets.nuscenes.tables import NAME, Found, Place, Row, locate, matches

KINDS = {"lidar": "velodyne", "camera": "monocular"}
KEYS = ("timestamp", "filename", "ego_pose_token", "width", "height", "times_filename")
"""Of sample_data, what a reading needs."""
LENS = (0, 5, 8, 12, 14)
"""Numbers of coefficients of OpenCV's pinhole camera; with 4, tables that have them mean a fisheye."""
LISTED = 20
"""Scenes that a sentence names."""
T = TypeVar("T")


@hookimpl
def calib_register_datasets() -> list[Dataset]:
    """The ``nuscenes`` reader."""
    looks_for = "a folder with v1.0-*/scene.json and the other tables, or a scene in it"
    return [Dataset("nuscenes", looks_for, matches, open_log, writing.write)]


@dataclass(frozen=True)
class _Channel:
    """One sensor of the scene: its calibrated_sensor, and its readings by their rows in sample_data."""

    name: str
    modality: str
    calibrated: Row
    rows: list[Row]


def open_log(path: Path, context: ReadContext) -> Log:
    """The lidars, cameras and poses of a scene. Raises DataError; the table and the row are named."""
    place = locate(path)
    channels = _channels(place, _samples(place))
    found = {n: _found(place, c) for n, c in channels.items() if c.modality in KINDS}
    unused = {n: f"no sensor reads a {c.modality}" for n, c in channels.items() if c.modality not in KINDS}
    unused |= {n: "none of its files is there" for n, f in found.items() if not len(f.ns)}
    found = {n: f for n, f in found.items() if len(f.ns)}
    own = next((n for n, c in channels.items() if c.modality == ego.MODALITY), "")
    rows = channels[own].rows if own else [r for c in channels.values() for r in c.rows]
    poses, why = ego.read(place, rows, own)
    name = own or ("ego_pose" if ego.NAME in channels else ego.NAME)
    notes = () if poses else (f"{name} is left out: {why}",)
    if poses:
        found[name] = poses
        unused.pop(own, None)
    if not found:
        raise DataError(f"{path} holds no reading: {'; '.join([*notes, *(f'{n}: {w}' for n, w in unused.items())])}")
    epoch_ns = min(int(f.ns[0]) for f in found.values())
    streams = {n: _stream(n, f, epoch_ns) for n, f in found.items()}
    listed = [
        Topic(n, c.modality, len(c.rows), _rate(found.get(n)), n if n in found else "", unused.get(n, ""))
        for n, c in channels.items()
    ]
    if poses and not own:
        listed.append(Topic(ego.TABLE, "poses", len(poses.ns), _rate(poses), name))
    return Log(path, streams, epoch_ns, _reference(name, channels, streams), notes, tuple(listed))


def _samples(place: Place) -> dict[str, bool]:
    """Every sample's token, and whether it belongs to the scene."""
    scenes = list(place.rows("scene"))
    names = [s.text("name") for s in scenes]
    chosen = [s for s, name in zip(scenes, names, strict=True) if name == place.scene or not place.scene]
    if len(chosen) != 1:
        more = f" and {len(names) - LISTED} more" if len(names) > LISTED else ""
        there = f"{', '.join(names[:LISTED]) or 'none'}{more}"
        if place.scene:
            raise DataError(f"{place.tables} has {len(chosen)} scenes called '{place.scene}'; there are: {there}")
        example = f"{place.tables / names[0]}" if names else "a folder that holds one"
        raise DataError(f"{place.tables} has {len(names)} scenes; name one of them, as {example}: {there}")
    token = chosen[0].text("token")
    return {row.text("token"): row.text("scene_token") == token for row in place.rows("sample")}


def _channels(place: Place, samples: dict[str, bool]) -> dict[str, _Channel]:
    """What was recorded in the scene, by channel."""
    sensors = {row.text("token"): row for row in place.rows("sensor")}
    calibrated = {row.text("token"): row for row in place.rows("calibrated_sensor")}
    rows: dict[str, list[Row]] = {}
    for row in place.rows("sample_data"):
        if _known(row, "sample_token", samples, "sample.json"):
            token = row.text("calibrated_sensor_token")
            kept = {key: row.values[key] for key in KEYS if key in row.values}
            rows.setdefault(token, []).append(Row(row.file, row.number, kept))
            if len(rows[token]) == 1:
                _known(row, "calibrated_sensor_token", calibrated, "calibrated_sensor.json")
    channels: dict[str, _Channel] = {}
    for token, readings in rows.items():
        sensor = _known(calibrated[token], "sensor_token", sensors, "sensor.json")
        name = sensor.text("channel")
        if not NAME.fullmatch(name):
            raise DataError(
                f"{sensor.place}: the channel {name[:60]!r} is none of letters, digits, - and _; rename it"
            )
        if name in channels:
            raise DataError(
                f"{calibrated[token].place}: {name} has a second pose in one scene; keep the rows of one of them"
            )
        channels[name] = _Channel(name, sensor.text("modality"), calibrated[token], readings)
    ranks = {modality: rank for rank, modality in enumerate((*KINDS, ego.MODALITY))}
    return dict(sorted(channels.items(), key=lambda item: (ranks.get(item[1].modality, len(ranks)), item[0])))


def _known(row: Row, key: str, table: Mapping[str, T], file: str) -> T:
    """What a token stands for."""
    token = row.text(key)
    if token not in table:
        raise DataError(f"{row.place}: '{key}' is {token[:60]!r}, which {file} does not have; fetch the tables again")
    return table[token]


def _found(place: Place, channel: _Channel) -> Found:
    """The readings of a lidar or a camera whose files are there, by their stamps."""
    named = [(row.stamp(), row, place.file(row, "filename")) for row in channel.rows]
    rows = sorted((r for r in named if isfile(r[2])), key=lambda r: r[0])
    gone = [file for _, _, file in named if not isfile(file)]
    ns = np.array([t for t, _, _ in rows], dtype=np.int64)
    keep = (ns != tables.BLANK) & tables.increasing(ns)
    kept = [rows[k] for k in np.flatnonzero(keep)]
    notes = _note(channel.name, len(gone), len(named), "files are missing", gone)
    notes += _note(channel.name, int(np.sum(~keep)), len(rows), "readings without a stamp of their own are left out")
    if channel.modality == "camera":
        return _camera(channel, ns[keep], [r[1:] for r in kept], notes)
    period = float(np.median(np.diff(ns[keep]))) / 1e9 if len(kept) > 1 else float("nan")
    files = [SweepFile(file, period, _times(place, row)) for _, row, file in kept]
    load = partial(load_sweep, sensor=channel.name)
    return Found("velodyne", ns[keep], LazyReadings(load, files), None, notes, channel.name)


def _times(place: Place, row: Row) -> Path | str | None:
    """File of the time of each point, which is none of nuScenes' own: "" where they are not known."""
    if "times_filename" not in row.values:
        return None
    return place.file(row, "times_filename") if row.values["times_filename"] else ""


def _camera(channel: _Channel, ns: tables.Nanoseconds, rows: list[tuple[Row, Path]], notes: tuple[str, ...]) -> Found:
    """Its images and what is known of its lens; nuScenes' own images are undistorted."""
    intrinsics, calibrated = None, channel.calibrated
    sizes = Counter((row.values["width"], row.values["height"]) for row, _ in rows if _has_size(row))
    size = sizes.most_common(1)[0][0] if sizes else None
    distortion = np.zeros(0)
    if calibrated.values.get("camera_distortion"):
        distortion = calibrated.numbers("camera_distortion", -1)
    if not calibrated.values.get("camera_intrinsic"):
        notes += (f"{channel.name} has no intrinsics: its camera_intrinsic is empty",)
    elif len(distortion) not in LENS:
        notes += (
            f"{channel.name} has no intrinsics: a distortion of {len(distortion)} numbers is no pinhole camera's",
        )
    else:
        K = calibrated.numbers("camera_intrinsic", 3, 3)
        if K[0, 0] <= 0 or K[1, 1] <= 0 or not np.array_equal(K[2], [0, 0, 1]):
            raise DataError(f"{calibrated.place}: 'camera_intrinsic' is no camera matrix; fetch the table again")
        intrinsics = CameraIntrinsics(K, distortion, size)
    load = partial(image_files.load, sensor=channel.name, size=size)
    return Found("monocular", ns, LazyReadings(load, [file for _, file in rows]), intrinsics, notes, channel.name)


def _has_size(row: Row) -> bool:
    return all(isinstance(n := row.values.get(key), int) and n > 0 for key in ("width", "height"))


def _stream(name: str, found: Found, epoch_ns: int) -> Stream:
    scaled = found.kind != "monocular"
    times, notes = tables.seconds(found.ns, epoch_ns), found.notes
    return Stream(name, found.kind, times, found.readings, found.intrinsics, scaled, notes=notes, topic=found.topic)


def _rate(found: Found | None) -> float:
    return 1e9 / float(np.median(np.diff(found.ns))) if found and len(found.ns) > 1 else float("nan")


def _note(name: str, count: int, of: int, what: str, files: list[Path] | None = None) -> tuple[str, ...]:
    first = f", the first is {files[0]}" if files else ""
    return (f"{name}: {count} of {of} {what}{first}",) if count else ()


def _reference(name: str, channels: dict[str, _Channel], streams: dict[str, Stream]) -> Calibration | None:
    """The poses of calibrated_sensor in the frame of the vehicle, which is called as its poses are.

    A row of which ``rotation`` is null knows none; nuScenes has no such rows.
    """
    T_ego_sensor = {
        n: c.calibrated.pose()
        for n, c in channels.items()
        if n in streams and n != name and c.calibrated.values.get("rotation", ()) is not None
    }
    if not T_ego_sensor:
        return None
    names = (name, *T_ego_sensor)
    determined = np.ones((len(names), 7), dtype=bool)
    determined[1:, 6] = False
    return Calibration(
        base=name,
        names=names,
        T_base_sensor=np.stack([np.eye(4), *T_ego_sensor.values()]),
        dt_base_sensor=np.zeros(len(names)),
        covariance=np.zeros((7 * len(names), 7 * len(names))),
        has_scale=np.array([n == name or streams[n].has_scale for n in names]),
        determined=determined,
    )
