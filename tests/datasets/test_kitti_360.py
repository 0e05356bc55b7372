"""KITTI-360: the published tree, the flat folder, made-up stamps, the real frames."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from calib_toolkit import Log, ReadContext
from calib_toolkit.errors import DataError
from calib_toolkit_datasets import kitti_360, kitti_raw, multi_array_calib, rig

SEQUENCE = "2013_05_28_drive_0000_sync"
START = np.datetime64("2013-05-28T08:46:02.904626432", "ns")
PERSPECTIVE = """calib_time: 17-Feb-2016 14:23:48
S_rect_00: 40 30
R_rect_00: 1 0 0 0 0 -1 0 1 0
P_rect_00: 35 0 20 0 0 35 15 0 0 0 1 0
S_rect_01: 40 30
P_rect_01: 35 0 20 -21 0 35 15 0 0 0 1 0
"""
CAM_TO_VELO = "1 0 0 0.8 0 1 0 0.3 0 0 1 -0.2\n"


def opened(path: Path) -> Log:
    return kitti_360.open_log(path, ReadContext({}, lambda p: pytest.fail(f"opened {p}")))


def write_frames(velo: Path, cameras: dict[str, Path], frames: range) -> None:
    for folder in (velo, *cameras.values()):
        folder.mkdir(parents=True, exist_ok=True)
    for k in frames:
        np.array([[10, 0, 0, k], [0, 10, 0, k]], np.float32).tofile(velo / f"{k:010d}.bin")
        for folder in cameras.values():
            cv2.imwrite(str(folder / f"{k:010d}.png"), np.full((30, 40), k, np.uint8))


def write_calibration(folder: Path) -> None:
    folder.mkdir(parents=True)
    (folder / "perspective.txt").write_text(PERSPECTIVE)
    (folder / "calib_cam_to_velo.txt").write_text(CAM_TO_VELO)


def write_stamps(folder: Path, n: int, late_ns: int) -> None:
    stamps = START + np.arange(n) * np.timedelta64(104_600_001, "ns") + np.timedelta64(late_ns, "ns")
    (folder / "timestamps.txt").write_text("".join(str(s).replace("T", " ") + "\n" for s in stamps))


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    """The published layout: one sequence of frames 1 to 5 of both cameras, frame 3 of the velodyne missing."""
    write_calibration(tmp_path / "calibration")
    velo = tmp_path / "data_3d_raw" / SEQUENCE / "velodyne_points"
    cameras = {n: tmp_path / "data_2d_raw" / SEQUENCE / f / "data_rect" for n, f in
               (("cam0", "image_00"), ("cam1", "image_01"))}  # fmt: skip
    write_frames(velo / "data", cameras, range(1, 6))
    (velo / "data/0000000003.bin").unlink()
    write_stamps(velo, 6, 5_000_007)
    for folder in cameras.values():
        write_stamps(folder.parent, 6, 0)
    return tmp_path


@pytest.fixture
def flat(tmp_path: Path) -> Path:
    write_calibration(tmp_path / "calibration")
    write_frames(tmp_path / "velodyne_points/data", {"cam0": tmp_path / "image_00/data"}, range(200, 204))
    return tmp_path


@pytest.mark.parametrize("where", ["", f"data_3d_raw/{SEQUENCE}", f"data_2d_raw/{SEQUENCE}"])
def test_published_tree(tree: Path, where: str) -> None:
    assert kitti_360.matches(tree / where)
    assert not kitti_raw.matches(tree / where)
    log = opened(tree / where)
    assert {n: len(s) for n, s in log.streams.items()} == {"velo": 4, "cam0": 5, "cam1": 5}
    assert log.epoch_ns == int(START.astype(np.int64)) + 104_600_001
    velo = log.streams["velo"]
    assert velo.stamps == pytest.approx(0.005000007 + 0.104600001 * np.array([0, 1, 3, 4]), abs=1e-12)
    assert [int(s.intensity[0]) for s in velo.readings] == [1, 2, 4, 5]
    assert "missing" in velo.notes[0]
    assert [int(i[0, 0]) for i in log.streams["cam1"].readings] == [1, 2, 3, 4, 5]


def test_reference_is_of_the_rectified_cameras(tree: Path) -> None:
    reference = opened(tree).reference
    assert reference is not None
    R_rect = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    point_velo = np.array([5.0, 1.0, -1.0])
    in_rect = R_rect @ (point_velo - [0.8, 0.3, -0.2])
    assert (reference.between("cam0", "velo").T_a_b @ [*point_velo, 1])[:3] == pytest.approx(in_rect)
    in_cam1 = in_rect - [0.6, 0, 0]
    assert (reference.between("cam1", "velo").T_a_b @ [*point_velo, 1])[:3] == pytest.approx(in_cam1)


def test_flat_folder_makes_stamps_up_and_says_so(flat: Path) -> None:
    log = opened(flat)
    assert kitti_360.matches(flat)
    assert not kitti_raw.matches(flat)
    for stream in log.streams.values():
        assert stream.stamps == pytest.approx(0.1046 * np.arange(4))
        assert "relative to equal frame numbers" in stream.notes[-1]
    left = log.streams["velo"].readings[0].times[1]
    assert left == pytest.approx(-0.1046 / 4)


def test_stamps_of_one_sensor_alone_are_not_mixed_with_made_up_ones(flat: Path) -> None:
    write_stamps(flat / "image_00", 300, 0)
    log = opened(flat)
    assert log.streams["velo"].stamps.tolist() == log.streams["cam0"].stamps.tolist()
    assert "no stamps" in log.streams["cam0"].notes[-1]


def test_without_extrinsics_there_is_no_reference(flat: Path) -> None:
    (flat / "calibration/calib_cam_to_velo.txt").unlink()
    assert opened(flat).reference is None
    (flat / "calibration/calib_cam_to_velo.txt").write_text("1 2 3\n")
    with pytest.raises(DataError, match=r"calib_cam_to_velo\.txt must hold 12 numbers"):
        opened(flat)


def test_several_sequences_must_be_named(tree: Path) -> None:
    (tree / "data_3d_raw/2013_05_28_drive_0002_sync").mkdir()
    with pytest.raises(DataError, match="holds 2 sequences; name the folder of one"):
        opened(tree)


def test_empty_folders(flat: Path) -> None:
    for file in (flat / "velodyne_points/data").iterdir():
        file.unlink()
    log = opened(flat)
    assert list(log.streams) == ["cam0"]
    assert "velo is left out" in log.notes[0]
    for file in (flat / "image_00/data").iterdir():
        file.unlink()
    with pytest.raises(DataError, match="holds no scans and no images"):
        opened(flat)


def test_a_truncated_scan_is_named(flat: Path) -> None:
    (flat / "velodyne_points/data/0000000201.bin").write_bytes(b"\0" * 17)
    with pytest.raises(DataError, match=r"0000000201\.bin: sensor velo, frame 201,.*17 bytes"):
        opened(flat).streams["velo"].readings[1]


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "must hold 12 numbers"),
        (CAM_TO_VELO.replace("0.8", "inf"), "12 numbers"),
        ("9" + CAM_TO_VELO, "no rotation"),
    ],
)
def test_a_damaged_extrinsic_is_refused(flat: Path, text: str, says: str) -> None:
    (flat / "calibration/calib_cam_to_velo.txt").write_text(text)
    with pytest.raises(DataError, match=says):
        opened(flat)


def test_the_real_frames(recordings: Path) -> None:
    path = recordings / "kitti360-3000"
    known_by = [m.__name__ for m in (kitti_raw, kitti_360, multi_array_calib, rig) if m.matches(path)]
    assert known_by == ["calib_toolkit_datasets.kitti_360"]
    log = opened(path)
    velo, cam0 = log.streams["velo"], log.streams["cam0"]
    assert (len(velo), len(cam0)) == (50, 50)
    assert velo.stamps[-1] == pytest.approx(49 * 0.1046)
    scan, image = velo.readings[0], cam0.readings[0]
    assert 100_000 < len(scan.points) < 140_000
    assert np.abs(scan.times).max() == pytest.approx(0.0523, abs=1e-4)
    assert image.shape[:2] == (376, 1408)
    assert cam0.intrinsics is not None
    assert cam0.intrinsics.size == (1408, 376)
    assert log.reference is not None
    T_cam0_velo = log.reference.between("cam0", "velo").T_a_b
    ahead = T_cam0_velo @ [10.0, 0, 0, 1]
    assert ahead[2] == pytest.approx(9.2, abs=0.2)
    assert np.degrees(np.arccos(T_cam0_velo[2, 0])) < 6
