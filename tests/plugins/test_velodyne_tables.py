"""Scans in files that a table of a rig names."""

from pathlib import Path

import numpy as np
import pytest
from ray_cast_streets import FORWARD, forward

from calib_toolkit import DataError, SensorTable
from calib_toolkit_plugins.velodyne import VelodyneOptions, estimate, open_table


def table(folder: Path, **values: object) -> SensorTable:
    return SensorTable("velo", folder, {"scans": "scans", "times": "times.txt", **values})


@pytest.fixture
def recorded(tmp_path: Path) -> Path:
    (tmp_path / "scans").mkdir()
    for k, scan in enumerate(forward().readings[:3]):
        np.column_stack([scan.points, np.ones(len(scan.points))]).astype("<f4").tofile(tmp_path / f"scans/{k:06}.bin")
    (tmp_path / "times.txt").write_text("".join(f"2011-10-03 12:55:34.{k}12345678\n" for k in range(3)))
    return tmp_path


def test_a_table_of_a_rig_is_read(recorded: Path) -> None:
    log = open_table(table(recorded, turns="clockwise"))
    velo = log.streams["velo"]
    assert log.epoch_ns == 1317646534012345678
    assert np.allclose(velo.stamps, [0.0, 0.1, 0.2], atol=1e-9)
    scan, truth = velo.readings[1], forward().readings[1]
    assert np.array_equal(scan.points, truth.points)
    assert np.abs(scan.times - truth.times).max() < 1e-6
    assert np.abs(estimate(velo, VelodyneOptions(**velo.options)).vec - FORWARD).max() < 0.01


def test_stamps_in_seconds_and_scans_in_npy(tmp_path: Path) -> None:
    (tmp_path / "scans").mkdir()
    for k in range(2):
        np.save(tmp_path / f"scans/{k}.npy", np.arange(6.0).reshape(2, 3))
    (tmp_path / "times.txt").write_text("1317646534.012345678\n1.3176465341e9\n\n")
    log = open_table(table(tmp_path))
    assert log.epoch_ns == 1317646534012345678
    assert np.allclose(log.streams["velo"].stamps, [0.0, 0.087654322], atol=1e-9)
    assert log.streams["velo"].readings[0].times is None


@pytest.mark.parametrize("suffix", ["ply", "pcd"])
def test_scans_in_formats_of_open3d(tmp_path: Path, suffix: str) -> None:
    open3d = pytest.importorskip("open3d", exc_type=ImportError)
    (tmp_path / "scans").mkdir()
    points = np.arange(12.0).reshape(4, 3)
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
    open3d.io.write_point_cloud(str(tmp_path / f"scans/0.{suffix}"), cloud)
    (tmp_path / f"scans/1.{suffix}").write_text("nothing of the kind\n")
    (tmp_path / "times.txt").write_text("0\n1\n")
    readings = open_table(table(tmp_path)).streams["velo"].readings
    assert np.allclose(readings[0].points, points)
    with pytest.raises(DataError, match=f"1.{suffix} is not a scan"):
        readings[1]


@pytest.mark.parametrize(
    ("values", "sentence"),
    [
        ({"scan": "x"}, "velo has the key 'scan', which is unknown here; it may have scans, times, turns"),
        ({"times": 3}, "sensor velo needs times = "),
        ({"turns": "left"}, "turns = 'left' is not known"),
        ({"scans": "nowhere"}, "sensor velo: scans = 'nowhere', but there is no folder .*nowhere"),
        ({"scans": "."}, "holds no scans"),
        ({"times": "nowhere.txt"}, "sensor velo: times = 'nowhere.txt', but there is no file .*nowhere.txt"),
        ({"times": "short.txt"}, "holds 2 stamps and .* 3 scans"),
        ({"times": "blank.txt"}, "blank.txt, line 2 holds no stamp"),
        ({"times": "infinite.txt"}, "infinite.txt, line 1 holds no stamp"),
    ],
)
def test_bad_tables_are_refused(recorded: Path, values: dict[str, object], sentence: str) -> None:
    (recorded / "short.txt").write_text("0\n1\n")
    (recorded / "blank.txt").write_text("0\n\n1\n")
    (recorded / "infinite.txt").write_text("inf\n1\n2\n")
    with pytest.raises(DataError, match=sentence):
        open_table(table(recorded, **values))


@pytest.mark.parametrize("name", ["cut.bin", "pickle.npy", "flat.npy"])
def test_bad_scan_files_are_refused(tmp_path: Path, name: str) -> None:
    (tmp_path / "scans").mkdir()
    file = tmp_path / "scans" / name
    contents = {"cut.bin": np.zeros(7, "<f4"), "pickle.npy": np.array([{}], dtype=object), "flat.npy": np.zeros(3)}
    contents[name].tofile(file) if name == "cut.bin" else np.save(file, contents[name], allow_pickle=True)
    (tmp_path / "times.txt").write_text("0\n")
    log = open_table(table(tmp_path))
    with pytest.raises(DataError, match=name):
        log.streams["velo"].readings[0]
