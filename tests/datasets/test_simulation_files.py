"""Simulated drives on disk: the real readers find every sensor, and the truth."""

from dataclasses import replace

import numpy as np
import pytest
from simulated_files import SECONDS, wish

from calib_toolkit import open_log, read_calibration, se3
from calib_toolkit.progress import Silent
from calib_toolkit_datasets.simulation import rigs, vehicle, writing
from calib_toolkit_datasets.simulation.camera import CameraModel
from calib_toolkit_datasets.simulation.ins import InsModel
from calib_toolkit_datasets.simulation.lidar import LidarModel
from calib_toolkit_datasets.simulation.writing import write


def true_poses(w, sensor, stamps):
    return vehicle.path(w.seconds, w.seed, w.drive).at(stamps) @ sensor.T_vehicle_sensor


@pytest.mark.parametrize("rig", rigs.RIGS)
def test_the_readers_find_every_sensor_with_its_kind_its_stamps_and_its_lens(quick, tmp_path, rig):
    write(tmp_path, wish(rig), Silent(), 1)
    log, made = open_log(tmp_path), rigs.RIGS[rig](3)
    assert set(log.streams) == {s.name for s in made.sensors}
    for s in made.sensors:
        stream, ns = log.streams[s.name], s.stamps(SECONDS, 3)
        assert stream.kind == s.kind
        assert stream.notes == ()
        unix_ns = np.round(stream.stamps * 1e9).astype(np.int64) + log.epoch_ns
        assert np.abs(unix_ns - rigs.START_NS - ns).max() <= 1
        assert stream.has_scale != isinstance(s.model, CameraModel)
        if isinstance(s.model, CameraModel):
            lens = s.model.intrinsics
            assert pytest.approx(lens.K, abs=1e-6) == stream.intrinsics.K
            assert stream.intrinsics.distortion == pytest.approx(lens.distortion, abs=1e-9)
            assert stream.intrinsics.size == lens.size
            assert stream.readings[1].shape == ((*lens.size[::-1], 3) if s.model.colour else lens.size[::-1])
        elif isinstance(s.model, LidarModel):
            scan, instants = stream.readings[2], s.instants(ns)
            assert scan.points[:, 2] == pytest.approx(instants[2], abs=1e-6)
            turns = -np.arctan2(scan.points[:, 1], scan.points[:, 0]) / (2 * np.pi * s.model.rate)
            assert scan.times == pytest.approx(turns, abs=1e-6)
            assert scan.intensity == pytest.approx(0.25)


@pytest.mark.parametrize("rig", rigs.RIGS)
def test_the_reference_of_the_log_is_the_truth(quick, tmp_path, rig):
    write(tmp_path, wish(rig), Silent(), 1)
    log, made = open_log(tmp_path), rigs.RIGS[rig](3)
    truth = read_calibration(tmp_path / "truth.json")
    assert np.array_equal(truth.T_base_sensor, log.reference.T_base_sensor)
    assert truth.base == made.sensors[0].name
    assert np.all(truth.determined)
    for i, s in enumerate(made.sensors):
        assert truth.T_base_sensor[i] == pytest.approx(
            se3.relative(made.sensors[0].T_vehicle_sensor, s.T_vehicle_sensor), abs=1e-12
        )
        at = s.instants(s.stamps(SECONDS, 3))
        stamps = log.streams[s.name].stamps
        in_base = stamps + truth.dt_base_sensor[i] + truth.clock_skew[i] * (stamps - truth.t_ref)
        base_clock = (at - made.sensors[0].dt) / (1 + made.sensors[0].skew) + truth.t_ref
        assert in_base == pytest.approx(base_clock, abs=3e-9)


