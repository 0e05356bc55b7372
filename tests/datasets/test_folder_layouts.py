"""KITTI's odometry benchmark, EuRoC and TUM: what is read, what is left out with a sentence, what is refused."""

import os

import folder_builders as build
import numpy as np
import pytest
from click.testing import CliRunner
from folder_builders import PLUGINS, opened, said

from calib_toolkit import DataError, se3
from calib_toolkit.cli import main
from calib_toolkit.types import MotionReading


def test_a_kitti_sequence(tmp_path):
    home = build.kitti_odometry(tmp_path)
    log = opened(home)
    assert {n: s.kind for n, s in log.streams.items()} == {
        "velo": "velodyne",
        "cam0": "monocular",
        "cam2": "monocular",
        "pose": "odometry",
    }
    assert all(np.allclose(s.stamps, 0.1 * np.arange(12)) for s in log.streams.values())
    assert log.streams["velo"].readings[3].times is None
    assert "not straightened once more" in said(log)
    assert "no sensor but the ground truth" in said(log)
    assert log.streams["cam0"].clock == log.streams["cam2"].clock != log.streams["velo"].clock
    camera = log.streams["cam2"].intrinsics
    np.testing.assert_array_equal(camera.K, build.P[2][:, :3])
    assert camera.size == (64, 48)
    np.testing.assert_allclose(log.streams["pose"].readings[4].T_world_sensor, build.drive(12)[4], atol=1e-8)


def test_kittis_reference_projects_as_its_files_do(tmp_path):
    """A point of the scanner lands on the pixel of camera 2 that ``P2 Tr`` gives."""
    log = opened(build.kitti_odometry(tmp_path))
    point = np.array([12.0, 1.5, -0.7, 1.0])
    x = build.P[2] @ np.vstack([build.TR, [0, 0, 0, 1]]) @ point
    seen = log.streams["cam2"].intrinsics.K @ (log.reference.between("cam2", "velo").T_a_b @ point)[:3]
    np.testing.assert_allclose(seen[:2] / seen[2], x[:2] / x[2], atol=1e-9)
    np.testing.assert_allclose(log.reference.between("pose", "cam0").T_a_b, np.eye(4), atol=1e-12)


def test_one_sequence_is_found_from_the_root_and_of_two_one_must_be_named(tmp_path):
    home = build.kitti_odometry(tmp_path)
    assert list(opened(tmp_path).streams) == list(opened(home).streams)
    (tmp_path / "sequences/08").mkdir()
    (tmp_path / "sequences/08/times.txt").write_text("0\n")
    with pytest.raises(DataError, match=r"2 sequences \(07, 08\)"):
        opened(tmp_path)


def test_a_missing_scan_shifts_nothing_and_missing_calibration_is_said(tmp_path):
    home = build.kitti_odometry(tmp_path)
    wanted = opened(home).streams["velo"].readings[3].points
    (home / "velodyne/000001.bin").unlink()
    (home / "calib.txt").unlink()
    log = opened(home)
    np.testing.assert_array_equal(log.streams["velo"].readings[2].points, wanted)
    assert log.streams["velo"].stamps[2] == pytest.approx(0.3)
    assert "cam0 has no intrinsics" in said(log)


def test_poses_that_do_not_fit_are_left_out(tmp_path):
    home = build.kitti_odometry(tmp_path)
    (tmp_path / "poses/07.txt").write_text(build.kitti_poses(build.drive(11)))
    log = opened(home)
    assert "pose" not in log.streams
    assert "pose is left out: " in said(log)


def test_a_euroc_drive(tmp_path):
    log = opened(build.euroc(tmp_path))
    assert list(log.streams) == ["cam0", "cam1", "imu0", "groundtruth", "vicon0"]
    assert log.epoch_ns == build.START
    assert log.streams["cam1"].clock == "cam0"
    assert [log.streams[n].has_scale for n in log.streams] == [False, False, False, True, True]
    camera = log.streams["cam0"].intrinsics
    np.testing.assert_array_equal(camera.K, [[45.8, 0, 36.7], [0, 45.7, 24.8], [0, 0, 1]])
    assert camera.distortion.tolist() == [-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05]
    for name in ("groundtruth", "vicon0"):
        T = log.streams[name].readings[7].T_world_sensor
        np.testing.assert_allclose(T, build.drive(30)[7], atol=1e-9)
    assert "leica0 is left out" in said(log)
    assert "positions tell neither" in said(log)
    T = log.reference.between("imu0", "cam0").T_a_b  # T_BS: from camera to body
    np.testing.assert_allclose(T @ [0, 1, 0, 1], [-1.02, -0.06, 0.01, 1])


def test_a_gyroscope_turns_as_it_says(tmp_path):
    stream = opened(build.euroc(tmp_path)).streams["imu0"]
    assert isinstance(stream.readings[1], MotionReading)
    turned = sum(r.vec[5] for r in stream.readings[1:])
    assert turned == pytest.approx(0.205 * (stream.stamps[-1] - stream.stamps[0]), rel=1e-3)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("!!python/object/apply:os.system ['touch pwned']\n", "can not be read as YAML of plain values"),
        ("T_BS: [1, 2", "can not be read as YAML"),
        (build.CAMERA_YAML.replace("1.0, 0.0, 0.0, -0.06", "2.0, 0.0, 0.0, -0.06"), "no rotation"),
        ("- 1\n", "holds no keys"),
        ("[" * 500, "can not be read as YAML"),
    ],
)
def test_a_description_that_can_not_be_used(tmp_path, text, says):
    root = build.euroc(tmp_path)
    (root / "mav0/cam0/sensor.yaml").write_text(text)
    log = opened(root)
    assert "where cam0 sits is not known" in said(log)
    assert says in said(log)
    assert not (tmp_path / "pwned").exists()


