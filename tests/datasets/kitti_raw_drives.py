"""A small drive in KITTI's layout, as the tests want it, and what is read of one."""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from calib_toolkit import Log, ReadContext, se3
from calib_toolkit_datasets import kitti_raw

START_NS = 1_317_042_145_594_360_375  # 2011-09-26 13:02:25.594360375
STEP_NS = 103_617_011
SIZE_RECT, SIZE_RAW = (40, 30), (48, 32)

DriveWriter = Callable[..., Path]


def stamp_line(ns: int | None) -> str:
    """As KITTI writes it; None is a blank line."""
    if ns is None:
        return ""
    day = np.datetime64(ns, "ns").astype(str).replace("T", " ")
    return str(day)


def write_stamps(file: Path, ns: list[int | None]) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text("".join(f"{stamp_line(x)}\n" for x in ns))


def scan_rows(k: int) -> np.ndarray:
    """Four points, front, left, right and nearly behind; reflectance tells the frame."""
    xyz = [[10, 0, 0], [0, 10, 0], [0, -10, 0], [-10, 1e-3, 0]]
    return np.column_stack([np.array(xyz, dtype=np.float32), np.full(4, k, dtype=np.float32)])


def oxts_line(k: int) -> str:
    """lat, lon, alt, roll, pitch, yaw tell the frame; position accuracy 0.05 m."""
    values = [49.0 + 1e-5 * k, 8.4, 110.0 + k, 0.01, -0.02, 1.5, *np.zeros(17), 0.05, 0.01, 4, 9, 4, 4, 0]
    assert len(values) == 30
    return " ".join(f"{v:.10g}" for v in values)


def calib_lines(**entries: np.ndarray) -> str:
    lines = [f"{key}: " + " ".join(f"{v:.12e}" for v in np.ravel(value)) for key, value in entries.items()]
    return "calib_time: 09-Jan-2012 13:57:47\n" + "\n".join(lines) + "\n"


def write_calibration(folder: Path) -> None:
    """cam_to_cam, velo_to_cam and imu_to_velo of a plausible rig."""
    rng = np.random.default_rng(7)
    cam_to_cam: dict[str, np.ndarray] = {}
    for i in range(4):
        R, t = se3.exp_so3(rng.normal(0, 0.02, 3) * (i > 0)), np.array([-0.18 * i, 0.01 * i, 0.02 * i])
        P = np.array([[35.0, 0, 20, -35.0 * 0.18 * i], [0, 35.0, 15, 0], [0, 0, 1, 0]])
        cam_to_cam |= {
            f"S_{i:02d}": np.array(SIZE_RAW),
            f"K_{i:02d}": np.array([[38.0 + i, 0, 24], [0, 39.0, 16], [0, 0, 1]]),
            f"D_{i:02d}": np.array([-0.37, 0.2, 0.001, 0.0012, -0.07]),
            f"R_{i:02d}": R,
            f"T_{i:02d}": t,
            f"S_rect_{i:02d}": np.array(SIZE_RECT),
            f"R_rect_{i:02d}": se3.exp_so3(np.array([0.01, -0.02, 0.005])),
            f"P_rect_{i:02d}": P,
        }
    axes = np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])
    R_cam_velo = axes @ se3.exp_so3(np.array([0.01, 0.02, -0.01]))
    (folder / "calib_cam_to_cam.txt").write_text(calib_lines(**cam_to_cam))
    velo = calib_lines(R=R_cam_velo, T=np.array([0.0, -0.08, -0.27]))
    (folder / "calib_velo_to_cam.txt").write_text(velo)
    imu = calib_lines(R=se3.exp_so3(np.array([0.0, 0.001, 0.015])), T=np.array([-0.81, 0.32, -0.8]))
    (folder / "calib_imu_to_velo.txt").write_text(imu)


def write_drive(tmp_path: Path, name: str = "2011_09_26_drive_0009_sync", n: int = 6, scans: str = ".bin") -> Path:
    """A drive of n frames: velodyne, cameras 00 and 02, OXTS as often as they."""
    date = tmp_path / "2011_09_26"
    drive = date / name
    facing = [START_NS + k * STEP_NS for k in range(n)]
    for folder in ("velodyne_points", "image_00", "image_02", "oxts"):
        (drive / folder / "data").mkdir(parents=True)
    for part, shift in (("", 0), ("_start", -51_000_001), ("_end", 51_000_003)):
        write_stamps(drive / f"velodyne_points/timestamps{part}.txt", [t + shift for t in facing])
    for i, folder in enumerate(("image_00", "image_02")):
        write_stamps(drive / folder / "timestamps.txt", [t + 6_140_000 * i for t in facing])
    write_stamps(drive / "oxts/timestamps.txt", [t - 4_321 for t in facing])
    width, height = SIZE_RECT if name.endswith("_sync") else SIZE_RAW
    for k in range(n):
        scan = drive / f"velodyne_points/data/{k:010d}{scans}"
        if scans == ".bin":
            scan_rows(k).tofile(scan)
        else:
            np.savetxt(scan, scan_rows(k), fmt="%.4f")
        cv2.imwrite(str(drive / f"image_00/data/{k:010d}.png"), np.full((height, width), k, np.uint8))
        cv2.imwrite(str(drive / f"image_02/data/{k:010d}.png"), np.full((height, width, 3), k, np.uint8))
        (drive / f"oxts/data/{k:010d}.txt").write_text(oxts_line(k) + "\n")
    write_calibration(date)
    return drive


def opened(path: Path) -> Log:
    """What the reader makes of a drive, with no help of another."""
    return kitti_raw.open_log(path, ReadContext({}, lambda p: pytest.fail(f"opened {p}")))
