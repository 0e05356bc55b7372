"""The KITTI odometry benchmark: one sequence of scans and rectified images, and the poses of camera 0.

Geiger et al., "Are we ready for autonomous driving?", CVPR 2012. All readings of a frame have one stamp, that of its
line in times.txt; a file belongs to the line of its number, so missing files shift nothing.
"""

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from os.path import isdir, isfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calib_toolkit import CameraIntrinsics, Dataset, LazyReadings, Log, ReadContext, Stream, hookimpl, se3, tables
from calib_toolkit.errors import DataError
from calib_toolkit.types import Calibration
from calib_toolkit_datasets import image_files, kitti_files, stamps
from calib_toolkit_datasets.bags.frames import reference
from calib_toolkit_datasets.merging import from_table, merged, refuse_leaving

Array = NDArray[np.float64]

CAMERAS = ("cam0", "cam1", "cam2", "cam3")
FOLDERS = {"velo": "velodyne", **{name: f"image_{i}" for i, name in enumerate(CAMERAS)}}
POSE = "pose"
TRIGGER = "the trigger of the cameras"
STRAIGHTENED = (
    "velo: its scans were corrected for the motion within a sweep before they were published, by the INS; they are "
    "not straightened once more"
)
TRUTH = (
    "pose: no sensor but the ground truth, camera 0 as the INS and KITTI's own calibration tell it; what is found of "
    "it is that calibration"
)


@hookimpl
def calib_register_datasets() -> list[Dataset]:
    """The ``kitti-odometry`` reader."""
    looks_for = "sequences/NN with times.txt beside velodyne or image_0 to image_3"
    return [Dataset("kitti-odometry", looks_for, matches, open_log)]


def matches(path: Path) -> bool:
    """Whether a folder is a sequence, or holds a folder of sequences."""
    if isfile(path / "times.txt"):
        return any(isdir(path / folder) for folder in FOLDERS.values())
    try:
        return any(isfile(p / "times.txt") for p in (path / "sequences").iterdir())
    except OSError:
        return False


def open_log(path: Path, context: ReadContext) -> Log:
    """Every sensor of a sequence that has readings, and ``pose`` where poses/NN.txt is there. Raises DataError."""
    path = _sequence(path.absolute())
    ns = tables.read_stamps(path / "times.txt")
    notes: list[str] = []
    logs: list[Log] = []
    for name, folder in FOLDERS.items():
        if not (path / folder).is_dir():
            continue
        suffix = ".bin" if name == "velo" else ".png"
        matched = stamps.match(name, kitti_files.numbered_files(path / folder, (suffix,)), ns)
        refuse_leaving(path, matched.files)
        if len(matched.ns):
            epoch_ns = int(matched.ns[0])
            logs.append(Log(path, {name: _stream(path, name, matched, epoch_ns)}, epoch_ns))
        else:
            notes.append(f"{name} is left out: {path / folder} holds no {suffix} file that has a stamp")
    try:
        logs += _poses(path, context)
    except DataError as e:
        notes.append(f"{POSE} is left out: {e}")
    if not logs:
        raise DataError(f"{path} holds no reading of any sensor: {'; '.join(notes) or 'its folders are missing'}")
    log, shipped = merged(path, logs), None
    try:
        shipped = _reference(path, log.streams)
    except DataError as e:
        notes.append(f"its calibration is not used as a reference: {e}")
    return replace(log, reference=shipped, notes=(*notes, *log.notes))


def _sequence(path: Path) -> Path:
    if isfile(path / "times.txt"):
        return path
    found = sorted(p for p in (path / "sequences").glob("*") if isfile(p / "times.txt"))
    if len(found) != 1:
        names = ", ".join(p.name for p in found)
        raise DataError(f"{path} holds {len(found)} sequences ({names}); name the folder of one of them")
    return found[0]


def _stream(path: Path, name: str, matched: stamps.Matched, epoch_ns: int) -> Stream:
    times, notes = tables.seconds(matched.ns, epoch_ns), matched.notes
    if name == "velo":
        scans = [kitti_files.ScanFile(f, float("nan")) for f in matched.files]
        load = partial(kitti_files.load_scan, sensor=name)
        return Stream(name, "velodyne", times, LazyReadings(load, scans), notes=(*notes, STRAIGHTENED))
    intrinsics = None
    try:
        size = image_files.size_of(matched.files[0].read_bytes())
        intrinsics = CameraIntrinsics(_projection(path, name)[:, :3], size=size if all(size) else None)
    except (DataError, OSError) as e:
        notes = (*notes, f"{name} has no intrinsics: {e}")
    images = LazyReadings(partial(kitti_files.load_image, sensor=name), matched.files)
    return Stream(name, "monocular", times, images, intrinsics, False, clock=TRIGGER, notes=notes)


def _poses(path: Path, context: ReadContext) -> list[Log]:
    file = path.parent.parent / "poses" / f"{path.name}.txt"
    if not file.is_file():
        return []
    times = str(path / "times.txt")
    log = from_table(context, "odometry", POSE, file.parent, poses=file.name, times=times, format="kitti")
    stream = log.streams[POSE]
    return [replace(log, streams={POSE: replace(stream, notes=(*stream.notes, TRUTH))})]


def _projection(path: Path, name: str) -> Array:
    """(3, 4) of a camera, from points in the axes of camera 0."""
    file = path / "calib.txt"
    if not file.is_file():
        raise DataError(f"{file} is missing; put the calibration of this sequence there")
    P = kitti_files.entry(kitti_files.read_calib(file), file, f"P{name[-1]}", (3, 4))
    if P[0, 0] <= 0 or P[1, 1] <= 0 or P[2, 2] != 1:
        raise DataError(f"{file}: 'P{name[-1]}' is no projection of a camera; fetch the calibration again")
    return P


def _reference(path: Path, streams: Mapping[str, Stream]) -> Calibration | None:
    """The shipped poses, as far as they are there; ``Tr`` is ``T_cam0_velo``, and the poses are those of camera 0."""
    file = path / "calib.txt"
    T_cam0_sensor: dict[str, Array] = {POSE: np.eye(4)}
    for name in (n for n in CAMERAS if n in streams and streams[n].intrinsics):
        P = _projection(path, name)
        T_cam0_sensor[name] = se3.rigid(np.eye(3), -np.linalg.solve(P[:, :3], P[:, 3]))
    calib = kitti_files.read_calib(file) if file.is_file() else {}
    if "Tr" in calib:
        T = np.vstack([kitti_files.entry(calib, file, "Tr", (3, 4)), [0, 0, 0, 1]])
        if np.abs(T[:3, :3] @ T[:3, :3].T - np.eye(3)).max() > 0.02 or np.linalg.det(T[:3, :3]) < 0:
            raise DataError(f"{file}: the matrix in 'Tr' is no rotation; fetch the calibration again")
        T_cam0_sensor["velo"] = T
    edges = {("cam0 there", name): T for name, T in T_cam0_sensor.items() if name in streams}
    return reference(edges, {n: n for n in streams}, {n: s.has_scale for n, s in streams.items()})
