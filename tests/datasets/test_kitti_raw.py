"""KITTI raw drives: what belongs together, what is dropped and said, what is refused."""

import pickle
from pathlib import Path

import numpy as np
import pytest
from kitti_raw_drives import START_NS, STEP_NS, DriveWriter, opened

from calib_toolkit import Log
from calib_toolkit.errors import DataError
from calib_toolkit_datasets import kitti_raw


def edit_line(file: Path, line: int, text: str) -> None:
    lines = file.read_text().splitlines()
    lines[line] = text
    file.write_text("\n".join(lines) + "\n")


def unix_ns(log: Log, name: str) -> list[int]:
    return [log.epoch_ns + round(t * 1e9) for t in log.streams[name].stamps]


def test_sensors_kinds_and_nanoseconds(write_drive: DriveWriter) -> None:
    log = opened(write_drive())
    assert {n: s.kind for n, s in log.streams.items()} == {
        "velo": "velodyne",
        "cam0": "monocular",
        "cam2": "monocular",
        "ins": "gps_ins",
    }
    assert [s.has_scale for s in log.streams.values()] == [True, False, False, True]
    facing = [START_NS + k * STEP_NS for k in range(6)]
    assert unix_ns(log, "cam0") == facing
    assert unix_ns(log, "cam2") == [t + 6_140_000 for t in facing]
    assert unix_ns(log, "ins") == [t - 4_321 for t in facing]
    assert unix_ns(log, "velo") == [t + 1 for t in facing]  # the middle of start and end
    assert log.notes == ()
    assert all(s.notes == () for s in log.streams.values())


def test_readings_are_what_was_written(write_drive: DriveWriter) -> None:
    log = opened(write_drive())
    scan = log.streams["velo"].readings[4]
    assert scan.points.dtype == np.float32
    assert scan.intensity.tolist() == [4, 4, 4, 4]
    grey, colour = log.streams["cam0"].readings[5], log.streams["cam2"].readings[5]
    assert (grey.shape, colour.shape, grey.dtype) == ((30, 40), (30, 40, 3), np.uint8)
    assert np.all(grey == 5)
    fix = log.streams["ins"].readings[3]
    assert np.degrees([fix.lat, fix.lon]) == pytest.approx([49.00003, 8.4], abs=1e-9)
    assert (fix.alt, fix.roll, fix.pitch, fix.yaw) == (113.0, 0.01, -0.02, 1.5)
    assert fix.sigma_position.tolist() == [0.05] * 3
    assert fix.sigma_rpy is None


def test_the_sweep_turns_clockwise_from_rear_to_rear(write_drive: DriveWriter) -> None:
    front, left, right, behind = opened(write_drive()).streams["velo"].readings[0].times
    period = 0.102000004
    assert front == pytest.approx(0.0, abs=1e-9)
    assert left == pytest.approx(-period / 4, rel=1e-5)
    assert right == pytest.approx(period / 4, rel=1e-5)
    assert behind == pytest.approx(-period / 2, rel=1e-3)


def test_a_missing_scan_shifts_nothing(write_drive: DriveWriter) -> None:
    drive = write_drive()
    (drive / "velodyne_points/data/0000000002.bin").unlink()
    for part in ("", "_start", "_end"):
        edit_line(drive / f"velodyne_points/timestamps{part}.txt", 2, "")
    log = opened(drive)
    velo = log.streams["velo"]
    frames = [0, 1, 3, 4, 5]
    assert unix_ns(log, "velo") == [START_NS + k * STEP_NS + 1 for k in frames]
    assert [r.intensity[0] for r in velo.readings] == frames
    assert velo.notes == ("velo: 1 file(s) missing, the first is number 2",)
    assert len(log.streams["cam0"]) == 6


def test_a_blank_stamp_line_costs_its_reading(write_drive: DriveWriter) -> None:
    drive = write_drive()
    edit_line(drive / "image_00/timestamps.txt", 3, "")
    log = opened(drive)
    assert [int(image[0, 0]) for image in log.streams["cam0"].readings] == [0, 1, 2, 4, 5]
    assert log.streams["cam0"].notes == (
        "cam0: 1 reading(s) dropped because they have no stamp, the first is number 3",
    )