@pytest.mark.parametrize("rig", ["kitti", "shrimp"])
def test_fixes_come_back_through_files_as_they_were_made(quick, monkeypatch, tmp_path, rig):
    from calib_toolkit_plugins import gps_ins

    silent = InsModel(white=(0.0,) * 6, bias=(0.0,) * 6, correlation=1e12)  # a constant error is none in motion

    def noiseless(seed):
        made = rigs_before[rig](seed)
        return replace(made, sensors=tuple(replace(s, model=silent) if s.name == "ins" else s for s in made.sensors))

    rigs_before = dict(rigs.RIGS)
    monkeypatch.setitem(rigs.RIGS, rig, noiseless)
    writing._rig.cache_clear()
    write(tmp_path, wish(rig), Silent(), 1)
    writing._rig.cache_clear()
    stream, sensor = open_log(tmp_path).streams["ins"], noiseless(3).sensor("ins")
    T = gps_ins.estimate(stream, gps_ins.GpsInsOptions()).T_world_sensor
    true = true_poses(wish(rig), sensor, sensor.instants(sensor.stamps(SECONDS, 3)))
    found, wanted = (se3.relative(p[:1], p) for p in (T, true))
    # a constant error of the heading turns the whole drive
    assert np.linalg.norm(found[:, :3, 3], axis=1) == pytest.approx(
        np.linalg.norm(wanted[:, :3, 3], axis=1), abs=1e-5
    )
    assert se3.vector(found)[:, 3:] == pytest.approx(se3.vector(wanted)[:, 3:], abs=1e-4)
    assert stream.readings[0].sigma_position == pytest.approx(
        0.0370 if rig == "kitti" else silent.sigma[:3], abs=6e-3
    )


def test_oxts_states_the_true_velocities_accelerations_and_turn_rates(quick, tmp_path):
    circle = wish(drive="turn")
    write(tmp_path, circle, Silent(), 1)
    (folder,) = tmp_path.glob("*_extract/oxts/data")
    rows = np.array([[float(x) for x in f.read_text().split()] for f in sorted(folder.iterdir())])
    assert rows.shape == (200, 30)
    sensor = rigs.kitti(3).sensor("ins")
    poses = true_poses(circle, sensor, sensor.instants(sensor.stamps(SECONDS, 3)))
    middle = sensor.T_vehicle_sensor[:2, 3] - [0.0, 6.0 / 0.3]  # of the circle, whose centre is 20 m to the left
    around = 0.3 * np.linalg.norm(middle)
    assert np.hypot(rows[:, 6], rows[:, 7]) == pytest.approx(around, abs=1e-4)
    assert np.hypot(rows[:, 8], rows[:, 9]) == pytest.approx(around, abs=1e-4)
    there = np.diff(poses[:, :2, 3], axis=0) / 0.01
    assert (rows[:-1, [7, 6]] + rows[1:, [7, 6]]) / 2 == pytest.approx(there, abs=1e-3)  # east, north
    assert rows[:, 8] / around == pytest.approx(1.0, abs=0.01)  # forward
    assert np.linalg.norm(rows[:, 11:14], axis=1) == pytest.approx(np.hypot(9.81, 0.3 * around), abs=1e-2)
    assert rows[:, 15] == pytest.approx(0.3 * around, abs=0.1)  # to the left, towards the centre
    assert rows[:, 20:23] == pytest.approx(np.tile([0.0, 0.0, 0.3], (200, 1)), abs=0.01)
    assert np.linalg.norm(rows[:, 17:20], axis=1) == pytest.approx(0.3, abs=1e-4)


def test_the_sync_layout_is_rectified_and_on_one_clock(quick, tmp_path):
    write(tmp_path, wish(layout="sync"), Silent(), 1)
    log = open_log(tmp_path)
    assert len({tuple(s.stamps) for s in log.streams.values()}) == 1
    assert log.streams["cam2"].intrinsics.distortion.size == 0
    assert np.array_equal(log.streams["cam2"].intrinsics.K, rigs.RECTIFIED.K)
    assert not np.any(log.reference.dt_base_sensor)
    assert np.all(log.reference.determined)
    calib = (tmp_path / "calib_cam_to_cam.txt").read_text()
    P = {line[:9]: line.split()[1:] for line in calib.splitlines()}["P_rect_03"]
    T_cam0_cam3 = log.reference.between("cam0", "cam3").T_a_b
    assert float(P[3]) == pytest.approx(-rigs.RECTIFIED.K[0, 0] * T_cam0_cam3[0, 3], abs=1e-6)


def test_the_trajectory_is_the_vehicles_true_path(quick, tmp_path):
    write(tmp_path, wish("shrimp"), Silent(), 1)
    rows = np.loadtxt(tmp_path / "trajectory.txt")
    assert len(rows) == SECONDS * 100
    at = rows[:, 0] - rigs.START_NS / 1e9
    w = wish("shrimp")
    poses = vehicle.path(w.seconds, w.seed, w.drive).at(np.round(at, 2))
    assert rows[:, 1:4] == pytest.approx(poses[:, :3, 3], abs=1e-9)
