"""KITTI-360: raw velodyne scans and the rectified images of the perspective cameras 00 and 01.

Liao et al., "KITTI-360", PAMI 2022. Read from the published tree (its root with one sequence, or a sequence
in data_3d_raw or data_2d_raw) or from one flat folder of image_00/data, velodyne_points/data and calibration.
"""

from dataclasses import dataclass
from functools import partial
from os.path import isdir, isfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calib_toolkit import CameraIntrinsics, Dataset, LazyReadings, Log, ReadContext, Stream, hookimpl, se3, tables
from calib_toolkit.errors import DataError
from calib_toolkit.types import Calibration
from calib_toolkit_datasets import kitti_files, stamps

Array = NDArray[np.float64]

PERIOD_NS = 104_600_000  # between frames, where there are no stamps
CAMERAS = ("cam0", "cam1")
FOLDERS = {"velo": "velodyne_points", "cam0": "image_00", "cam1": "image_01"}
SCANS, IMAGES = "data_3d_raw", "data_2d_raw"


@dataclass(frozen=True)
class _Layout:
    """Where things lie. homes: folder of each sensor that is there. data: where its readings are."""

    calibration: Path
    homes: dict[str, Path]
    data: dict[str, Path]


@hookimpl
def calib_register_datasets() -> list[Dataset]:
    """The ``kitti-360`` reader."""
    looks_for = "calibration/perspective.txt beside velodyne_points, image_00, data_3d_raw or data_2d_raw"
    return [Dataset("kitti-360", looks_for, matches, open_log)]


def matches(path: Path) -> bool:
    """Whether a folder is KITTI-360's root, one of its sequences, or one flat folder of its files."""
    path = path.absolute()
    if path.parent.name in (SCANS, IMAGES):
        return isfile(path.parent.parent / "calibration/perspective.txt")
    inside = any(isdir(path / name) for name in (*FOLDERS.values(), SCANS, IMAGES))
    return inside and isfile(path / "calibration/perspective.txt")


def open_log(path: Path, context: ReadContext) -> Log:
    """Every sensor that has readings. Raises DataError if there is none.

    Frames whose sensors do not all have stamps get made-up ones, which a note says of each of them.
    """
    path = path.absolute()
    layout = _layout(path)
    files = {
        n: kitti_files.numbered_files(d, (".bin",) if n == "velo" else (".png",)) for n, d in layout.data.items()
    }
    notes = tuple(f"{n} is left out: {layout.data[n]} holds no readings" for n in files if not files[n])
    files = {n: f for n, f in files.items() if f}
    if not files:
        raise DataError(f"{path} holds no scans and no images: {'; '.join(notes) or 'its folders are missing'}")
    stamp_files = {n: layout.homes[n] / "timestamps.txt" for n in files}
    if all(f.is_file() for f in stamp_files.values()):
        matched = {n: stamps.match(n, f, tables.read_stamps(stamp_files[n])) for n, f in files.items()}
    else:
        matched = {n: stamps.made_up(n, f, PERIOD_NS) for n, f in files.items()}
    notes += tuple(
        f"{n} is left out: {stamp_files[n]} stamps none of its files" for n in files if not len(matched[n].ns)
    )
    matched = {n: m for n, m in matched.items() if len(m.ns)}
    if not matched:
        raise DataError(f"{path} holds no reading with a stamp: {'; '.join(notes)}")
    epoch_ns = min(int(m.ns[0]) for m in matched.values())
    streams = {n: _stream(layout, n, m, epoch_ns) for n, m in matched.items()}
    return Log(path, streams, epoch_ns, _reference(layout.calibration, streams), notes)


