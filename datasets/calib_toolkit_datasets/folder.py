"""A plain folder: subfolders of clouds and of images, and files of poses or fixes, each called as its sensor is.

Readings are stamped by their names, in seconds or a smaller unit of unix time, or by a times.txt or timestamps.txt
beside them, one stamp a line.
"""

import re
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from os import scandir
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from calib_toolkit import CameraIntrinsics, Dataset, LazyReadings, Log, ReadContext, Scan, Stream, hookimpl, tables
from calib_toolkit.errors import DataError
from calib_toolkit_datasets import cloud_files, image_files, name_stamps, point_fields
from calib_toolkit_datasets.bags.images import intrinsics
from calib_toolkit_datasets.merging import from_table, merged, refuse_leaving
from calib_toolkit_datasets.yaml_files import read_yaml

IMAGES = (".png", ".jpg", ".jpeg")
TABLES = (".csv", ".tum")
"""Texts that are nothing else than tables."""
TEXTS = (".txt", ".csv", ".tum")
INFO = "camera_info.yaml"
HEAD = re.compile(r"(?:head|cam)_?(\d+)")
FIX_TITLES = "stamp,lat_deg,lon_deg"


@hookimpl
def calib_register_datasets() -> list[Dataset]:
    """The ``folder`` reader."""
    looks_for = (
        "subfolders of clouds (.pcd .ply .bin .npy .las .laz) or images, or files of poses (.csv .txt .tum), called "
        "as their sensors"
    )
    return [Dataset("folder", looks_for, matches, open_log, last=True)]


def matches(path: Path) -> bool:
    """Whether a folder holds at least one sensor, told by the names of files and the first line of texts."""
    try:
        return path.is_dir() and any(_kind(p) for p in path.iterdir())
    except (OSError, DataError):
        return False


def open_log(path: Path, context: ReadContext) -> Log:
    """Every sensor that can be read; what can not is left out with a note. Raises DataError if there is none."""
    path = path.absolute()
    if not path.is_dir():
        raise DataError(f"{path} is no folder; name one with a subfolder or a file for each sensor")
    notes: list[str] = []
    logs: list[Log] = []
    for entry in sorted(path.iterdir()):
        try:
            kind = _kind(entry)
            if kind:
                refuse_leaving(path, [entry])
                logs.append(_OPEN[kind](entry, context))
            elif entry.suffix.lower() in TABLES and entry.is_file():
                refuse_leaving(path, [entry])
                raise DataError(f"its first line, '{_first_line(entry)[:80]}', is none of poses or fixes; mend it")
        except DataError as e:
            notes.append(f"{entry.stem if entry.is_file() else entry.name} is left out: {e}")
    if not logs:
        raise DataError(f"{path} holds no sensor that could be read: {'; '.join(notes) or 'it is empty'}")
    log = merged(path, logs)
    return replace(log, notes=(*notes, *log.notes))


def load_scan(key: tuple[Path, int], sensor: str, timing: point_fields.Timing | None) -> Scan:
    """One cloud of a file, stamped in nanoseconds. Raises DataError, naming file and sensor."""
    file, ns = key
    return point_fields.to_scan(cloud_files.read_columns(file, sensor), timing, ns, f"{file}: sensor {sensor}: it")


def _kind(entry: Path) -> str:
    """Of a folder ``velodyne``, ``monocular`` or ``ladybug``, of a file ``gps_ins`` or ``odometry``; "" for none."""
    if entry.name.startswith("."):
        return ""
    if entry.is_dir():
        if len(_heads(entry)) > 1:
            return "ladybug"
        suffixes = [f.suffix.lower() for f in _files(entry, (*cloud_files.SUFFIXES, *IMAGES))]
        clouds = sum(s in cloud_files.SUFFIXES for s in suffixes)
        if len(suffixes) < 2:
            return ""
        return "velodyne" if clouds > len(suffixes) / 2 else "monocular"
    if entry.suffix.lower() not in TEXTS:
        return ""
    line = _first_line(entry)
    if line.replace(" ", "").lower().startswith(FIX_TITLES):
        return "gps_ins"
    return "odometry" if re.search(r"\bq_?(?:\w+_)?w\b", line.lower()) or _is_tum(line) else ""


def _files(folder: Path, suffixes: Sequence[str]) -> list[Path]:
    """Readings in a folder or in its subfolder ``data``, by the numbers in their names."""
    for home in (folder, folder / "data"):
        with scandir(home) as entries:
            found = [Path(e.path) for e in entries if Path(e.name).suffix.lower() in suffixes and e.name[0] != "."]
        if found or not (folder / "data").is_dir():
            break
    return sorted(found, key=name_stamps.natural)


def _heads(folder: Path) -> list[Path]:
    """Subfolders of images of a panoramic camera, in the order of their numbers."""
    found = [(int(m[1]), p) for p in folder.iterdir() if p.is_dir() and (m := HEAD.fullmatch(p.name))]
    return [p for _, p in sorted(found) if len(_files(p, IMAGES)) > 1]


