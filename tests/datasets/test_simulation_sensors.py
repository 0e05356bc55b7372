"""Simulated lidar and INS against geometry that is known exactly, and the clocks of the rigs."""

from dataclasses import replace

import numpy as np
import pytest

from calib_toolkit import Stream, se3
from calib_toolkit_datasets import kitti_files
from calib_toolkit_datasets.simulation import earth, ins, lidar, rigs
from calib_toolkit_datasets.simulation.camera import CameraModel
from calib_toolkit_datasets.simulation.ins import InsModel, fixes
from calib_toolkit_datasets.simulation.lidar import VELODYNE_16, VELODYNE_64, sweep
from calib_toolkit_datasets.simulation.surfaces import MATERIALS, Hits
from calib_toolkit_datasets.simulation.vehicle import path

HALF = np.array([40.0, 25.0, 6.0])
PLAIN = replace(VELODYNE_16, columns=720, range_sigma=0.0, dropout=0.0)


class Box:
    """The inside of a box around the world's origin."""

    def __init__(self, material="concrete"):
        self.material = MATERIALS.index(material)

    def cast(self, origins, directions, stamps):
        d = np.where(np.abs(directions) < 1e-12, 1e-12, directions)
        to_walls = (np.sign(d) * HALF - origins) / d
        rows, axis = np.arange(len(d)), to_walls.argmin(axis=1)
        distance = to_walls[rows, axis]
        normal = np.zeros_like(d)
        normal[rows, axis] = -np.sign(d[rows, axis])
        position = origins + distance[:, None] * d
        tone = np.full(len(d), 0.5)
        arrays = (x.astype(np.float32) for x in (distance, position, normal, normal))
        return Hits(*arrays, np.full(len(d), self.material, np.uint8), tone.astype(np.float32))


def off_walls(points):
    """How far each point is from the nearest wall."""
    return np.abs(np.abs(points) - HALF).min(axis=1)


@pytest.fixture(scope="module")
def street():
    return path(3.0, 4, "street")


def mounted(yaw=0.0):
    return se3.matrix([0.3, -0.2, 1.7, 0.01, -0.02, yaw])


def test_a_still_sweep_shows_the_walls_and_as_many_points_as_rays():
    still = path(1.0, 1, "static")
    T = still.at(np.array([0.5]))[0] @ mounted(yaw=0.3)
    scan = sweep(PLAIN, Box(), still, mounted(yaw=0.3), 0.5, np.random.default_rng(0))
    assert len(scan.points) > 0.95 * PLAIN.rays
    assert off_walls(scan.points @ T[:3, :3].T + T[:3, 3]).max() < 1e-4


@pytest.mark.parametrize(
    ("name", "beams", "low", "high"),
    [("16", 16, -15, 15), ("32", 32, -30.67, 10.67), ("64", 64, -24.33, 2), ("128", 128, -25, 15)],
)
def test_rings_are_the_beams_from_the_lowest_up(name, beams, low, high):
    model = replace(getattr(lidar, f"VELODYNE_{name}"), columns=90, dropout=0.0, range_sigma=0.0)
    scan = sweep(model, Box(), path(1.0, 1, "static"), mounted(), 0.5, np.random.default_rng(0))
    elevation = np.degrees(np.arctan2(scan.points[:, 2], np.hypot(*scan.points[:, :2].T)))
    assert np.abs(elevation - np.degrees(model.elevations)[scan.ring]).max() < 1e-3
    assert len(model.elevations) == beams
    assert np.degrees(model.elevations)[[0, -1]] == pytest.approx([low, high], abs=0.01)
    assert np.all(np.diff(model.elevations) > 0)


def test_the_64_beams_are_two_blocks_of_lasers_and_make_a_scan_as_large_as_a_real_one():
    steps = np.degrees(np.diff(VELODYNE_64.elevations))
    assert steps[:31] == pytest.approx(0.5, abs=1e-9)
    assert steps[32:] == pytest.approx(1 / 3, abs=1e-9)
    assert 115_000 < VELODYNE_64.rays < 125_000


