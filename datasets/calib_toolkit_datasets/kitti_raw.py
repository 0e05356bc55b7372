"""KITTI raw drives, synced and unsynced ("extract"): velodyne, cameras 00 to 03, OXTS.

Geiger et al., "Vision meets robotics", IJRR 2013. A file belongs to the stamp on the line of its number, so
missing files shift nothing. The shipped extrinsics are kept as reference only and need not be there.
"""

from functools import partial
from os.path import isfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calib_toolkit import CameraIntrinsics, Dataset, LazyReadings, Log, ReadContext, Stream, hookimpl, se3, tables
from calib_toolkit.errors import DataError
from calib_toolkit.types import Calibration, Fix
from calib_toolkit_datasets import kitti_files, kitti_writing, stamps

Array = NDArray[np.float64]

CAMERAS = ("cam0", "cam1", "cam2", "cam3")
FOLDERS = {"velo": "velodyne_points", **{name: f"image_{i:02d}" for i, name in enumerate(CAMERAS)}, "ins": "oxts"}
SUFFIXES = {"velo": (".bin", ".txt"), "ins": (".txt",), **dict.fromkeys(CAMERAS, (".png",))}
KINDS = {"velo": "velodyne", "ins": "gps_ins", **dict.fromkeys(CAMERAS, "monocular")}
LONGEST_SWEEP = 1.0  # seconds; start and end stamps further apart do not belong together


@hookimpl
def calib_register_datasets() -> list[Dataset]:
    """The ``kitti-raw`` reader."""
    looks_for = "a drive folder with timestamps.txt in velodyne_points, image_00 to image_03 or oxts"
    return [Dataset("kitti-raw", looks_for, matches, open_log, kitti_writing.write, resumes=True)]


def matches(path: Path) -> bool:
    """Whether a folder holds a sensor of KITTI raw with its stamps, and does not lie as KITTI-360 does."""
    path = path.absolute()
    stamped = any(isfile(path / folder / "timestamps.txt") for folder in FOLDERS.values())
    is_360 = isfile(path / "calibration/perspective.txt") or path.parent.name in ("data_2d_raw", "data_3d_raw")
    return stamped and not is_360


def open_log(path: Path, context: ReadContext) -> Log:
    """Every sensor of a drive that has readings with stamps. Raises DataError if there is none."""
    path = path.absolute()
    present = [name for name, folder in FOLDERS.items() if (path / folder).is_dir()]
    sweeps = {name: _sweeps(path / FOLDERS[name]) for name in present}
    matched = {
        name: stamps.match(
            name, kitti_files.numbered_files(path / FOLDERS[name] / "data", SUFFIXES[name]), sweeps[name][0]
        )
        for name in present
    }
    notes = tuple(_left_out(name, path / FOLDERS[name]) for name in present if not len(matched[name].ns))
    kept = {name: m for name, m in matched.items() if len(m.ns)}
    if not kept:
        raise DataError(f"{path} holds no reading of any sensor: {'; '.join(notes) or 'its folders are missing'}")
    epoch_ns = min(int(m.ns[0]) for m in kept.values())
    streams = {name: _stream(path, name, m, sweeps[name][1], epoch_ns) for name, m in kept.items()}
    return Log(path, streams, epoch_ns, _reference(path, streams), notes)


def load_fix(path: Path, sensor: str) -> Fix:
    """One OXTS packet. Its accuracy field is used for all three axes; zero is taken as not stated.

    Raises DataError, naming file, sensor and frame.
    """
    from pykitti.utils import OxtsPacket  # brings pandas, so not before it is needed

    try:
        packet = OxtsPacket(*(float(x) for x in path.read_text(encoding="ascii").split()))
    except (OSError, ValueError, TypeError) as e:
        raise DataError(
            f"{path}: sensor {sensor}, frame {int(path.stem)}, is not an OXTS packet of 30 numbers; "
            "fetch the file again, or remove it to do without this fix"
        ) from e
    used = np.array([packet.lat, packet.lon, packet.alt, packet.roll, packet.pitch, packet.yaw])
    if not np.all(np.isfinite(used)) or abs(packet.lat) > 90 or abs(packet.lon) > 360:
        raise DataError(
            f"{path}: sensor {sensor}, frame {int(path.stem)}, holds no valid position and attitude "
            f"({', '.join(map(str, used))}); remove the file to do without this fix"
        )
    sigma = np.full(3, packet.pos_accuracy) if 0 < packet.pos_accuracy < np.inf else None
    lat, lon = np.radians(used[:2])
    return Fix(float(lat), float(lon), packet.alt, packet.roll, packet.pitch, packet.yaw, sigma)