def _first_line(file: Path) -> str:
    """The first that says anything: titles, behind a # or not, or numbers."""
    with file.open(encoding="utf-8", errors="replace") as lines:
        text = next((line.strip() for line in lines if line.strip(" #\n\r\ufeff")), "")
        more = next((line.strip() for line in lines if line.strip() and line.strip()[0] != "#"), "")
    titles = text.lstrip("# ")
    return titles if text[0:1] != "#" or re.search(r"\bq", titles) or not more else more


def _is_tum(line: str) -> bool:
    try:
        return len([float(w) for w in line.split()]) == 8
    except ValueError:
        return False


def _lidar(folder: Path, context: ReadContext) -> Log:
    name = folder.name
    ns, files, notes = name_stamps.stamped(name, _files(folder, cloud_files.SUFFIXES), folder)
    refuse_leaving(folder.parent, files)
    period = float(np.median(np.diff(ns))) / 1e9
    timing, odd = None, ""
    middle = len(files) // 2
    try:
        columns = cloud_files.read_columns(files[middle], name)
        timing, odd = point_fields.told_timing(columns, int(ns[middle]), period, name)
    except DataError as e:
        odd = f"{name}: whether its points have times is not known, so scans are not straightened: {e}"
    load = partial(load_scan, sensor=name, timing=timing)
    readings = LazyReadings(load, list(zip(files, ns.tolist(), strict=True)))
    times = tables.seconds(ns, int(ns[0]))
    stream = Stream(name, "velodyne", times, readings, notes=(*notes, *([odd] if odd else [])))
    return Log(folder, {name: stream}, int(ns[0]))


def _camera(folder: Path, context: ReadContext) -> Log:
    return _images(folder, folder.name, folder, "monocular", "")


def _ladybug(folder: Path, context: ReadContext) -> Log:
    """One stream a head, called as the folder with the head's number; they share one clock."""
    heads = {f"{folder.name}{re.sub('[^0-9]', '', head.name)}": head for head in _heads(folder)}
    return merged(folder, [_images(h, name, folder, "ladybug", folder.name) for name, h in heads.items()])


def _images(folder: Path, name: str, home: Path, kind: str, clock: str) -> Log:
    ns, files, notes = name_stamps.stamped(name, _files(folder, IMAGES), folder, home)
    refuse_leaving(home.parent, files)
    camera = None
    try:
        camera = _intrinsics(folder / INFO)
    except DataError as e:
        notes = (*notes, f"{name} has no intrinsics: {e}")
    readings = LazyReadings(partial(image_files.load, sensor=name), files)
    times = tables.seconds(ns, int(ns[0]))
    return Log(folder, {name: Stream(name, kind, times, readings, camera, False, clock, notes=notes)}, int(ns[0]))


def _intrinsics(file: Path) -> CameraIntrinsics:
    """Of a file as ROS' camera_calibration writes it. Raises DataError."""
    if not file.is_file():
        raise DataError(
            f"{file} is missing; write one as ROS' camera_calibration does, with image_width, image_height, "
            "camera_matrix, distortion_model and distortion_coefficients"
        )
    said = read_yaml(file)
    try:
        info = SimpleNamespace(
            width=int(said.get("image_width") or 0),
            height=int(said.get("image_height") or 0),
            distortion_model=str(said.get("distortion_model") or ""),
            binning_x=0,
            binning_y=0,
            roi=SimpleNamespace(x_offset=0, y_offset=0),
            k=_numbers(said.get("camera_matrix"), 9),
            d=_numbers(said.get("distortion_coefficients") or []),
            p=np.zeros(12),
        )
    except (TypeError, ValueError, OverflowError) as e:
        raise DataError(f"{file}: its camera_matrix, distortion or size are not numbers ({e}); mend it") from e
    camera, why = intrinsics(info, rectified=False)
    if camera is None:
        raise DataError(f"{file}: {why}")
    return camera


def _numbers(said: Any, count: int | None = None) -> np.ndarray[Any, np.dtype[np.float64]]:
    numbers = np.asarray(said.get("data") if isinstance(said, dict) else said, dtype=float).ravel()
    if count is not None and numbers.size != count:
        raise ValueError(f"{numbers.size} numbers where {count} belong")
    return numbers


def _poses(file: Path, context: ReadContext) -> Log:
    style = "tum" if _is_tum(_first_line(file)) else "csv"
    return from_table(context, "odometry", file.stem, file.parent, poses=file.name, format=style)


def _fixes(file: Path, context: ReadContext) -> Log:
    return from_table(context, "gps_ins", file.stem, file.parent, fixes=file.name)


_OPEN = {"velodyne": _lidar, "monocular": _camera, "ladybug": _ladybug, "odometry": _poses, "gps_ins": _fixes}
