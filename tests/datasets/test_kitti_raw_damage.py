"""Damaged files of a KITTI raw drive: each refused by name when it is read, not when the drive is opened."""

from pathlib import Path

import numpy as np
import pytest
from kitti_raw_drives import DriveWriter, opened

from calib_toolkit.errors import DataError


@pytest.mark.parametrize(
    ("sensor", "file", "content", "says"),
    [
        ("velo", "velodyne_points/data/0000000002.bin", b"\0" * 30, "30 bytes"),
        ("velo", "velodyne_points/data/0000000002.bin", b"", "no points"),
        ("velo", "velodyne_points/data/0000000002.bin", np.full(8, np.nan, np.float32).tobytes(), "not numbers"),
        ("cam0", "image_00/data/0000000002.png", b"\x89PNG\r\n\x1a\n", "not a whole png"),
        ("ins", "oxts/data/0000000002.txt", b"49.0 8.4 110\n", "30 numbers"),
        ("ins", "oxts/data/0000000002.txt", b"nan " * 30, "no valid position"),
        ("ins", "oxts/data/0000000002.txt", b"900 " * 30, "no valid position"),
    ],
)
def test_a_damaged_reading_is_named(
    write_drive: DriveWriter, sensor: str, file: str, content: bytes, says: str
) -> None:
    drive = write_drive()
    (drive / file).write_bytes(content)
    readings = opened(drive).streams[sensor].readings
    with pytest.raises(DataError, match=rf"{Path(file).name}: sensor {sensor}, frame 2,.*{says}"):
        readings[2]
    assert readings[1] is not None


def test_a_scan_that_is_gone_when_wanted_is_named(write_drive: DriveWriter) -> None:
    drive = write_drive()
    log = opened(drive)
    for file in ("velodyne_points/data/0000000001.bin", "oxts/data/0000000001.txt", "image_00/data/0000000001.png"):
        (drive / file).unlink()
    for name in ("velo", "ins", "cam0"):
        with pytest.raises(DataError, match=rf"sensor {name}, frame 1,"):
            log.streams[name].readings[1]


def test_a_damaged_text_scan_is_named(write_drive: DriveWriter) -> None:
    drive = write_drive("2011_09_26_drive_0009_extract", scans=".txt")
    for text in ("1 2 3\n4 5\n", "a b c d\n", "1 2 3\n"):
        (drive / "velodyne_points/data/0000000002.txt").write_text(text)
        with pytest.raises(DataError, match=r"sensor velo, frame 2, can not be read"):
            opened(drive).streams["velo"].readings[2]
    (drive / "velodyne_points/data/0000000002.txt").write_text("\n")
    with pytest.raises(DataError, match="no points"):
        opened(drive).streams["velo"].readings[2]


def test_half_a_png_is_refused(write_drive: DriveWriter) -> None:
    drive = write_drive()
    file = drive / "image_02/data/0000000003.png"
    file.write_bytes(file.read_bytes()[:-20])
    with pytest.raises(DataError, match=r"frame 3, is not a whole png"):
        opened(drive).streams["cam2"].readings[3]


def test_images_of_another_size_than_the_calibration_says(write_drive: DriveWriter) -> None:
    drive = write_drive("2011_09_26_drive_0009_extract")
    drive = drive.rename(drive.parent / "2011_09_26_drive_0009_sync")
    with pytest.raises(DataError, match="48 x 32 pixels where the calibration file says 40 x 30"):
        opened(drive).streams["cam0"].readings[0]


def test_a_rotation_with_a_damaged_number_is_no_reference(write_drive: DriveWriter) -> None:
    file = write_drive().parent / "calib_imu_to_velo.txt"
    drive = next(file.parent.glob("*_sync"))
    whole = file.read_text()
    assert whole.count("R: 9.99") == 1
    file.write_text(whole.replace("R: 9.99", "R: 9.89"))
    with pytest.raises(DataError, match=r"sensor ins: .* no rotation; fetch them again"):
        opened(drive)


def test_a_damaged_calibration_file_is_named(write_drive: DriveWriter) -> None:
    drive = write_drive()
    (drive.parent / "calib_velo_to_cam.txt").write_text("R: 1 2 3\n")
    with pytest.raises(DataError, match=r"calib_velo_to_cam\.txt: 'R' must be 9 numbers"):
        opened(drive)
    (drive.parent / "calib_velo_to_cam.txt").write_text("no colon here\n")
    with pytest.raises(DataError, match=r"calib_velo_to_cam\.txt is not a calibration file"):
        opened(drive)
