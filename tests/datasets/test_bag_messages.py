"""Messages of poses, fixes, inertial units and frames, decoded."""

import numpy as np
import pytest
from bag_builders import START, STEP, Messages, opened, points, write


def test_odometry_with_and_without_covariance_of_its_own(tmp_path):
    m, cov = Messages("cdr"), np.diag([0.01] * 3 + [1e-4] * 3)
    rows = []
    for k in range(5):
        ns, t = START + k * STEP, (k, 0, 0)
        rows += [("/a/odom", ns, m.pose(ns, t, cov=cov)), ("/b/odom", ns, m.pose(ns, t, cov=cov * (1 + k)))]
    log = opened(write(tmp_path / "a", "mcap", rows))
    np.testing.assert_array_equal(log.streams["a"].readings[3].cov, cov)
    assert log.streams["b"].readings[3].cov is None
    assert log.streams["a"].readings[3].T_world_sensor[0, 3] == 3.0


def test_a_fix_takes_its_attitude_from_the_imu_around_it(tmp_path):
    m, rows = Messages("cdr"), []
    for k in range(4):
        ns = START + k * STEP
        rows.append(("/ins/fix", ns, m.fix(ns, 49.0, 8.4 + 1e-5 * k, 110.0)))
    for k in range(-1, 40):
        ns, yaw = START + k * STEP // 10 + 5_000_000, 0.01 * k + 0.005
        rows.append(("/ins/imu", ns, m.imu(ns, (0, 0, np.sin(yaw / 2), np.cos(yaw / 2)))))
    stream = opened(write(tmp_path / "a", "sqlite", rows)).streams["ins"]
    assert (stream.kind, stream.notes) == ("gps_ins", ())
    fix = stream.readings[2]
    assert fix.yaw == pytest.approx(0.2, abs=1e-9)
    assert (np.degrees(fix.lat), np.degrees(fix.lon), fix.alt) == pytest.approx((49.0, 8.4 + 2e-5, 110.0), abs=1e-12)
    np.testing.assert_allclose([*fix.sigma_position, *fix.sigma_rpy], [0.02, 0.02, 0.05, 1e-3, 1e-3, 1e-3])


def test_messages_without_a_fix_are_left_out(tmp_path):
    m, rows = Messages("cdr"), []
    for k in range(5):
        ns = START + k * STEP
        rows.append(("/fix", ns, m.fix(ns, 49 + 1e-5 * k, 8, 0, status=-(k == 2))))
        rows.append(("/imu", ns, m.imu(ns, quaternion=(0.0, 0.0, 0.6, 0.8))))
    stream = opened(write(tmp_path / "a", "sqlite", rows)).streams["fix"]
    assert len(stream) == 4
    assert "1 of 5 messages have no fix" in stream.notes[0]


def test_positions_alone_have_no_attitude_and_it_is_said(tmp_path):
    m = Messages("cdr")
    rows = [("/fix", START + k * STEP, m.fix(START + k * STEP, 49.0 + 1e-5 * k, 8.4, 110.0)) for k in range(5)]
    rows += [("/odom", START + k * STEP, m.pose(START + k * STEP, (k, 0, 0))) for k in range(5)]
    log = opened(write(tmp_path / "a", "sqlite", rows))
    assert set(log.streams) == {"fix", "odom"}
    stream = log.streams["fix"]
    assert stream.kind == "gps_ins"
    assert all(np.isnan([f.roll, f.pitch, f.yaw]).all() for f in stream.readings)
    np.testing.assert_allclose(np.degrees([f.lat for f in stream.readings]), 49.0 + 1e-5 * np.arange(5))
    assert any("positions alone" in note for note in stream.notes)


def test_an_imu_alone_turns_and_does_not_travel(tmp_path):
    m, rng, rows = Messages("cdr"), np.random.default_rng(0), []
    bias = np.array([0.01, -0.02, 0.005])
    for k in range(1000):
        ns, moving = START + k * 10_000_000, k >= 500
        rate = bias + np.array([0, 0, 0.3]) * moving
        shake = rng.normal([0, 0, 9.8], 0.5 if moving else 0.01)
        rows.append(("/imu", ns, m.imu(ns, rate=rate, acceleration=shake)))
    stream = opened(write(tmp_path / "a", "sqlite", rows)).streams["imu"]
    assert not stream.has_scale
    assert stream.period == pytest.approx(0.05)
    turns = np.array([r.vec[3:] for r in stream.readings[1:]])
    np.testing.assert_allclose(turns[:90], 0.0, atol=1e-9)
    np.testing.assert_allclose(turns[110:], np.tile([0, 0, 0.015], (len(turns) - 110, 1)), atol=1e-9)


def test_static_transforms_become_the_reference(tmp_path):
    m, half = Messages("ros1"), np.sqrt(0.5)
    rows = [
        (
            "/tf_static",
            START,
            m.frames(
                m.transform("base", "velo", (1, 0, 2)), m.transform("base", "cam", (2, 0, 1), (0, 0, half, half))
            ),
        )
    ]
    for k in range(3):
        ns = START + k * STEP
        rows += [
            ("/velo/points", ns, m.cloud(ns, points(np.random.default_rng(k)))),
            ("/cam0/image_raw", ns, m.image(ns, np.zeros((48, 64, 3), np.uint8), "bgr8", frame="cam")),
        ]
    log = opened(write(tmp_path / "a.bag", "rosbag1", rows))
    T = log.reference.between("velo", "cam0").T_a_b
    np.testing.assert_allclose(T[:3, 3], [1, 0, -1], atol=1e-12)
    np.testing.assert_allclose(T[:3, 0], [0, 1, 0], atol=1e-12)
    renamed = log.select(["lidar=/velo/points", "eye=cam0"])
    assert list(renamed.streams) == ["lidar", "eye"]
    np.testing.assert_array_equal(renamed.reference.between("lidar", "eye").T_a_b, T)
