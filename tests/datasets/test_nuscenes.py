"""Recordings in nuScenes' tables: which scene, which sensors, when each point was measured."""

import json
import tracemalloc

import numpy as np
import pytest
from nuscenes_builders import BEAMS, PERIOD_US, SIZE, START_US, TURNS, K, sweep, tables, write

from calib_toolkit import DataError
from calib_toolkit_datasets.nuscenes.readings import column_times
from calib_toolkit_datasets.nuscenes.tables import read_rows


def test_a_scene_is_lidars_cameras_and_the_vehicles_poses(tmp_path, opened):
    log = opened(write(tmp_path, tables()))
    assert {n: (s.kind, len(s), s.has_scale) for n, s in log.streams.items()} == {
        "LIDAR_TOP": ("velodyne", 40, True),
        "CAM_BACK": ("monocular", 25, False),
        "CAM_FRONT": ("monocular", 25, False),
        "ego": ("odometry", 41, True),
    }
    assert log.notes == ()
    assert log.epoch_ns == START_US * 1000
    assert round(log.streams["CAM_FRONT"].stamps[7] * 1e9) == 7 * PERIOD_US["CAM_FRONT"] * 1000
    camera = log.streams["CAM_FRONT"]
    assert camera.readings[0].shape == (SIZE[1], SIZE[0], 3)
    np.testing.assert_array_equal(camera.intrinsics.K, K)
    assert camera.intrinsics.distortion.size == 0
    assert camera.intrinsics.size == SIZE
    radar = next(t for t in log.topics if t.name == "RADAR_FRONT")
    assert (radar.sensor, radar.unused) == ("", "no sensor reads a radar")
    with pytest.raises(DataError, match="no sensor reads a radar"):
        log.select(["RADAR_FRONT"])


def test_what_calibrated_sensor_says_is_the_reference(tmp_path, opened):
    """A point 10 m along the scanner's y is 10.94 m ahead of the vehicle; the camera sees along z."""
    log = opened(write(tmp_path, tables()))
    assert (log.reference.base, log.reference.names) == ("ego", ("ego", "LIDAR_TOP", "CAM_BACK", "CAM_FRONT"))
    T = log.reference.between("ego", "LIDAR_TOP").T_a_b
    np.testing.assert_allclose(T @ [0, 10, 0, 1], [10.94, 0, 1.84, 1], atol=1e-12)
    np.testing.assert_allclose(log.reference.between("ego", "CAM_FRONT").T_a_b @ [0, 0, 5, 1], [6.7, 0.01, 1.51, 1])
    assert not log.reference.determined[1:, 6].any()


def test_poses_are_those_of_the_vehicle_and_far_enough_apart(tmp_path, opened):
    ego = opened(write(tmp_path, tables())).streams["ego"]
    assert np.diff(ego.stamps).min() >= 0.045
    assert np.diff(ego.stamps).max() < 0.06
    pose = ego.readings[10].T_world_sensor
    assert pose[0, 3] == pytest.approx(400 + 10 * ego.stamps[10], abs=1e-9)
    assert np.arctan2(pose[1, 0], pose[0, 0]) == pytest.approx(0.3 * ego.stamps[10], abs=1e-9)
    assert ego.readings[10].cov is None


def test_columns_of_all_beams_tell_when_points_were_measured(tmp_path, opened):
    scan = opened(write(tmp_path, tables())).streams["LIDAR_TOP"].readings[3]
    times = scan.times.reshape(TURNS, BEAMS)
    assert np.ptp(times, axis=1).max() == 0
    np.testing.assert_allclose(times[:, 0], (np.arange(TURNS) + 0.5) / TURNS * 0.05 - 0.05, atol=1e-8)
    assert scan.ring[:40].tolist() == [*range(32), *range(8)]


@pytest.mark.parametrize(
    "ring",
    [
        np.arange(64) % 32 // 2,
        np.r_[np.arange(32), np.arange(32)[::-1]],
        np.arange(63) % 32,
        np.zeros(64),
        np.arange(32),
    ],
)
def test_points_in_another_order_have_no_times(ring):
    assert column_times(ring.astype(np.float32), 0.05) is None


def test_beams_may_fire_in_any_order_if_it_is_always_the_same():
    order = np.random.default_rng(0).permutation(32)
    assert column_times(np.tile(order, 4).astype(np.float32), 0.1)[::32].tolist() == pytest.approx(
        [-0.0875, -0.0625, -0.0375, -0.0125]
    )