def _layout(path: Path) -> _Layout:
    if path.parent.name in (SCANS, IMAGES):
        root, sequence = path.parent.parent, path.name
    elif (path / SCANS).is_dir() or (path / IMAGES).is_dir():
        root = path
        sequences = sorted({p.name for part in (SCANS, IMAGES) for p in (root / part).glob("*_sync") if p.is_dir()})
        if len(sequences) != 1:
            raise DataError(
                f"{path} holds {len(sequences)} sequences; name the folder of one of them in {SCANS} or {IMAGES}"
                f" ({', '.join(sequences) or 'there is none'})"
            )
        sequence = sequences[0]
    else:
        homes = {n: path / f for n, f in FOLDERS.items() if (path / f).is_dir()}
        return _Layout(path / "calibration", homes, {n: h / "data" for n, h in homes.items()})
    parts = {n: root / (SCANS if n == "velo" else IMAGES) / sequence / f for n, f in FOLDERS.items()}
    homes = {n: h for n, h in parts.items() if h.is_dir()}
    data = {n: h / ("data" if n == "velo" else "data_rect") for n, h in homes.items()}
    return _Layout(root / "calibration", homes, data)


def _stream(layout: _Layout, name: str, matched: stamps.Matched, epoch_ns: int) -> Stream:
    times = tables.seconds(matched.ns, epoch_ns)
    if name == "velo":
        # the stamp is when the laser faces forward, which is mid-sweep
        period = float(np.median(np.diff(times))) if len(times) > 1 else float("nan")
        scans = [kitti_files.ScanFile(f, period) for f in matched.files]
        load = partial(kitti_files.load_scan, sensor=name)
        return Stream(name, "velodyne", times, LazyReadings(load, scans), notes=matched.notes)
    intrinsics = _intrinsics(layout.calibration / "perspective.txt", name)
    images = LazyReadings(partial(kitti_files.load_image, sensor=name, size=intrinsics.size), matched.files)
    return Stream(name, "monocular", times, images, intrinsics, has_scale=False, notes=matched.notes)


def _intrinsics(file: Path, name: str) -> CameraIntrinsics:
    calib, i = kitti_files.read_calib(file), FOLDERS[name][-2:]
    K = kitti_files.entry(calib, file, f"P_rect_{i}", (3, 4))[:, :3]
    width, height = kitti_files.entry(calib, file, f"S_rect_{i}", (2,))
    return CameraIntrinsics(K, size=(int(width), int(height)))


def _reference(folder: Path, streams: dict[str, Stream]) -> Calibration | None:
    """The published poses of the rectified cameras, base velo; None without calib_cam_to_velo.txt.

    The file holds ``T_velo_cam`` of camera 00 before rectification: ``T_rect_velo = R_rect_00 inv(T_velo_cam)``.
    """
    file, rectification = folder / "calib_cam_to_velo.txt", folder / "perspective.txt"
    cameras = [name for name in CAMERAS if name in streams]
    if not file.is_file() or not cameras:
        return None
    try:
        T_velo_cam = np.eye(4)
        T_velo_cam[:3] = np.array(file.read_text().split(), dtype=np.float64).reshape(3, 4)
        if not np.all(np.abs(T_velo_cam) < kitti_files.FARTHEST):
            raise ValueError("some are not metres")
    except (OSError, ValueError) as e:
        raise DataError(f"{file} must hold 12 numbers ({e}); fetch the calibration again") from e
    calib = kitti_files.read_calib(rectification)
    R_rect_00 = kitti_files.entry(calib, rectification, "R_rect_00", (3, 3))
    T_rect_velo = se3.rigid(R_rect_00, np.zeros(3)) @ se3.invert(T_velo_cam)
    T_velo_sensor = {}
    for name in cameras:
        P = kitti_files.entry(calib, rectification, f"P_rect_{FOLDERS[name][-2:]}", (3, 4))
        offset = se3.rigid(np.eye(3), np.linalg.solve(P[:, :3], P[:, 3]))
        T_velo_sensor[name] = se3.invert(offset @ T_rect_velo)
    return kitti_files.reference(T_velo_sensor, without_scale=CAMERAS)
