"""Where the search begins: clocks a minute off and any mounting, or no lag at all; never a wrong one."""

import numpy as np
import pytest
from builders import CAMERA, INS, LIDAR, drive, in_base, motions_of, pose, turn_error
from numpy.testing import assert_allclose

from calib_toolkit import calibrate_motions, sync
from calib_toolkit.errors import CalibrationError
from calib_toolkit.joint import start
from calib_toolkit_datasets.simulated import SimulatedSensor, path

CLOSE = 0.05
"""Seconds to which a lag must be right."""


def lags(motions):
    return start.lags([sync.chain(m) for m in motions])


@pytest.mark.parametrize("dt", [-60.0, -7.3, 0.0, 0.04, 60.0])
@pytest.mark.parametrize("seed", range(3))
def test_clocks_a_minute_off_are_found(dt, seed):
    sensors = [
        SimulatedSensor("velo", LIDAR),
        SimulatedSensor("ins", INS, dt=dt, rate=20.0),
        SimulatedSensor("cam", CAMERA, dt=0.02 - dt, rate=12.0, has_scale=False),
    ]
    found = lags(drive(path(120, seed, "street"), sensors, seed).values())
    assert_allclose(found, [0.0, dt, 0.02 - dt], atol=CLOSE)


@pytest.mark.parametrize("kind", ["court", "rough", "highway"])
def test_so_they_are_on_other_drives_with_wrong_readings(kind):
    sensors = [SimulatedSensor("velo", LIDAR, outliers=0.3), SimulatedSensor("ins", INS, dt=33.0, outliers=0.3)]
    assert_allclose(lags(drive(path(120, 1, kind), sensors, 1).values()), [0.0, 33.0], atol=CLOSE)


@pytest.mark.parametrize("kind", ["static", "straight"])
def test_a_drive_without_turns_gives_no_lag(kind):
    sensors = [SimulatedSensor("velo", LIDAR), SimulatedSensor("ins", INS, dt=0.5)]
    assert_allclose(lags(drive(path(60, 2, kind), sensors, 2).values()), 0.0)


def recordings(seed, common, dt):
    """A lidar's and an INS's of one drive, of which so many seconds are common to both."""
    true = path(120, seed, "street")
    velo = motions_of(true, SimulatedSensor("velo", LIDAR), seed)
    ins = motions_of(true, SimulatedSensor("ins", INS, dt=dt, rate=20.0), seed)
    middle = 60.0 + common / 2
    return velo[velo.start < middle], ins[ins.start + dt > middle - common]


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("common", [20.0, 40.0])
def test_recordings_with_little_in_common_are_put_right(seed, common):
    assert_allclose(lags(recordings(seed, common, 3.0)), [0.0, 3.0], atol=CLOSE)


@pytest.mark.long
@pytest.mark.parametrize(("seed", "common"), [(1, 0.0), (2, 8.0), (3, 8.0)])
def test_recordings_with_too_little_in_common_are_refused_or_put_right(seed, common):
    motions = dict(zip(("velo", "ins"), recordings(seed, common, 0.02), strict=True))
    try:
        found = calibrate_motions(motions).calibration
    except CalibrationError:
        return
    assert not found.determined[1, 6] or abs(found.dt_base_sensor[1] - 0.02) < 5 * found.sigma[1, 6]
    turned = np.abs(turn_error(found.T_base_sensor[1, :3, :3], in_base((LIDAR, INS))[1, :3, :3]))
    assert not np.any(turned > 5 * found.sigma[1, 3:6])  # nan where not determined


def steps_of(mounts, seed, outliers=0.0, cameras=()):
    sensors = [
        SimulatedSensor(f"s{i}", T, outliers=outliers, has_scale=i not in cameras) for i, T in enumerate(mounts)
    ]
    chains = [sync.chain(m) for m in drive(path(60, seed, "street"), sensors, seed).values()]
    return sync.synchronise(chains, 100.0)


def turned_wrong_deg(steps, mounts):
    R, R_true = (T[1:, :3, :3] for T in (start.poses(steps), in_base(mounts)))
    return np.degrees(np.linalg.norm(turn_error(R, R_true), axis=1))


HALF_TURNS = [pose(0.5, -0.4, 1.2, 180, 0, 0), pose(-0.7, 0.2, 1.0, 0, 180, 0), pose(1.1, 0.3, 0.6, 0, 0, 180)]
ANYHOW = [CAMERA, pose(0.4, 0.6, 1.3, 35, -70, 140), pose(0.8, -0.5, 2.1, -120, 20, -60)]


@pytest.mark.parametrize("outliers", [0.0, 0.3])
@pytest.mark.parametrize("cameras", [(), (1, 2, 3)], ids=["scaled", "mono"])
@pytest.mark.parametrize("mounts", [HALF_TURNS, ANYHOW], ids=["half turns", "anyhow"])
def test_any_mounting_is_found(mounts, cameras, outliers):
    rig = [LIDAR, *mounts]
    steps = steps_of(rig, 3, outliers, cameras)
    assert turned_wrong_deg(steps, rig).max() < 2.0


def test_so_it_is_from_a_base_that_lies_on_its_side_and_for_cameras_alone():
    rig = [pose(0.2, 0.1, 1.0, 90, 30, 180), *HALF_TURNS]
    assert turned_wrong_deg(steps_of(rig, 4), rig).max() < 2.0
    cameras = [CAMERA, *ANYHOW[1:]]
    steps = steps_of(cameras, 4, cameras=(0, 1, 2))
    assert turned_wrong_deg(steps, cameras).max() < 2.0
    assert_allclose(start.poses(steps)[:, :3, 3], 0.0)


def test_positions_are_about_right_where_the_drive_tells_them():
    rig = [LIDAR, *HALF_TURNS]
    shift = start.poses(steps_of(rig, 3))[1:, :2, 3] - in_base(rig)[1:, :2, 3]
    assert np.abs(shift).max() < 0.2
