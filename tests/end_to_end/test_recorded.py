"""The paper's own recordings and others' drives: what was measured once stays so, within a margin."""

import json
from pathlib import Path

import numpy as np
import pytest

from calib_toolkit import Config, calibrate_motions, open_log, se3
from calib_toolkit.pipeline import calibrate, clock_offsets, sensor_motions
from calib_toolkit.plugins import registry
from calib_toolkit.progress import Silent

KITTI_OFFSETS = np.array([0.0, 0.0, 6.14e-3, 6.70e-3])
"""Of the cameras' clocks against camera 0's: triggered together, their stamps differ by so many seconds."""


@pytest.fixture(scope="session")
def motions(recordings):
    """Every sensor's motion of one of the paper's drives."""
    read = {}

    def motions(rig, *names):
        if rig not in read:
            log = open_log(recordings / "multi-array-calib" / rig)
            moved = sensor_motions(log, Config(jobs=1), registry(), Silent(), Path("unused"))
            read[rig] = {n: m.motions for n, m in moved.items()}
        return {n: read[rig][n] for n in names} if names else read[rig]

    return motions


@pytest.fixture(scope="session")
def truth(recordings):
    """The author's ground truth as (4, 4) poses."""
    stored = json.loads((recordings / "multi-array-calib/ground_truth.json").read_text())
    poses = {k: se3.matrix(v) for k, v in stored["kitti_2011_10_03"].items()}
    poses["shrimp"] = se3.matrix(stored["shrimp_velNav"])
    poses["ladybug"] = se3.matrix(stored["shrimp_ladybug_cam_to_body_6vec"])
    return poses


def section(motions, start, seconds):
    """The part of each that begins ``start`` seconds into what all share."""
    first = max(m.start[0] for m in motions.values()) + start
    return {n: m[(m.start >= first) & (m.end <= first + seconds)] for n, m in motions.items()}


def angle_deg(R):
    return np.degrees(np.linalg.norm(se3.log_so3(R), axis=-1))


# median and worst, ms; measured: 0.14 and 0.96 by the paper's method, 0.18 and 0.96 by the joint estimator
@pytest.mark.parametrize(
    ("method", "usual", "worst"), [pytest.param("paper", 0.2, 1.3, marks=pytest.mark.long), ("joint", 0.25, 1.3)]
)
def test_kitti_cameras_shifted_by_up_to_a_second_are_found(motions, method, usual, worst):
    """From 100 s the author's program came within 8.1 ms, as the median."""
    errors = []
    for start in (20.0, 180.0, 330.0):
        cameras = section(motions("kitti", "cam0", "cam1", "cam2", "cam3"), start, 100)
        applied = np.concatenate([[0.0], np.random.default_rng(int(start)).uniform(-1, 1, 3)])
        shifted = {n: m.shifted(d) for (n, m), d in zip(cameras.items(), applied, strict=True)}
        found = clock_offsets(shifted, Config(method=method))
        assert found.determined[:, 6].all()
        errors += (1e3 * np.abs(found.dt_base_sensor + applied - KITTI_OFFSETS)[1:]).tolist()
    assert np.median(errors) < usual
    assert max(errors) < worst


@pytest.mark.long
def test_ladybug_heads_shifted_by_up_to_a_second_are_found(motions):
    errors = []
    for start in (100.0, 300.0):
        heads = section(motions("shrimp", *(f"cam{i}" for i in range(5))), start, 200)
        applied = np.concatenate([[0.0], np.random.default_rng(int(start)).uniform(-1, 1, 4)])
        shifted = {n: m.shifted(d) for (n, m), d in zip(heads.items(), applied, strict=True)}
        found = calibrate_motions(shifted, Config()).stages["timing"]
        errors += (1e3 * np.abs(found.dt_base_sensor + applied)[1:]).tolist()
    # measured, ms: median 0.30, worst 0.46
    assert np.median(errors) < 0.4
    assert max(errors) < 0.6


@pytest.mark.parametrize("start", [60.0, 240.0, 420.0])
def test_shrimp_ins_against_velodyne_by_the_papers_method(motions, truth, start):
    part = section(motions("shrimp", "velo", "ins"), start, 150)
    c = calibrate_motions(part, Config(method="paper")).calibration
    T = c.between("velo", "ins").T_a_b
    assert c.determined[1, 3:].all()
    # measured: 1.44, 1.18, 1.25 degrees; 0.15, 0.11 m and position undetermined; -18.9, -20.9, -18.5 ms
    assert angle_deg(truth["shrimp"][:3, :3].T @ T[:3, :3]) < 1.8
    error = np.where(c.determined[1, :3], T[:3, 3] - truth["shrimp"][:3, 3], 0.0)
    assert np.linalg.norm(error) < 0.2
    assert c.dt_base_sensor[1] == pytest.approx(-0.0203, abs=0.0035)


