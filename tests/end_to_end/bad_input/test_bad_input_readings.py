"""Readings, files and tables that are wrong: each is refused by name, or left out and said to be."""

import numpy as np
import pytest
from small_runs import DEEP, EPOCH, HEAD, INS, VELO


def test_rows_that_are_nan_are_left_out_and_said(run, rig, written):
    def change(t, p, q):
        return t, np.where(np.isin(np.arange(300), range(100, 105))[:, None], np.nan, p), q

    assert run(rig(change)).exit_code == 3
    found = written()
    (warning,) = found["warnings"]
    assert "b.txt: 5 of 300 rows hold nan" in warning
    assert "line 101" in warning
    assert found["statistics"]["readings"] == {"a": 299, "b": 294}


def test_stamps_that_go_back_or_repeat_are_left_out_and_said(run, rig, written):
    def change(t, p, q):
        t = t.copy()
        t[50] -= 3.0
        t[60] = t[59]
        return t, p, q

    assert run(rig(change)).exit_code == 3
    (warning,) = written()["warnings"]
    assert "b.txt: 2 of 300 rows have a stamp that goes back or repeats" in warning
    assert "line 51" in warning


def test_mostly_nan_is_refused(refused, rig):
    folder = rig(lambda t, p, q: (t, np.where(np.arange(300)[:, None] % 3 == 0, p, np.nan), q))
    assert "b.txt: 200 of 300 rows hold nan" in refused(folder)


@pytest.mark.parametrize("factor", [1e3, 1e9])
def test_an_epoch_in_another_unit(refused, rig, factor):
    sentence = refused(rig(lambda t, p, q: (t * factor, p, q), form="%.0f"))
    assert "b.txt, line 1" in sentence
    assert "unit" in sentence


def test_milliseconds_since_the_start_for_seconds(refused, rig):
    sentence = refused(rig(lambda t, p, q: (EPOCH + (t - EPOCH) * 1e3, p, q)))
    assert "clocks" in sentence


@pytest.mark.parametrize("factor", [1e3, 1e-3])
def test_another_unit_of_length_is_not_taken_for_metres(run, rig, factor):
    result = run(rig(lambda t, p, q: (t, p * factor, q)))
    assert result.exit_code in (1, 3), result.output
    assert any(word in result.output for word in ("distance", "metres", "scale", "unit", "far"))


def test_a_sensor_whose_poses_never_change(refused, rig):
    sentence = refused(rig(lambda t, p, q: (t, 0 * p, np.tile([0.0, 0.0, 0.0, 1.0], (300, 1)))))
    assert "turn" in sentence


def test_quaternions_that_are_none(refused, rig):
    assert "b.txt, line 1: the quaternion" in refused(rig(lambda t, p, q: (t, p, 3 * q)))


def shortened(folder, rows, tail=""):
    file = folder / "b.txt"
    file.write_text("".join(file.read_text().splitlines(keepends=True)[:rows]) + tail)
    return folder


@pytest.mark.parametrize(
    ("rows", "tail", "words"),
    [
        (0, "", "b.txt holds no rows"),
        (1, "", "b.txt has one row"),
        (5, "", "sensor b: its 4 steps are too few"),
        (150, "1317000015.0 0.5 0.1 x 0 0 0 1", "b.txt, line 151"),
    ],
)
def test_files_cut_short(refused, rig, rows, tail, words):
    assert words in refused(shortened(rig(), rows, tail))


def test_a_last_row_that_was_cut_short_is_left_out(run, rig, written):
    result = run(shortened(rig(), 150, "1317000015.0 0.5 0.1"))
    assert result.exit_code in (0, 3), result.output
    assert [w for w in written()["warnings"] if "b.txt, line 151 has fewer columns" in w]


def test_a_file_that_is_missing(refused, rig):
    folder = rig()
    (folder / "b.txt").unlink()
    sentence = refused(folder)
    assert "sensor b" in sentence
    assert str(folder / "b.txt") in sentence