def test_files_beyond_the_last_stamp_are_dropped(write_drive: DriveWriter) -> None:
    drive = write_drive()
    file = drive / "image_00/timestamps.txt"
    file.write_text("".join(line + "\n" for line in file.read_text().splitlines()[:4]))
    log = opened(drive)
    assert len(log.streams["cam0"]) == 4
    assert "2 reading(s) dropped" in log.streams["cam0"].notes[0]


def test_duplicate_and_backward_oxts_stamps(write_drive: DriveWriter) -> None:
    drive = write_drive(n=8)
    file = drive / "oxts/timestamps.txt"
    lines = file.read_text().splitlines()
    edit_line(file, 3, lines[2])
    edit_line(file, 6, lines[4])
    log = opened(drive)
    assert [round(f.alt - 110) for f in log.streams["ins"].readings] == [0, 1, 2, 4, 5, 7]
    assert log.streams["ins"].notes == (
        "ins: 2 reading(s) dropped because their stamps repeat or go back, the first is number 3",
    )


def test_without_start_and_end_the_front_stamp_stands_in(write_drive: DriveWriter) -> None:
    drive = write_drive()
    edit_line(drive / "velodyne_points/timestamps_end.txt", 1, "")
    log = opened(drive)
    assert unix_ns(log, "velo")[:2] == [START_NS + 1, START_NS + STEP_NS]
    assert log.streams["velo"].readings.keys[1].period == pytest.approx(0.102000004)
    for part in ("_start", "_end"):
        (drive / f"velodyne_points/timestamps{part}.txt").unlink()
    log = opened(drive)
    assert unix_ns(log, "velo") == [START_NS + k * STEP_NS for k in range(6)]
    assert log.streams["velo"].readings.keys[0].period == pytest.approx(STEP_NS / 1e9)


def test_end_before_start_is_not_believed(write_drive: DriveWriter) -> None:
    drive = write_drive()
    edit_line(drive / "velodyne_points/timestamps_end.txt", 1, "2011-09-26 13:02:20.5")
    assert unix_ns(opened(drive), "velo")[1] == START_NS + STEP_NS


@pytest.mark.parametrize("scans", [".bin", ".txt"])
def test_extract_drive(write_drive: DriveWriter, scans: str) -> None:
    log = opened(write_drive("2011_09_26_drive_0009_extract", scans=scans))
    scan, camera = log.streams["velo"].readings[2], log.streams["cam2"].intrinsics
    assert scan.points == pytest.approx(np.array([[10, 0, 0], [0, 10, 0], [0, -10, 0], [-10, 1e-3, 0]]), abs=1e-3)
    assert scan.intensity[0] == 2
    assert camera is not None
    assert camera.size == (48, 32)
    assert camera.distortion == pytest.approx([-0.37, 0.2, 0.001, 0.0012, -0.07])
    assert pytest.approx(np.array([[40.0, 0, 24], [0, 39.0, 16], [0, 0, 1]])) == camera.K
    assert log.streams["cam2"].readings[0].shape == (32, 48, 3)


def test_synced_images_are_rectified(write_drive: DriveWriter) -> None:
    camera = opened(write_drive()).streams["cam2"].intrinsics
    assert camera is not None
    assert (camera.size, camera.distortion.size) == ((40, 30), 0)
    assert pytest.approx(np.array([[35.0, 0, 20], [0, 35.0, 15], [0, 0, 1]])) == camera.K


def test_reference_of_a_synced_drive_is_pykittis(write_drive: DriveWriter) -> None:
    import pykitti

    drive = write_drive()
    theirs = pykitti.raw(str(drive.parent.parent), "2011_09_26", "0009").calib
    reference = opened(drive).reference
    assert reference is not None
    assert reference.names == ("velo", "cam0", "cam2", "ins")
    assert reference.between("cam0", "velo").T_a_b == pytest.approx(theirs.T_cam0_velo, abs=1e-9)
    assert reference.between("cam2", "velo").T_a_b == pytest.approx(theirs.T_cam2_velo, abs=1e-9)
    assert reference.between("velo", "ins").T_a_b == pytest.approx(theirs.T_velo_imu, abs=1e-9)
    assert reference.determined[:, 6].tolist() == [True, False, False, False]


