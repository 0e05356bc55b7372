"""A plain folder: names as stamps, every kind of cloud, and what is refused in a sentence."""

import os
from pathlib import Path

import folder_builders as build
import numpy as np
import pytest
from folder_builders import PLUGINS, opened, said

from calib_toolkit import DataError
from calib_toolkit_datasets import cloud_files, name_stamps

pytest.importorskip("laspy", reason="the extra 'las' is not installed")


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    return build.folder(tmp_path_factory.mktemp("folder") / "drive")


def test_every_sensor_is_found_by_its_files(whole):
    kinds = {n: s.kind for n, s in opened(whole).streams.items()}
    lidars = dict.fromkeys(("lidar_las", "lidar_laz", "lidar_npy", "lidar_ply", "top"), "velodyne")
    heads = dict.fromkeys(("ladybug0", "ladybug1", "ladybug2"), "ladybug")
    assert kinds == lidars | heads | {"front": "monocular", "slam": "odometry", "vo": "odometry", "gps": "gps_ins"}


def test_stamps_are_those_of_names_and_lists(whole):
    log = opened(whole)
    for name, within in {"top": 1e-9, "front": 1e-9, "ladybug1": 1e-9, "lidar_ply": 1e-6, "slam": 1e-5}.items():
        ns = log.epoch_ns - build.START + np.round(log.streams[name].stamps * 1e9)
        np.testing.assert_allclose(ns / 1e9, 0.1 * np.arange(12), atol=within, err_msg=name)
    assert log.streams["ladybug0"].clock == log.streams["ladybug2"].clock == "ladybug"


@pytest.mark.parametrize("name", ["top", "lidar_ply", "lidar_npy"])
def test_a_cloud_keeps_times_rings_and_intensities(whole, name):
    for k in (2, 9):
        scan, wanted = opened(whole).streams[name].readings[k], build.cloud(k)
        np.testing.assert_array_equal(scan.points, np.stack([wanted[c] for c in "xyz"], axis=1))
        for field, column in (("times", "time"), ("ring", "ring"), ("intensity", "intensity")):
            np.testing.assert_allclose(getattr(scan, field), wanted[column], atol=1e-7, err_msg=field)


@pytest.mark.parametrize("name", ["lidar_las", "lidar_laz"])
def test_las_and_laz(whole, name):
    log = opened(whole)
    scan, wanted = log.streams[name].readings[4], build.cloud(4)
    np.testing.assert_allclose(scan.points, np.stack([wanted[c] for c in "xyz"], axis=1), atol=1e-4)
    np.testing.assert_allclose(scan.times, wanted["time"], atol=1e-6)
    assert f"{name}: its points' times are " in said(log)


def test_columns_of_poses_are_known_by_their_titles(whole):
    log = opened(whole)
    for name in ("slam", "vo"):
        np.testing.assert_allclose(log.streams[name].readings[7].T_world_sensor, build.drive(12)[7], atol=1e-8)


def test_a_table_whose_titles_are_not_known_is_named(tmp_path):
    root = build.folder(tmp_path / "a", 4)
    (root / "gps.csv").write_text((root / "gps.csv").read_text().replace("lat_deg", "lat_d{g"))
    assert "gps is left out: its first line, 'stamp,lat_d{g,lon_deg" in said(opened(root))


def test_intrinsics_are_those_of_ros_file_and_a_missing_one_is_named(whole):
    log = opened(whole)
    camera = log.streams["front"].intrinsics
    assert (camera.K[1, 1], camera.distortion[0], camera.size) == (50.5, -0.2, (64, 48))
    info = whole / "front/camera_info.yaml"
    text = info.read_text()
    info.unlink()
    try:
        log = opened(whole)
        assert log.streams["front"].intrinsics is None
        assert f"front has no intrinsics: {info} is missing; write one" in said(log)
    finally:
        info.write_text(text)


@pytest.mark.parametrize(
    ("name", "ns"),
    [
        ("1403636579763555584.pcd", 1403636579763555584),
        ("1403636579763555.pcd", 1403636579763555000),
        ("1403636579763.pcd", 1403636579763000000),
        ("1403636579.763555584.pcd", 1403636579763555584),
        ("0.100000.pcd", 100_000_000),
        ("cloud_12.5.bin", 12_500_000_000),
        ("LIDAR_TOP__1532402927647951.pcd.bin", 1532402927647951000),
    ],
)
def test_a_name_is_a_stamp(name, ns):
    other = Path(name.replace("5", "6", 1)) if "5" in name else Path("0.2.pcd")
    stamps, _, _ = name_stamps.stamped("velo", [Path(name), other])
    assert ns in stamps.tolist()


def test_numbers_are_no_stamps(tmp_path):
    home = tmp_path / "velo"
    home.mkdir()
    for k in range(12):
        build.pcd(home / f"{k}.pcd", build.cloud(k))
    with pytest.raises(DataError, match=r"0.pcd is no stamp in seconds.* write times.txt beside it"):
        opened(tmp_path)
    (home / "times.txt").write_text("".join(f"{k / 10}\n" for k in range(12)))
    scan = opened(tmp_path).streams["velo"].readings[10]  # 10 comes after 9
    np.testing.assert_array_equal(scan.points[:, 0], build.cloud(10)["x"])
    (home / "3.pcd").unlink()
    stream = opened(tmp_path).streams["velo"]
    assert len(stream) == 11
    np.testing.assert_array_equal(stream.readings[3].points[:, 0], build.cloud(4)["x"])
    assert "missing" in "".join(stream.notes)
    (home / "times.txt").write_text("0.1\n0.2\n")
    with pytest.raises(DataError, match="2 stamps for 11 files"):
        opened(tmp_path)