@pytest.mark.parametrize(
    "text", ["", "[sensors.a\n", DEEP, "[sensors]\n", "sensors = 3\n", "[sensors.a]\nkind = 3\n"]
)
def test_a_rig_that_makes_no_sense(refused, rig, text):
    folder = rig()
    (folder / "rig.toml").write_text(text)
    assert "rig.toml" in refused(folder)


@pytest.mark.parametrize(
    ("head", "body"),
    [
        ("", DEEP),
        ("\x00", ""),
        (HEAD, ""),
        (HEAD, "sensors = []\n"),
        (HEAD, "sensors = {}\n"),
        (HEAD, "[sensors]\nvelo = 1\n"),
        (HEAD, VELO + INS.replace("20.0", "0")),
        (HEAD, VELO + INS.replace("20.0", "nan")),
        (HEAD, VELO + INS.replace("20.0", "'x'")),
        (HEAD, VELO.replace("1.7", "nan") + INS),
        (HEAD, VELO.replace(", 0]", "]") + INS),
        (HEAD, VELO + "sigma = [1, 1]\n" + INS),
        (HEAD, VELO + "speed = 1\n" + INS),
        (HEAD + "drive = 'strait'\n", VELO + INS),
        ("seconds = 0\nseed = 1\n", VELO + INS),
        ("seconds = -9\nseed = 1\n", VELO + INS),
        ("seconds = nan\nseed = 1\n", VELO + INS),
        ("seconds = 1e12\nseed = 1\n", VELO + INS),
        ("seconds = 40\nseed = -1\n", VELO + INS),
    ],
)
def test_a_simulation_that_makes_no_sense(refused, drive, head, body):
    assert "simulated.toml" in refused(drive(body, head))


def test_stored_motions_that_are_damaged(refused, tmp_path):
    (tmp_path / "KittiVelData.mat").write_bytes(b"MATLAB 5.0 MAT-file" + bytes(200))
    (tmp_path / "KittiNavData.mat").write_bytes(b"")
    sentence = refused(tmp_path)
    assert "Data.mat: sensor " in sentence
    assert "fetch it again" in sentence


@pytest.fixture
def kitti(tmp_path):
    """Three seconds of KITTI raw: OXTS packets that are whole, and scans that hold the bytes given."""

    def kitti(scan, packet=lambda k: f"49.0 {8.4 + 1e-5 * k} 110 0 0 {0.05 * k}" + " 0" * 24):
        folder = tmp_path / "2011_09_26/2011_09_26_drive_0001_sync"
        for name, suffix, content in (
            ("oxts", "txt", lambda k: packet(k).encode()),
            ("velodyne_points", "bin", scan),
        ):
            (folder / name / "data").mkdir(parents=True)
            stamps = (f"2011-09-26 13:02:{25 + k / 10:012.9f}" for k in range(30))
            (folder / name / "timestamps.txt").write_text("\n".join(stamps) + "\n")
            for k in range(30):
                (folder / name / f"data/{k:010d}.{suffix}").write_bytes(content(k))
        return folder

    return kitti


@pytest.mark.parametrize("scan", [b"", b"\0" * 17, np.full(8, np.nan, dtype=np.float32).tobytes()])
def test_scans_that_are_empty_cut_short_or_nan(refused, kitti, scan):
    sentence = refused(kitti(lambda k: scan))
    assert "sensor velo: 30 of 30 readings can not be read" in sentence
    assert "0000000000.bin" in sentence
    assert "frame 0" in sentence


def test_fixes_that_are_cut_short(refused, kitti):
    points = np.random.default_rng(1).normal(size=(50, 4)).astype(np.float32).tobytes()
    sentence = refused(kitti(lambda k: points, packet=lambda k: "49.0 8.4 110"), "--sensors", "ins,velo")
    assert "sensor ins: 30 of 30 readings can not be read" in sentence
    assert "0000000000.txt" in sentence


def test_a_drive_without_any_reading(refused, kitti):
    folder = kitti(lambda k: b"")
    for file in folder.glob("*/data/*"):
        file.unlink()
    sentence = refused(folder)
    assert str(folder) in sentence
    assert "ins is left out" in sentence
