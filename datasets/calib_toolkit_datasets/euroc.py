"""EuRoC's layout (ASL): a folder ``mav0`` with one folder for each sensor, its sensor.yaml and its data.csv.

Burri et al., "The EuRoC micro aerial vehicle datasets", IJRR 2016. ``T_BS`` of a sensor.yaml maps points of the
sensor to the body, and serves as reference. TUM's visual-inertial set lies alike.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from os.path import isfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib_toolkit import CameraIntrinsics, Dataset, LazyReadings, Log, ReadContext, Stream, hookimpl, tables
from calib_toolkit.errors import DataError
from calib_toolkit_datasets import gyro, image_files
from calib_toolkit_datasets.bags.frames import reference
from calib_toolkit_datasets.merging import from_table, merged, refuse_leaving
from calib_toolkit_datasets.yaml_files import read_yaml

Array = NDArray[np.float64]

HOME, TABLE, DESCRIPTION = "mav0", "data.csv", "sensor.yaml"
NAMES = {"state_groundtruth_estimate0": "groundtruth"}
POSITIONS = "its positions tell neither attitude nor turns"
RADTAN = ("radial-tangential", "radtan", "plumb_bob")


@hookimpl
def calib_register_datasets() -> list[Dataset]:
    """The ``euroc`` reader."""
    return [Dataset("euroc", f"{HOME} with folders that hold a {TABLE}", matches, open_log)]


def matches(path: Path) -> bool:
    """Whether a folder is mav0 or holds it, with a sensor that has its table."""
    home = _home(path)
    try:
        return home.name == HOME and any(isfile(p / TABLE) for p in home.iterdir())
    except OSError:
        return False


def open_log(path: Path, context: ReadContext) -> Log:
    """Every camera, gyroscope and source of poses, called as its folder is; the estimated state is ``groundtruth``.

    Raises DataError if there is none; a sensor that can not be read is left out, and a note says why.
    """
    home = _home(path.absolute())
    if not home.is_dir():
        raise DataError(f"{home} is no folder; name {HOME}, or the folder that holds it")
    logs, notes = [], []
    frames: dict[str, Array] = {}
    for folder in sorted(p for p in home.iterdir() if isfile(p / TABLE)):
        name = NAMES.get(folder.name, folder.name)
        try:
            refuse_leaving(home, (folder / TABLE, folder / DESCRIPTION))
            logs.append(_reader(folder)(name, folder, context))
        except DataError as e:
            notes.append(f"{name} is left out: {e}")
            continue
        try:
            frames[name] = _pose(folder)
        except DataError as e:
            notes.append(f"where {name} sits is not known: {e}")
    if not logs:
        raise DataError(f"{home} holds no sensor that could be read: {'; '.join(notes) or f'there is no {TABLE}'}")
    log = _triggered(merged(path, logs))
    edges = {("body", name): T for name, T in frames.items()}
    known = reference(edges, {n: n for n in log.streams}, {n: s.has_scale for n, s in log.streams.items()})
    return replace(log, reference=known, notes=(*notes, *log.notes))


def _home(path: Path) -> Path:
    return path / HOME if (path / HOME).is_dir() else path.absolute()


def _reader(folder: Path) -> Callable[[str, Path, ReadContext], Log]:
    """What reads a sensor, told by its first row: an image's name, six numbers of an Imu, a position or a pose."""
    row = tables.read_rows(folder / TABLE, 2, 64)[0]
    columns = len([w for w in row.words if w])
    if columns == 2:
        return _camera
    if folder.name.startswith("imu") and columns == 7:
        return _gyro
    if columns == 4:
        raise DataError(f"{folder / TABLE}: {POSITIONS}")
    if 8 <= columns <= 17:
        return _poses
    raise DataError(f"{row.place}: {columns} columns are neither images, turn rates nor poses")