@pytest.mark.parametrize(
    ("suffix", "content", "says"),
    [
        (".bin", np.zeros(7, "<f4").tobytes(), "no rows of 4 numbers"),
        (".bin", np.full(40, 7.5, ">f4").tobytes(), "order of bytes"),
        (".bin", b"", "no points"),
        (".pcd", b"# .PCD v0.7\nFIELDS x y z\nDATA ascii\n", "do not|does not say fields"),
        (".pcd", b"FIELDS x y\nSIZE 4 4\nTYPE F F\nPOINTS 1\nDATA ascii\n1 2\n", "no field 'z'"),
        (".pcd", b"FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nPOINTS 9\nDATA binary\n" + bytes(12), "says 9 points"),
        (".pcd", b"FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nPOINTS 99999999999\nDATA binary\n", "says 9+ points"),
        (".pcd", b"FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nPOINTS 0\nDATA binary\n", "holds no points"),
        (".ply", b"ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nend_header\n1\n", "says 2 points"),
        (".ply", b"ply\nformat ascii 1.0\nelement vertex 1\nproperty list uchar int x\nend_header\n1\n", "no single"),
        (".npy", b"\x93NUMPY", "ValueError"),
        (".las", b"LASF" + bytes(300), "ValueError"),
    ],
)
def test_a_cloud_that_can_not_be_used_is_refused_by_name(tmp_path, suffix, content, says):
    file = tmp_path / f"1{suffix}"
    file.write_bytes(content)
    with pytest.raises(DataError, match=rf"1{suffix}: sensor velo: the cloud can not be read \(.*({says})"):
        cloud_files.read_columns(file, "velo")


def test_a_laz_that_says_chunks_without_end_is_refused(tmp_path):
    build.las(tmp_path / "1.laz", build.cloud(0))
    raw = bytearray((tmp_path / "1.laz").read_bytes())
    points = int.from_bytes(raw[96:100], "little")
    table = int.from_bytes(raw[points : points + 8], "little")
    raw[table + 4 : table + 8] = b"\xf9" * 4
    (tmp_path / "1.laz").write_bytes(raw)
    with pytest.raises(DataError, match=r"1\.laz: .* says 4193909241 chunks"):
        cloud_files.read_columns(tmp_path / "1.laz", "velo")


class Evil:
    def __reduce__(self):
        return os.system, ("touch pwned",)


def test_a_pickle_in_an_array_is_not_run(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    np.save(tmp_path / "1.npy", np.array([Evil()], dtype=object), allow_pickle=True)
    with pytest.raises(DataError, match="Python objects"):
        cloud_files.read_columns(tmp_path / "1.npy", "velo")
    assert not (tmp_path / "pwned").exists()


def test_compressed_pcd(tmp_path):
    import open3d

    made = open3d.t.geometry.PointCloud()
    rng = np.random.default_rng(0)
    made.point.positions = open3d.core.Tensor(rng.uniform(-9, 9, (500, 3)).astype(np.float32))
    made.point.time = open3d.core.Tensor(np.linspace(0, 0.1, 500, dtype=np.float32)[:, None])
    open3d.t.io.write_point_cloud(str(tmp_path / "1.pcd"), made, compressed=True)
    assert b"binary_compressed" in (tmp_path / "1.pcd").read_bytes()[:400]
    columns = cloud_files.read_columns(tmp_path / "1.pcd", "velo")
    np.testing.assert_array_equal(columns["y"], made.point.positions.numpy()[:, 1])
    np.testing.assert_array_equal(columns["time"], made.point.time.numpy()[:, 0])


def test_other_layouts_come_first(tmp_path):
    home = build.kitti_odometry(tmp_path)
    assert "pose" in opened(home).streams
    (tmp_path / "empty").mkdir()
    with pytest.raises(DataError, match=r"no reader knows .* folder looks for subfolders"):
        opened(tmp_path / "empty")


def test_a_link_out_of_the_folder_is_refused(tmp_path):
    root = build.folder(tmp_path / "drive", 4)
    (tmp_path / "elsewhere").mkdir()
    for k in range(3):
        build.pcd(tmp_path / f"elsewhere/{k}.5.pcd", build.cloud(k))
    os.symlink(tmp_path / "elsewhere", root / "link")
    log = opened(root)
    assert "link" not in log.streams
    assert "leads out of the recording" in said(log)


def test_forty_damaged_files(tmp_path):
    assert build.damaged(build.folder(tmp_path / "a", 4), PLUGINS, 40)[0]


@pytest.mark.long
def test_a_thousand_damaged_files(tmp_path):
    assert sum(build.damaged(build.folder(tmp_path / "a", 4), PLUGINS, 1000, 2)) == 1000