@pytest.mark.parametrize("start", [60.0, *(pytest.param(s, marks=pytest.mark.long) for s in (240.0, 420.0))])
def test_shrimp_ins_against_velodyne(motions, truth, start):
    """All but the yaw and the height is as the author gives it; what of those two is his own error is not known."""
    c = calibrate_motions(section(motions("shrimp", "velo", "ins"), start, 150), Config()).calibration
    T = c.between("velo", "ins").T_a_b
    assert c.determined[1].all()
    # measured: 1.25, 1.07, 1.30 degrees, of which 0.43, 0.28, 0.42 are roll and pitch
    turned = np.degrees(se3.log_so3(truth["shrimp"][:3, :3] @ T[:3, :3].T))
    assert np.linalg.norm(turned) < 1.6
    assert np.linalg.norm(turned[:2]) < 0.55
    # measured, m: 0.06, 0.04, 0.12 in the plane, 0.26, 0.18, 0.04 in height; -19.0, -19.1, -17.9 ms
    error = T[:3, 3] - truth["shrimp"][:3, 3]
    assert np.linalg.norm(error[:2]) < 0.15
    assert abs(error[2]) < 0.34
    assert c.dt_base_sensor[1] == pytest.approx(-0.0185, abs=0.001)


# measured, degrees: 1.55, 1.39, 2.56 by the paper's method; 1.46, 1.35, 1.86 by the joint estimator
@pytest.mark.parametrize(("method", "most"), [pytest.param("paper", 2.3, marks=pytest.mark.long), ("joint", 1.8)])
def test_ladybug_heads_from_half_a_minute(motions, truth, method, most):
    """The author's program: 1.69 degrees for all heads together."""
    names, true = [f"cam{i}" for i in range(5)], truth["ladybug"][:, :3, :3]
    x, y = np.triu_indices(5, 1)
    means = []
    for start in (100.0, 200.0, 300.0):
        part = section(motions("shrimp", *names), start, 30)
        c = calibrate_motions(part, Config(method=method), clocks=["ladybug"] * 5).calibration
        assert not c.dt_base_sensor.any()  # one clock
        assert not c.determined[1:, :3].any()  # no sensor knows distances
        R = c.T_base_sensor[:, :3, :3]
        apart = np.swapaxes(np.swapaxes(R[x], 1, 2) @ R[y], 1, 2) @ np.swapaxes(true[x], 1, 2) @ true[y]
        means.append(angle_deg(apart).mean())
    assert np.mean(means) < most


@pytest.mark.long
def test_kitti_velodyne_and_four_cameras_over_the_whole_drive_by_the_papers_method(recordings, truth):
    config = Config(method="paper", jobs=1)
    c = calibrate(open_log(recordings / "multi-array-calib/kitti"), config).calibration
    assert (c.base, c.names) == ("velo", ("velo", "cam0", "cam1", "cam2", "cam3"))
    assert c.determined[:, 3:].all()
    for i in range(1, 5):
        error = truth[f"velCam{i}"][:3, :3].T @ c.T_base_sensor[i, :3, :3]
        # measured: 0.29, 0.15, 0.33, 0.07 degrees; ahead 0.02 to 0.07 m
        assert angle_deg(error) < 0.5
        assert abs(c.T_base_sensor[i, 0, 3] - truth[f"velCam{i}"][0, 3]) < 0.1
    offsets = 1e3 * (c.dt_base_sensor[1:] - c.dt_base_sensor[1] - KITTI_OFFSETS)
    # measured, ms: 0.17, 0.45, 0.38
    assert np.abs(offsets).max() < 0.6


