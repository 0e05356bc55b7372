"""KITTI raw: a folder of ``calib_velo_to_cam.txt``, ``calib_imu_to_velo.txt`` and ``calib_cam_to_cam.txt``."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from calib_toolkit import Calibration, CameraIntrinsics, Exporter, hookimpl, se3
from calib_toolkit.errors import DataError
from calib_toolkit_plugins.exporters import clocks, files, poses

VELO, INS, CAMERAS = "velo", "ins", ("cam0", "cam1", "cam2", "cam3")
VELO_FILE, IMU_FILE, CAMERAS_FILE = "calib_velo_to_cam.txt", "calib_imu_to_velo.txt", "calib_cam_to_cam.txt"
LARGEST_D = 5


@hookimpl
def calib_register_exporters() -> list[Exporter]:
    """The ``kitti`` exporter."""
    loses = "sigmas, other sensors than velo, ins and cam0 to cam3; R_rect and P_rect are not read back"
    looks_for = f"a folder with {VELO_FILE}, {IMU_FILE} or {CAMERAS_FILE}"
    return [Exporter("kitti", write, read, looks_for, matches, loses)]


def matches(path: Path) -> bool:
    """Whether a folder holds a calibration file of KITTI raw."""
    return any((path / name).is_file() for name in (VELO_FILE, IMU_FILE, CAMERAS_FILE))


def write(c: Calibration, path: Path, intrinsics: Mapping[str, CameraIntrinsics]) -> None:
    """As many of the three files as there are sensors for, and the clock offsets. Raises DataError."""
    cameras = [n for n in CAMERAS if n in c.names]
    if others := [n for n in c.names if n not in (VELO, INS, *CAMERAS)]:
        raise DataError(
            f"KITTI has sensors called {VELO}, {INS} and {CAMERAS[0]} to {CAMERAS[-1]}, and none called "
            f"{', '.join(others)}; rename it, or leave it out with --sensors"
        )
    if cameras and cameras[0] != CAMERAS[0]:
        raise DataError(f"KITTI ties everything to {CAMERAS[0]}, which is missing; add it or leave the cameras out")
    if INS in c.names and VELO not in c.names:
        raise DataError(f"KITTI ties {INS} to {VELO}, which is missing; add it, or leave {INS} out with --sensors")
    path.mkdir()
    if VELO in c.names and cameras:
        _write(path / VELO_FILE, *_rigid(c, CAMERAS[0], VELO))
    if INS in c.names:
        _write(path / IMU_FILE, *_rigid(c, VELO, INS))
    if cameras:
        said = (
            f"R_0i, T_0i: {poses.direction(c, 'cami', CAMERAS[0])}, metres; the cameras are as calibrated, "
            "so that R_rect_00 is identity and the other R_rect turn a camera's axes into those of cam0"
        )
        rows = [row for n in cameras for row in _camera_rows(c, n, intrinsics.get(n))]
        _write(path / CAMERAS_FILE, rows, said)
    clocks.write(c, path)


def read(path: Path) -> Calibration:
    """All sensors that the files of a folder tell, in velo or else in cam0: cameras before rectification."""
    cameras = _read(path / CAMERAS_FILE) if (path / CAMERAS_FILE).is_file() else {}
    T_cam0: dict[str, poses.Array] = {CAMERAS[0]: np.eye(4)} if cameras else {}
    for k, name in enumerate(CAMERAS):
        if f"R_{k:02d}" in cameras:
            T_cam0[name] = se3.invert(_pose(path / CAMERAS_FILE, cameras, f"_{k:02d}"))
    if cameras and not np.allclose(T_cam0[CAMERAS[0]], np.eye(4), atol=1e-6):
        raise DataError(f"{path / CAMERAS_FILE}: R_00 and T_00 are not identity, though all are seen from cam0")
    T_velo: dict[str, poses.Array] = {}
    if (path / IMU_FILE).is_file():
        T_velo[INS] = _pose(path / IMU_FILE, _read(path / IMU_FILE))
    if (path / VELO_FILE).is_file():
        T_velo_cam0 = se3.invert(_pose(path / VELO_FILE, _read(path / VELO_FILE)))
        T_velo |= {n: T_velo_cam0 @ T for n, T in (T_cam0 or {CAMERAS[0]: np.eye(4)}).items()}
    elif T_velo and T_cam0:
        raise DataError(f"{path / VELO_FILE} is missing, so nothing ties the cameras to {VELO}; put it there")
    if T_velo:
        return clocks.read(poses.calibration(path, VELO, T_velo, CAMERAS), path)
    others = {n: T for n, T in T_cam0.items() if n != CAMERAS[0]}
    return clocks.read(poses.calibration(path, CAMERAS[0], others, CAMERAS), path)


def _rigid(c: Calibration, a: str, b: str) -> tuple[list[tuple[str, Any]], str]:
    T = c.between(a, b).T_a_b
    return [("R", T[:3, :3]), ("T", T[:3, 3])], f"R, T: {poses.direction(c, a, b)}, metres"


def _camera_rows(c: Calibration, name: str, camera: CameraIntrinsics | None) -> list[tuple[str, Any]]:
    """Extrinsics and, if they are known, intrinsics of one camera; its image rectified by turning it like cam0."""
    T, i = np.eye(4) if name == CAMERAS[0] else c.between(name, CAMERAS[0]).T_a_b, f"0{name[-1]}"
    pose: list[tuple[str, Any]] = [(f"R_{i}", T[:3, :3]), (f"T_{i}", T[:3, 3])]
    if camera is None:
        return pose
    if np.any(camera.distortion[LARGEST_D:]):
        raise DataError(f"{name} has more than KITTI's five coefficients of distortion; leave --intrinsics out")
    D = np.pad(camera.distortion[:LARGEST_D], (0, max(LARGEST_D - len(camera.distortion), 0)))
    size = [] if camera.size is None else [("S", camera.size)]
    R_rect = T[:3, :3].T
    P_rect = camera.K @ np.column_stack([np.eye(3), R_rect @ T[:3, 3]])
    before = [(f"{key}_{i}", value) for key, value in [*size, ("K", camera.K), ("D", D)]]
    after = [(f"{key}_{i}", value) for key, value in [("R_rect", R_rect), ("P_rect", P_rect)]]
    return [*before, *pose, *((f"S_rect_{i}", value) for _, value in size), *after]


def _write(file: Path, rows: Sequence[tuple[str, Any]], said: str) -> None:
    """Lines of ``key: values``, of which readers pass over those that are no numbers; blank ones would stop them."""
    lines = [f"comment: {files.WRITTEN}", f"convention: {said}", f"clocks: {clocks.beside(file.parent).name}"]
    lines += [f"{key}: {' '.join(repr(float(x)) for x in np.ravel(values))}" for key, values in rows]
    file.write_text("\n".join([*lines, f"end: {files.END}", ""]), encoding="ascii")


def _read(file: Path) -> dict[str, list[float]]:
    """What has numbers, by key. Raises DataError."""
    found: dict[str, list[float]] = {}
    for line in files.text(file).splitlines():
        key, colon, words = line.partition(":")
        if not colon and line.strip():
            raise DataError(f"{file}: '{line[:40]}' is no line 'key: values'; fetch the file again")
        if key in found:
            raise DataError(f"{file} has {key} twice; keep one")
        try:
            found[key] = [float(w) for w in words.split()]
        except ValueError:
            continue
    return found


def _pose(file: Path, found: Mapping[str, list[float]], which: str = "") -> poses.Array:
    R = files.numbers(file, f"R{which}", found.get(f"R{which}"), 9)
    T = files.numbers(file, f"T{which}", found.get(f"T{which}"), 3)
    return poses.from_rotation(file, f"R{which}", np.reshape(R, (3, 3)), T)