def test_reference_of_an_extract_drive_is_of_the_cameras_as_they_are(write_drive: DriveWriter) -> None:
    from calib_toolkit_datasets.kitti_files import read_calib

    drive = write_drive("2011_09_26_drive_0009_extract")
    velo, cams = (read_calib(drive.parent / f"calib_{n}.txt") for n in ("velo_to_cam", "cam_to_cam"))
    point = np.array([7.0, -2.0, 0.5])
    in_cam0 = velo["R"].reshape(3, 3) @ point + velo["T"]
    in_cam2 = cams["R_02"].reshape(3, 3) @ in_cam0 + cams["T_02"]
    reference = opened(drive).reference
    assert reference is not None
    T_cam2_velo = reference.between("cam2", "velo").T_a_b
    assert (T_cam2_velo @ [*point, 1.0])[:3] == pytest.approx(in_cam2, abs=1e-9)


def test_works_without_the_calibration_that_users_lack(write_drive: DriveWriter) -> None:
    drive = write_drive()
    (drive.parent / "calib_velo_to_cam.txt").unlink()
    log = opened(drive)
    assert log.reference is not None
    assert log.reference.names == ("velo", "ins")
    assert log.streams["cam0"].intrinsics is not None
    (drive.parent / "calib_imu_to_velo.txt").unlink()
    assert opened(drive).reference is None


def test_cameras_without_any_calibration_say_so(write_drive: DriveWriter) -> None:
    drive = write_drive()
    for file in drive.parent.glob("calib_*.txt"):
        file.unlink()
    log = opened(drive)
    assert log.reference is None
    assert log.streams["cam0"].intrinsics is None
    assert "calib_cam_to_cam.txt is missing" in log.streams["cam0"].notes[-1]
    assert log.streams["cam0"].readings[1].shape == (30, 40)
    assert len(log.streams["velo"]) == len(log.streams["ins"]) == 6


def test_a_renamed_drive_does_not_say_how_its_images_are(write_drive: DriveWriter) -> None:
    drive = write_drive().rename(write_drive("2011_09_26_drive_0010_sync").parent / "drive")
    log = opened(drive)
    assert kitti_raw.matches(drive)
    assert log.streams["cam0"].intrinsics is None
    assert "_sync" in log.streams["cam0"].notes[-1]


def test_opening_loads_nothing(write_drive: DriveWriter) -> None:
    drive = write_drive()
    for folder in ("velodyne_points", "image_00", "image_02", "oxts"):
        for file in (drive / folder / "data").iterdir():
            file.write_bytes(b"")
    log = opened(drive)
    assert [len(s) for s in log.streams.values()] == [6, 6, 6, 6]


def test_streams_can_be_sliced_and_pickled(write_drive: DriveWriter) -> None:
    for stream in opened(write_drive()).streams.values():
        again = pickle.loads(pickle.dumps(stream[2:4]))
        assert len(again) == 2
        assert again.readings[1] is not None


def test_zero_accuracy_is_not_stated(write_drive: DriveWriter) -> None:
    drive = write_drive()
    file = drive / "oxts/data/0000000000.txt"
    values = file.read_text().split()
    values[23] = "0"
    file.write_text(" ".join(values))
    assert opened(drive).streams["ins"].readings[0].sigma_position is None


def test_a_folder_without_readings_is_left_out_and_said(write_drive: DriveWriter) -> None:
    drive = write_drive()
    for file in (drive / "oxts/data").iterdir():
        file.unlink()
    (drive / "image_00/timestamps.txt").unlink()
    (drive / "image_01").mkdir()
    log = opened(drive)
    assert list(log.streams) == ["velo", "cam2"]
    assert [note.split(" is left out: ")[0] for note in log.notes] == ["cam0", "cam1", "ins"]


def test_an_empty_drive_is_refused(tmp_path: Path) -> None:
    (tmp_path / "oxts").mkdir()
    (tmp_path / "oxts/timestamps.txt").write_text("")
    assert kitti_raw.matches(tmp_path)
    with pytest.raises(DataError, match=r"no reading of any sensor: ins is left out"):
        opened(tmp_path)


def test_only_drives_match(write_drive: DriveWriter, tmp_path: Path) -> None:
    drive = write_drive()
    assert kitti_raw.matches(drive)
    assert not kitti_raw.matches(drive.parent)
    assert not kitti_raw.matches(tmp_path / "nowhere")
    assert not kitti_raw.matches(drive / "oxts/timestamps.txt")