def test_times_follow_azimuth_as_kittis_do(street):
    scan = sweep(PLAIN, Box(), street, mounted(), 1.2, np.random.default_rng(0))
    assert scan.times == pytest.approx(kitti_files.sweep_times(scan.points, 1 / PLAIN.rate), abs=1e-6)
    left = scan.points[:, 1] > 5
    assert np.all(scan.times[left] < 0)  # clockwise: the left side comes before the front


def test_a_sweep_is_bent_by_the_motion_and_the_true_path_straightens_it(street):
    T, stamp = mounted(yaw=-0.4), 1.7
    scan = sweep(PLAIN, Box(), street, T, stamp, np.random.default_rng(0))
    poses = street.at(stamp + scan.times.astype(float)) @ T
    assert (
        np.linalg.norm(street.at(np.array([stamp + 0.05]))[0][:3, 3] - street.at(np.array([stamp]))[0][:3, 3]) > 0.2
    )
    straight = np.einsum("nij,nj->ni", poses[:, :3, :3], scan.points) + poses[:, :3, 3]
    assert off_walls(straight).max() < 1e-3
    T_mid = (street.at(np.array([stamp])) @ T)[0]
    assert off_walls(scan.points @ T_mid[:3, :3].T + T_mid[:3, 3]).max() > 0.1


def test_range_noise_is_along_the_ray_and_as_large_as_said():
    model = replace(PLAIN, range_sigma=0.03)
    still = path(1.0, 1, "static")
    noisy = sweep(model, Box(), still, mounted(), 0.5, np.random.default_rng(3))
    clean = sweep(PLAIN, Box(), still, mounted(), 0.5, np.random.default_rng(3))
    assert np.array_equal(noisy.ring, clean.ring)
    a, b = (np.linalg.norm(s.points.astype(float), axis=1) for s in (noisy, clean))
    assert (a - b).std() == pytest.approx(0.03, rel=0.03)
    assert noisy.points / a[:, None] == pytest.approx(clean.points / b[:, None], abs=1e-6)


def test_returns_are_lost_at_random_from_glass_and_beyond_the_range():
    def count(model, material="concrete"):
        scan = sweep(model, Box(material), path(1.0, 1, "static"), mounted(), 0.5, np.random.default_rng(0))
        return len(scan.points) / model.rays

    assert count(replace(PLAIN, dropout=0.2)) == pytest.approx(0.8 * count(PLAIN), abs=0.02)
    assert count(PLAIN, "glass") < 0.15
    near = replace(PLAIN, max_range=28.0)
    scan = sweep(near, Box(), path(1.0, 1, "static"), mounted(), 0.5, np.random.default_rng(0))
    assert np.linalg.norm(scan.points, axis=1).max() <= 28.0001
    assert count(near) < 0.9 * count(PLAIN)


def test_intensity_is_eight_bit_and_tells_materials_apart():
    def level(material):
        scan = sweep(PLAIN, Box(material), path(1.0, 1, "static"), mounted(), 0.5, np.random.default_rng(0))
        steps = scan.intensity * 255
        assert np.abs(steps - np.round(steps)).max() < 1e-4
        assert scan.intensity.min() >= 0
        assert scan.intensity.max() <= 1
        return np.median(scan.intensity)

    assert level("asphalt") < 0.7 * level("plaster")


def test_the_same_seed_gives_the_same_sweep(street):
    a, b, c = (sweep(VELODYNE_16, Box(), street, mounted(), 1.0, np.random.default_rng(s)) for s in (1, 1, 2))
    assert np.array_equal(a.points, b.points)
    assert np.array_equal(a.intensity, b.intensity)
    assert len(a.points) != len(c.points) or not np.array_equal(a.points, c.points)