def test_a_scene_is_chosen_by_its_name_behind_the_folder(tmp_path, opened):
    root = write(tmp_path / "data", tables(1.0, ("scene-0061", "scene-0103")))
    with pytest.raises(
        DataError, match=r"has 2 scenes; name one of them, as .*v1\.0-mini/scene-0061: scene-0061, scene-0103"
    ):
        opened(root)
    for path in (root / "scene-0103", root / "v1.0-mini" / "scene-0103"):
        log = opened(path)
        assert log.epoch_ns == (START_US + 100_000_000) * 1000
        assert len(log.streams["LIDAR_TOP"]) == 20
    with pytest.raises(DataError, match="0 scenes called 'scene-9'; there are: scene-0061, scene-0103"):
        opened(root / "scene-9")
    with pytest.raises(DataError, match="does not exist"):
        opened(tmp_path / "dada" / "scene-0061")


def test_one_of_several_versions_must_be_named(tmp_path, opened):
    root = write(tmp_path, tables(1.0))
    write(tmp_path, tables(1.0), "v1.0-test", files=False)
    with pytest.raises(
        DataError, match=r"2 folders v1\.0-\* with a scene\.json \(v1\.0-mini, v1\.0-test\); name one"
    ):
        opened(root)
    assert len(opened(root / "v1.0-test").streams) == 4


def test_missing_files_are_counted_and_a_sensor_without_any_is_listed(tmp_path, opened):
    root = write(tmp_path, tables())
    for file in sorted((root / "sweeps/CAM_FRONT").iterdir())[:3]:
        file.unlink()
    for file in (root / "sweeps/CAM_BACK").iterdir():
        file.unlink()
    next((root / "samples/CAM_BACK").iterdir()).unlink()
    log = opened(root)
    assert len(log.streams["CAM_FRONT"]) == 22
    assert "3 of 25 files are missing, the first is" in log.streams["CAM_FRONT"].notes[0]
    assert next(t.unused for t in log.topics if t.name == "CAM_BACK") == "none of its files is there"


def test_rows_may_lie_in_any_order_and_stamps_of_zero_or_twice_are_left_out(tmp_path, opened):
    made = tables()
    lidar = [r for r in made["sample_data"] if r["filename"].startswith(("samples/LIDAR", "sweeps/LIDAR"))]
    lidar[4]["timestamp"], lidar[9]["timestamp"] = 0, lidar[8]["timestamp"]
    made["sample_data"] = made["sample_data"][::-1]
    stream = opened(write(tmp_path, made)).streams["LIDAR_TOP"]
    assert len(stream) == 38
    assert stream.notes == ("LIDAR_TOP: 2 of 40 readings without a stamp of their own are left out",)


def test_without_poses_the_rest_is_read(tmp_path, opened):
    made = tables()
    for row in made["sample_data"]:
        del row["ego_pose_token"]
    log = opened(write(tmp_path, made))
    assert "ego" not in log.streams
    assert "names an ego pose" in log.notes[0]


def test_a_camera_with_a_distortion_keeps_it_and_a_fisheye_has_no_intrinsics(tmp_path, opened):
    made = tables(1.0)
    made["calibrated_sensor"][1]["camera_distortion"] = [-0.3, 0.1, 0, 0, 0]
    made["calibrated_sensor"][2]["camera_distortion"] = [-0.3, 0.1, 0, 0]
    log = opened(write(tmp_path, made))
    assert log.streams["CAM_FRONT"].intrinsics.distortion.tolist() == [-0.3, 0.1, 0, 0, 0]
    assert log.streams["CAM_BACK"].intrinsics is None
    assert "4 numbers is no pinhole camera's" in log.streams["CAM_BACK"].notes[0]


def test_tables_are_read_row_by_row(tmp_path):
    file = tmp_path / "sample_data.json"
    rows = [{"token": f"{k:032x}", "timestamp": k, "filename": "é" * 200} for k in range(12_000)]
    file.write_text(json.dumps(rows, ensure_ascii=False, indent=0), encoding="utf-8")
    tracemalloc.start()
    try:
        total = sum(row.values["timestamp"] for row in read_rows(file))
        assert tracemalloc.get_traced_memory()[1] < 10_000_000
    finally:
        tracemalloc.stop()
    assert total == sum(range(12_000))
    assert [r.number for r in read_rows(file)][-1] == 11_999


def test_a_stamp_that_is_a_float_keeps_what_it_has_below_a_microsecond(tmp_path, opened):
    made = tables(1.0)
    for row in made["sample_data"]:
        row["timestamp"] = float(row["timestamp"]) + 0.25
    log = opened(write(tmp_path, made))
    assert log.streams["LIDAR_TOP"].stamps[0] == pytest.approx(250e-9, abs=1e-12)


def test_an_open_scan_is_the_one_on_disk(tmp_path, opened):
    root = write(tmp_path, tables(1.0))
    rows = sweep(np.random.default_rng(9))
    next((root / "samples/LIDAR_TOP").iterdir()).write_bytes(rows.tobytes())
    scan = opened(root).streams["LIDAR_TOP"].readings[0]
    np.testing.assert_array_equal(scan.points, rows[:, :3])
    np.testing.assert_array_equal(scan.intensity, rows[:, 3])