@pytest.mark.long
def test_kitti_velodyne_and_four_cameras_over_the_whole_drive(motions, truth):
    """Turns and travel of the stored velodyne disagree by half a degree, which is told; yaw and height bear it."""
    result = calibrate_motions(motions("kitti"), Config())
    c = result.calibration
    assert c.names == ("velo", "cam0", "cam1", "cam2", "cam3")
    assert c.determined.all()
    for i in range(1, 5):
        turned = np.degrees(se3.log_so3(truth[f"velCam{i}"][:3, :3] @ c.T_base_sensor[i, :3, :3].T))
        error = c.T_base_sensor[i, :3, 3] - truth[f"velCam{i}"][:3, 3]
        # measured, degrees: at most 0.05 of roll, 0.36 of pitch, 0.42 of yaw
        assert abs(turned[0]) < 0.15
        assert np.abs(turned[1:]).max() < 0.6
        assert np.all(np.abs(turned) < 2 * np.degrees(c.sigma[i, 3:6]))
        # measured, m: -0.08 ahead; at most 0.13 to the side; 0.23 to 0.29 up
        assert np.abs(error[:2]).max() < 0.17
        assert abs(error[2]) < 0.38
        # measured: 0.52 to 0.56 degrees
        assert 0.4 < result.statistics["bias_deg"][f"cam{i - 1}"] < 0.7
    # what the velodyne's fault leaves open is not open between cameras
    assert np.degrees(np.sqrt(np.diag(c.between("cam0", "cam3").cov)[3:6])).max() < 0.1
    offsets = 1e3 * (c.dt_base_sensor[1:] - c.dt_base_sensor[1] - KITTI_OFFSETS)
    # measured, ms: -0.10, 0.08, 0.05
    assert np.abs(offsets).max() < 0.2


@pytest.fixture
def together(recordings, tmp_path):
    """Stored velodyne motions and another estimate of the INS of the same drive, in one rig."""
    stored, ins = recordings / "multi-array-calib/kitti", recordings / "kitti-drive-0027/ins_pose_tum.txt"
    (tmp_path / "rig.toml").write_text(
        f'[sensors.velo]\nlog = "{stored}"\n[sensors.ins]\nkind = "odometry"\nposes = "{ins}"\nformat = "tum"\n'
    )
    return tmp_path


def test_two_recordings_of_one_drive_are_brought_to_one_epoch(together):
    log = open_log(together)
    velo, ins = log.streams["velo"], log.streams["ins"]
    assert (len(velo), len(ins)) == (4548, 4541)
    # frame k of the INS is row k + 3 of the velodyne, both stamped within one sweep of each other
    assert np.abs(ins.stamps - velo.stamps[3 : 3 + 4541]).max() < 0.1


def test_velodyne_and_the_ins_of_another_source_by_the_papers_method(together, truth):
    config = Config(method="paper", jobs=1, start=100.0, duration=200.0)
    c = calibrate(open_log(together), config).calibration
    T = c.between("velo", "ins").T_a_b
    delta = np.degrees(se3.log_so3(truth["velNav"][:3, :3] @ T[:3, :3].T))
    shift = T[:3, 3] - truth["velNav"][:3, 3]
    # measured: 0.06, -0.42 degrees of roll and pitch; -0.159 m ahead, -0.005 m to the left
    assert np.abs(delta[:2]).max() < 0.55
    assert abs(shift[0]) < 0.21
    assert abs(shift[1]) < 0.02


@pytest.mark.long
def test_velodyne_and_the_ins_of_another_source(together, truth):
    result = calibrate(open_log(together), Config(jobs=1, start=100.0, duration=200.0))
    T = result.calibration.between("velo", "ins").T_a_b
    delta = np.degrees(se3.log_so3(truth["velNav"][:3, :3] @ T[:3, :3].T))
    shift = T[:3, 3] - truth["velNav"][:3, 3]
    # measured: 0.06, -0.05 degrees of roll and pitch; -0.15 m ahead, -0.07 m to the left, 0.04 m up
    assert np.abs(delta[:2]).max() < 0.2
    assert abs(shift[0]) < 0.2
    assert abs(shift[1]) < 0.11
    assert abs(shift[2]) < 0.15
    # measured: 0.65 degrees, the yaw by which the stored velodyne's travel is turned
    assert 0.4 < result.statistics["bias_deg"]["ins"] < 0.9


@pytest.mark.long
def test_kitti_360_from_raw_scans_and_images(recordings, tmp_path):
    log = open_log(recordings / "kitti360-3000")
    assert (len(log.streams["velo"]), len(log.streams["cam0"])) == (50, 50)
    result = calibrate(log, Config(jobs=1), cache_folder=tmp_path)
    c = result.calibration
    assert sum("there are no stamps" in w for w in result.warnings) == 2
    true = log.reference.between("velo", "cam0").T_a_b
    error = true[:3, :3].T @ c.T_base_sensor[1, :3, :3]
    # measured: 4.3 degrees, nearly all of it yaw, after five seconds of nearly straight driving
    assert angle_deg(error) < 6.0
    again = calibrate(log, Config(jobs=1), cache_folder=tmp_path).calibration
    np.testing.assert_array_equal(again.T_base_sensor, c.T_base_sensor)