@pytest.mark.parametrize(
    "place", [(49.0, 8.4, 115.0), (-33.9, 151.2, -20.0), (0.0, 180.0, 3000.0), (89.0, -60.0, 0.0)]
)
def test_geodetic_and_earth_fixed_positions_are_each_others_inverse(place):
    geodetic = np.array([np.radians(place[0]), np.radians(place[1]), place[2]])
    back = earth.geodetic(earth.ecef(geodetic))
    assert np.linalg.norm(earth.ecef(back) - earth.ecef(geodetic)) < 2e-9
    assert back[:2] == pytest.approx(geodetic[:2], abs=1e-14)


QUIET = InsModel(sigma=(0.0,) * 6, white=(0.0,) * 6)


def test_the_reader_of_fixes_finds_the_true_motion_when_there_is_no_noise():
    from calib_toolkit_plugins import gps_ins

    drive, T = path(20.0, 2, "street"), mounted(yaw=3.1)
    stamps = np.arange(0.0, 20.0, 0.1)
    made = fixes(QUIET, drive, T, stamps, np.random.default_rng(0))
    poses = gps_ins.estimate(Stream("ins", "gps_ins", stamps, made), gps_ins.GpsInsOptions()).T_world_sensor
    true = drive.at(stamps) @ T
    found, wanted = (se3.vector(se3.relative(p[:1], p)) for p in (poses, true))
    assert found == pytest.approx(wanted, abs=1e-6)
    assert np.linalg.norm(wanted[-1, :3]) > 50


def noise_of(model, stamps, seed=0):
    """(n, 6) errors of position east, north, up and of attitude that a model makes."""
    drive = path(float(max(stamps[-1], 1.0)), 1, "static")
    made, ideal = (fixes(m, drive, np.eye(4), stamps, np.random.default_rng(seed)) for m in (model, QUIET))
    place, true = (earth.ecef(np.array([[f.lat, f.lon, f.alt] for f in x])) for x in (made, ideal))
    turned, level = (np.array([[f.roll, f.pitch, f.yaw] for f in x]) for x in (made, ideal))
    return np.column_stack([(place - true) @ earth.enu_axes(ins.ORIGIN), turned - level]), made


def test_fixes_err_by_what_they_state_and_the_error_wanders_slowly():
    model = InsModel(sigma=(0.03, 0.04, 0.05, 3e-4, 3e-4, 1e-3), correlation=0.2, white=(0.0,) * 6)
    stamps = np.arange(0.0, 60.0, 0.01)
    error, made = noise_of(model, stamps)
    assert error.std(axis=0) == pytest.approx(np.array(model.sigma), rel=0.2)
    assert made[7].sigma_position == pytest.approx(model.sigma[:3])
    assert made[7].sigma_rpy == pytest.approx(model.sigma[3:])
    scaled = error / model.sigma
    coefficient = np.mean(scaled[1:] * scaled[:-1], axis=0) / np.mean(scaled**2, axis=0)
    assert coefficient == pytest.approx(np.exp(-1 / 20), abs=0.015)
    assert np.diff(scaled, axis=0).std(axis=0) == pytest.approx(np.sqrt(2 - 2 * np.exp(-1 / 20)), rel=0.05)


def test_white_noise_and_bias_are_as_asked_for():
    model = replace(QUIET, white=(0.01, 0.01, 0.02, 1e-4, 1e-4, 2e-4), bias=(1.0, -2.0, 0.5, 0.01, -0.02, 0.03))
    error, _ = noise_of(model, np.arange(0.0, 40.0, 0.01))
    assert error.mean(axis=0) == pytest.approx(model.bias, abs=2e-3)
    assert error.std(axis=0) == pytest.approx(model.white, rel=0.1)