def _sweeps(folder: Path) -> tuple[tables.Nanoseconds, Array]:
    """Stamps of every line, and the seconds that its sweep took (nan where not known).

    A scan's stamp is the middle of its sweep. timestamps.txt tells when the laser faces forward, which is
    the same instant, and stands in where start or end are missing.
    """
    files = [folder / f"timestamps{part}.txt" for part in ("", "_start", "_end")]
    columns = [tables.read_stamps(f) if f.is_file() else np.zeros(0, dtype=np.int64) for f in files]
    table = np.full((3, max(map(len, columns))), tables.BLANK)
    for row, column in zip(table, columns, strict=True):
        row[: len(column)] = column
    front, start, end = table
    both = (start != tables.BLANK) & (end != tables.BLANK)
    took = np.where(both, end - np.where(both, start, end), 0)
    both &= (took > 0) & (took < LONGEST_SWEEP * 1e9)
    period = np.where(both, took / 1e9, np.nan)
    if np.any(both):
        period[~both] = np.median(period[both])
    return np.where(both, start + took // 2, front), period


def _left_out(name: str, folder: Path) -> str:
    if not (folder / "timestamps.txt").is_file():
        return f"{name} is left out: {folder / 'timestamps.txt'} is missing"
    return f"{name} is left out: {folder / 'data'} holds no {' or '.join(SUFFIXES[name])} file that has a stamp"


def _stream(path: Path, name: str, matched: stamps.Matched, period: Array, epoch_ns: int) -> Stream:
    keys, notes, intrinsics = matched.files, matched.notes, None
    readings: LazyReadings
    if name == "velo":
        periods = period[matched.numbers]
        if np.all(np.isnan(periods)) and len(periods) > 1:
            periods = np.full(len(periods), np.median(np.diff(matched.ns)) / 1e9)
        scans = [kitti_files.ScanFile(f, float(p)) for f, p in zip(keys, periods, strict=True)]
        readings = LazyReadings(partial(kitti_files.load_scan, sensor=name), scans)
    elif name == "ins":
        readings = LazyReadings(partial(load_fix, sensor=name), keys)
    else:
        try:
            intrinsics = _intrinsics(path, name)
        except DataError as e:
            notes = (*notes, f"{name} has no intrinsics: {e}")
        size = intrinsics.size if intrinsics else None
        readings = LazyReadings(partial(kitti_files.load_image, sensor=name, size=size), keys)
    times = tables.seconds(matched.ns, epoch_ns)
    return Stream(name, KINDS[name], times, readings, intrinsics, has_scale=name not in CAMERAS, notes=notes)


def _intrinsics(path: Path, name: str) -> CameraIntrinsics:
    """Of the rectified image for synced drives, of the camera itself for extract drives."""
    file, i = path.parent / "calib_cam_to_cam.txt", FOLDERS[name][-2:]
    if not file.is_file():
        raise DataError(f"{file} is missing; put the calibration of this date beside the drive")
    calib = kitti_files.read_calib(file)
    if _rectified(path):
        K, part, distortion = kitti_files.entry(calib, file, f"P_rect_{i}", (3, 4))[:, :3], "S_rect", np.zeros(0)
    else:
        K, part = kitti_files.entry(calib, file, f"K_{i}", (3, 3)), "S"
        distortion = kitti_files.entry(calib, file, f"D_{i}", (5,))
    width, height = kitti_files.entry(calib, file, f"{part}_{i}", (2,))
    return CameraIntrinsics(K, distortion, (int(width), int(height)))


def _rectified(path: Path) -> bool:
    if path.name.endswith(("_sync", "_extract")):
        return path.name.endswith("_sync")
    raise DataError(
        f"the name of {path} must end in _sync (rectified images) or _extract (images as taken); rename it"
    )


def _reference(path: Path, streams: dict[str, Stream]) -> Calibration | None:
    """The shipped extrinsics of the sensors there are, base velo, as far as their files are there."""
    T_velo_sensor: dict[str, Array] = {}
    velo_file, imu_file = path.parent / "calib_velo_to_cam.txt", path.parent / "calib_imu_to_velo.txt"
    cameras = [name for name in CAMERAS if name in streams and streams[name].intrinsics]
    if velo_file.is_file() and cameras:
        T_cam0_velo = _rigid(velo_file)
        for name in cameras:
            T_velo_sensor[name] = se3.invert(_from_cam0(path, name) @ T_cam0_velo)
    if imu_file.is_file() and "ins" in streams:
        T_velo_sensor["ins"] = _rigid(imu_file)
    return kitti_files.reference(T_velo_sensor, without_scale=CAMERAS)


def _rigid(file: Path) -> Array:
    calib = kitti_files.read_calib(file)
    return se3.rigid(kitti_files.entry(calib, file, "R", (3, 3)), kitti_files.entry(calib, file, "T", (3,)))


def _from_cam0(path: Path, name: str) -> Array:
    """Unrectified camera 0 to the camera whose images the drive holds, (4, 4)."""
    file, i = path.parent / "calib_cam_to_cam.txt", FOLDERS[name][-2:]
    calib = kitti_files.read_calib(file)
    if _rectified(path):
        P = kitti_files.entry(calib, file, f"P_rect_{i}", (3, 4))
        offset = se3.rigid(np.eye(3), np.linalg.solve(P[:, :3], P[:, 3]))
        return offset @ se3.rigid(kitti_files.entry(calib, file, "R_rect_00", (3, 3)), np.zeros(3))
    return se3.rigid(kitti_files.entry(calib, file, f"R_{i}", (3, 3)), kitti_files.entry(calib, file, f"T_{i}", (3,)))