def test_a_fisheye_has_no_intrinsics(tmp_path):
    root = build.euroc(tmp_path)
    text = build.CAMERA_YAML.replace("radial-tangential", "equidistant")
    (root / "mav0/cam0/sensor.yaml").write_text(text)
    log = opened(root)
    assert log.streams["cam0"].intrinsics is None
    assert "cam0 has no intrinsics" in said(log)
    assert "equidistant" in said(log)


def test_a_lens_without_its_coefficients_has_no_intrinsics(tmp_path):
    root = build.euroc(tmp_path)
    text = build.CAMERA_YAML.replace("distortion_coefficients", "distort")
    (root / "mav0/cam0/sensor.yaml").write_text(text)
    log = opened(root)
    assert log.streams["cam0"].intrinsics is None
    assert "'distortion_coefficients' must be 4 numbers" in said(log)


@pytest.mark.parametrize("name", ["../../../../secret.png", "{root}/secret.png"])
def test_a_name_that_leaves_the_folder_is_refused(tmp_path, name):
    root = build.euroc(tmp_path / "drive")
    build.image(tmp_path / "secret.png", 0)
    file = root / "mav0/cam0/data.csv"
    file.write_text(file.read_text() + f"{build.START * 2},{name.format(root=tmp_path)}\n")
    log = opened(root)
    assert "cam0" not in log.streams
    assert "leads out of the recording" in said(log)


def test_a_link_that_leaves_the_folder_is_refused(tmp_path):
    home = build.kitti_odometry(tmp_path / "drive")
    (tmp_path / "secret.bin").write_bytes(bytes(16))
    (home / "velodyne/000001.bin").unlink()
    os.symlink(tmp_path / "secret.bin", home / "velodyne/000001.bin")
    with pytest.raises(DataError, match=r"000001.bin leads out of the recording"):
        opened(home)


def test_a_tum_drive(tmp_path):
    log = opened(build.tum(tmp_path / "rgbd_dataset_freiburg1_xyz"))
    assert list(log.streams) == ["rgb", "groundtruth"]
    camera = log.streams["rgb"].intrinsics
    assert (camera.K[0, 0], camera.K[1, 2], camera.distortion[4]) == (517.3, 255.3, 1.1633)
    assert log.streams["rgb"].readings[3].shape == (480, 640)
    later = log.streams["rgb"].stamps[0] - log.streams["groundtruth"].stamps[0]
    assert later == pytest.approx(0.175304, abs=1e-9)
    relative = se3.relative(*(log.streams["groundtruth"].readings[k].T_world_sensor for k in (0, 9)))
    np.testing.assert_allclose(relative, se3.relative(*build.drive(10)[[0, 9]]), atol=1e-8)
    assert "depth: its images" in said(log)


def test_a_tum_drive_of_no_documented_camera_says_what_to_write(tmp_path):
    log = opened(build.tum(tmp_path / "mine"))
    assert log.streams["rgb"].intrinsics is None
    assert "write a rig.toml" in said(log)


def test_images_that_are_missing_or_stamped_twice_are_counted(tmp_path):
    root = build.tum(tmp_path / "rgbd_dataset_freiburg2_desk")
    lines = (root / "rgb.txt").read_text().splitlines()
    (root / lines[4].split()[1]).unlink()
    (root / "rgb.txt").write_text("\n".join([*lines, lines[7]]) + "\n")
    log = opened(root)
    assert len(log.streams["rgb"]) == 11
    assert "1 of 13 images have no file" in said(log)
    assert "1 of 13 images whose stamps repeat" in said(log)


def test_images_that_a_list_does_not_name_are_counted(tmp_path):
    root = build.euroc(tmp_path)
    assert "images are not in" not in said(opened(root))
    rows = (root / "mav0/cam0/data.csv").read_text().splitlines()
    (root / "mav0/cam0/data.csv").write_text("\n".join(rows[:-3]) + "\n")
    assert "cam0: 3 images are not in" in said(opened(root))


LAYOUTS = {
    "kitti-odometry": lambda at: build.kitti_odometry(at, 12),
    "euroc": lambda at: build.euroc(at / "a", 12),
    "tum": lambda at: build.tum(at / "rgbd_dataset_freiburg3_a", 4),
}


@pytest.mark.parametrize("layout", LAYOUTS)
def test_forty_damaged_files(tmp_path, layout):
    assert build.damaged(LAYOUTS[layout](tmp_path), PLUGINS, 40)[0]


@pytest.mark.long
@pytest.mark.parametrize("layout", LAYOUTS)
def test_a_thousand_damaged_files(tmp_path, layout):
    assert sum(build.damaged(LAYOUTS[layout](tmp_path), PLUGINS, 1000, 1)) == 1000


def test_inspect_shows_each_in_words(tmp_path):
    for path in (build.kitti_odometry(tmp_path / "k"), build.euroc(tmp_path / "e")):
        done = CliRunner().invoke(main, ["inspect", str(path)])
        assert done.exit_code == 3, done.output
        assert "unexpected" not in done.output
