"""A receiver that tells positions alone beside an odometry: where its antenna is, how late it is, and no more."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calib_toolkit import Config, DataError, Log, Stream, calibrate, se3
from calib_toolkit.errors import ConfigError
from calib_toolkit.types import Measured
from calib_toolkit_datasets.simulated import SimulatedSensor, measure
from calib_toolkit_datasets.simulation import ins
from calib_toolkit_datasets.simulation.vehicle import path

ANTENNA, LATE, SIGMA = np.array([-0.9, 0.5, 0.4]), 0.12, 0.02
PLAIN = Config(appearance=("none",))


def receiver(true, seed, rate=5.0, first=0.3, wrong=0.0):
    """Fixes without attitude, stamped early by ``LATE``; some of them are wrong by metres."""
    rng = np.random.default_rng(seed)
    at = np.arange(true.stamps[0] + 2 + first, true.stamps[-1] - 2, 1 / rate)
    white = (SIGMA, SIGMA, SIGMA, 0.0, 0.0, 0.0)
    model = ins.InsModel(sigma=(1e-6,) * 6, white=white)
    fixes = ins.fixes(model, true, se3.rigid(np.eye(3), ANTENNA), at, rng)
    stated = np.full(3, SIGMA)
    fixes = [replace(f, roll=np.nan, pitch=np.nan, yaw=np.nan, sigma_position=stated, sigma_rpy=None) for f in fixes]
    for k in np.flatnonzero(rng.random(len(fixes)) < wrong):
        fixes[k] = replace(fixes[k], alt=fixes[k].alt + rng.normal(0, 5), lat=fixes[k].lat + rng.normal(0, 1e-6))
    return Stream("gnss", "gps_ins", at - LATE, fixes)


def drive(seed, kind="street", seconds=60.0, has_scale=True, **receiving):
    true = path(seconds, seed, kind)
    odometry = measure(true, SimulatedSensor("velo", np.eye(4), has_scale=has_scale), seed)
    return Log(Path("drive"), {"velo": odometry, "gnss": receiver(true, seed, **receiving)})


def told(c):
    return dict(zip(("x", "y", "z", "rx", "ry", "rz", "dt"), c.determined[c.index("gnss")].tolist(), strict=True))


@pytest.mark.parametrize("wrong", [0.0, 0.05])
def test_an_antenna_is_placed_across_and_its_clock_told(wrong):
    found = calibrate(drive(3, wrong=wrong), PLAIN)
    c = found.calibration
    assert c.names == ("velo", "gnss")
    assert told(c) == {"x": True, "y": True, "z": False, "rx": False, "ry": False, "rz": False, "dt": True}
    sigma = c.sigma[1]
    assert np.all(np.abs(c.T_base_sensor[1, :2, 3] - ANTENNA[:2]) < 4 * sigma[:2])
    assert abs(c.dt_base_sensor[1] - LATE) < 4 * sigma[6]
    assert sigma[:2].max() < 0.06
    assert sigma[6] < 0.01
    assert any("position of gnss along z of velo was not determined" in u.sentence for u in c.undetermined)
    assert found.statistics["antennas"]["gnss"]["rejected"] == pytest.approx(wrong, abs=0.03)


def test_a_measured_height_is_taken_and_an_angle_refused():
    log = drive(3)
    config = replace(PLAIN, prior=(Measured("gnss", "z", 0.41, 0.01),))
    result = calibrate(log, config)
    c = result.calibration
    assert told(c)["z"]
    assert abs(c.T_base_sensor[1, 2, 3] - ANTENNA[2]) < 4 * c.sigma[1, 2] < 0.05
    assert result.configuration["prior"][0]["sensor"] == "gnss"
    with pytest.raises(ConfigError, match="angle of gnss, and an antenna has none"):
        calibrate(log, replace(PLAIN, prior=(Measured("gnss", "yaw", 0.0, 0.01),)))


def test_other_sensors_are_calibrated_as_without_it():
    log = drive(5)
    ins_ = measure(path(60.0, 5, "street"), SimulatedSensor("ins", se3.rigid(np.eye(3), np.ones(3)), 0.02), 5)
    without = replace(log, streams={"velo": log.streams["velo"], "ins": ins_})
    c = calibrate(replace(log, streams={**log.streams, "ins": ins_}), PLAIN).calibration
    alone = calibrate(without, PLAIN).calibration
    assert c.names == ("velo", "ins", "gnss")
    np.testing.assert_array_equal(c.T_base_sensor[:2], alone.T_base_sensor)
    np.testing.assert_array_equal(c.covariance[:14, :14], alone.covariance)
    assert abs(c.dt_base_sensor[2] - LATE) < 4 * c.sigma[2, 6]


@pytest.mark.parametrize("kind", ["straight", "static"])
def test_where_nothing_bends_no_position_is_told(kind):
    known = told(calibrate(drive(4, kind), PLAIN).calibration)
    assert not any(known[p] for p in ("x", "y", "z", "rx", "ry", "rz"))


def test_positions_of_another_drive_tell_nothing():
    log, other = drive(6), drive(7)
    mixed = replace(log, streams={"velo": log.streams["velo"], "gnss": other.streams["gnss"]})
    c = calibrate(mixed, PLAIN).calibration
    assert not any(told(c).values())
    assert any("check that both are of one drive" in u.sentence for u in c.undetermined)


def test_positions_want_a_sensor_that_measures_distances():
    with pytest.raises(DataError, match="knows no distances"):
        calibrate(drive(8, seconds=30.0, has_scale=False), PLAIN)