def test_the_position_drifts_in_an_outage_and_says_so_and_leaps_in_a_jump():
    model = replace(QUIET, outages=((10.0, 30.0),), jumps=((50.0, (0.0, 0.7, 0.0)),))
    error, made = noise_of(model, np.arange(0.0, 60.0, 1.0))
    assert np.abs(error[:11, :3]).max() < 1e-6
    assert 0.05 < np.linalg.norm(error[29, :3]) < 10
    assert made[29].sigma_position == pytest.approx(19 * ins.OUTAGE_DRIFT)
    assert np.abs(error[30:50, :3]).max() < 1e-6
    assert error[50:, :3] == pytest.approx(np.tile([0.0, 0.7, 0.0], (10, 1)), abs=1e-6)


@pytest.mark.parametrize("kind", rigs.RIGS)
def test_stamps_lead_back_to_the_instants_of_the_readings(kind):
    for sensor in rigs.RIGS[kind](5).sensors:
        ns = sensor.stamps(300.0, 5)
        at = sensor.instants(ns)
        assert np.abs(at - (at[0] + np.arange(len(at)) / sensor.rate)).max() < 1.01e-9
        assert 0 <= at[0] < 1 / sensor.rate
        assert 300.0 - 1 / sensor.rate - 1e-9 <= at[-1] < 300.0
        assert ns.dtype == np.int64


@pytest.mark.parametrize("kind", rigs.RIGS)
def test_the_truth_leads_from_any_sensors_stamps_to_the_bases(kind):
    rig, late = rigs.RIGS[kind](6), 0.4
    truth, at = rigs.truth(rig, t_ref=-late), np.array([0.0, 50.0, 3000.0])
    clocks = np.array([(at - s.dt) / (1 + s.skew) for s in rig.sensors]) - late  # stamps of a log that begins so late
    for i, name in enumerate(truth.names):
        base = clocks[i] + truth.dt_base_sensor[i] + truth.clock_skew[i] * (clocks[i] - truth.t_ref)
        assert base == pytest.approx(clocks[0] if name != truth.base else clocks[i], abs=1e-9)
        T = rig.sensors[0].T_vehicle_sensor @ truth.T_base_sensor[i]
        assert pytest.approx(rig.sensors[i].T_vehicle_sensor, abs=1e-12) == T


def test_every_seed_is_another_vehicle_and_the_same_seed_the_same():
    for make in rigs.RIGS.values():
        a, b, c = (rigs.truth(make(seed), 0.0) for seed in (1, 1, 2))
        assert np.array_equal(a.T_base_sensor, b.T_base_sensor)
        moved = np.linalg.norm(a.T_base_sensor[1:, :3, 3] - c.T_base_sensor[1:, :3, 3], axis=1)
        assert np.all((moved > 1e-3) & (moved < 0.3))
        assert np.all(a.dt_base_sensor[1:] != c.dt_base_sensor[1:])


def test_kittis_cameras_are_triggered_together_and_two_of_them_stamp_early():
    rig = rigs.kitti(3)
    cameras = [s for s in rig.sensors if isinstance(s.model, CameraModel)]
    ns = np.array([s.stamps(10.0, 3) for s in cameras])
    assert (ns[0] - ns) / 1e6 == pytest.approx(np.array([[0.0], [0.0], [6.14], [6.70]]) + 0 * ns, abs=1e-5)


def test_one_clock_of_the_fleet_car_runs_fast_or_slow():
    assert sorted({abs(s.skew) for s in rigs.fleet_car(1).sensors}) == [0.0, 20e-6]


def test_synced_cameras_are_rectified_in_a_row_and_share_all_instants():
    rig = rigs.synced(rigs.kitti(3))
    stamps = [tuple(s.stamps(5.0, 3)) for s in rig.sensors]
    assert len(set(stamps)) == 1
    assert {s.dt for s in rig.sensors} == {0.0}
    cameras = [s for s in rig.sensors if isinstance(s.model, CameraModel)]
    for camera in cameras:
        offset = se3.relative(cameras[0].T_vehicle_sensor, camera.T_vehicle_sensor)
        assert offset[:3, :3] == pytest.approx(np.eye(3))
        assert offset[1:3, 3] == pytest.approx(0.0, abs=1e-12)
        assert camera.model.intrinsics.distortion.size == 0