def _camera(name: str, folder: Path, context: ReadContext) -> Log:
    ns, files, notes = image_files.listed(name, folder / TABLE, "1e-9", folder / "data", folder.parent)
    intrinsics = None
    try:
        intrinsics = _intrinsics(folder / DESCRIPTION)
    except DataError as e:
        notes = (*notes, f"{name} has no intrinsics: {e}")
    images = LazyReadings(partial(image_files.load, sensor=name), files)
    times = tables.seconds(ns, int(ns[0]))
    return Log(folder, {name: Stream(name, "monocular", times, images, intrinsics, False, notes=notes)}, int(ns[0]))


def _gyro(name: str, folder: Path, context: ReadContext) -> Log:
    rows = tables.read_rows(folder / TABLE, 7, 8)
    ns, numbers = tables.to_nanoseconds(rows, "1e-9"), tables.to_numbers(rows, 7)
    keep, notes = tables.usable_rows(ns, numbers, rows)
    epoch_ns = int(ns[keep[0]])
    stamps = tables.seconds(ns[keep], epoch_ns)
    steps, readings, said = gyro.turns(name, stamps, numbers[keep, 1:4], numbers[keep, 4:7])
    stream = Stream(name, "odometry", stamps[steps], readings, has_scale=False, notes=(*notes, *said))
    return Log(folder, {name: stream}, epoch_ns)


def _poses(name: str, folder: Path, context: ReadContext) -> Log:
    return from_table(context, "odometry", name, folder, poses=TABLE, format="euroc")


def _intrinsics(file: Path) -> CameraIntrinsics:
    """Of a pinhole camera, with OpenCV's radial and tangential distortion. Raises DataError."""
    said = read_yaml(file)
    model, lens = said.get("camera_model", "pinhole"), said.get("distortion_model") or ""
    fx, fy, cx, cy = _numbers(said, "intrinsics", 4, file)
    if model != "pinhole" or min(fx, fy) <= 0:
        raise DataError(f"{file}: a '{model}' camera of focal lengths {fx:g} and {fy:g} is no pinhole; undistort it")
    width, height = (int(x) for x in _numbers(said, "resolution", 2, file))
    K = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    distorted = lens not in ("", "none") or said.get("distortion_coefficients")
    D = _numbers(said, "distortion_coefficients", 4, file) if distorted else np.zeros(0)
    if np.any(D) and lens not in RADTAN:
        raise DataError(f"{file}: its distortion is '{lens}', not radial-tangential; undistort its images")
    return CameraIntrinsics(K, D, (width, height))


def _pose(folder: Path) -> Array:
    """``T_body_sensor`` (4, 4). Raises DataError."""
    file = folder / DESCRIPTION
    T_BS = read_yaml(file).get("T_BS")
    T = _numbers(T_BS if isinstance(T_BS, dict) else {"data": T_BS}, "data", 16, file).reshape(4, 4)
    R = T[:3, :3]
    if np.abs(R @ R.T - np.eye(3)).max() > 0.02 or np.linalg.det(R) < 0 or T[3].tolist() != [0, 0, 0, 1]:
        raise DataError(f"{file}: T_BS is no rotation and translation; mend it")
    return T


def _numbers(said: dict[str, Any], key: str, count: int, file: Path) -> Array:
    try:
        numbers = np.asarray(said.get(key), dtype=float).ravel()
    except (TypeError, ValueError):
        numbers = np.zeros(0)
    if numbers.size != count or not np.all(np.isfinite(numbers)):
        raise DataError(f"{file}: '{key}' must be {count} numbers; mend it")
    return numbers


def _triggered(log: Log) -> Log:
    """Cameras with identical stamps were triggered together, and share the first one's clock."""
    streams: dict[str, Stream] = {}
    for name, s in log.streams.items():
        same = [o for o in streams.values() if o.kind == s.kind == "monocular" and np.array_equal(o.stamps, s.stamps)]
        streams[name] = replace(s, clock=same[0].clock) if same else s
    return replace(log, streams=streams)
