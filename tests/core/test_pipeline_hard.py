"""Drives that are hard but can be calibrated: wrong readings, any mounting, late clocks, turns in place."""

from dataclasses import replace

import numpy as np
import pytest
from builders import pose
from calibrated_rigs import JOINT, METHODS, ROUGH, SENSORS, log_of, sigmas
from numpy.testing import assert_allclose

from calib_toolkit import Motions, calibrate, se3
from calib_toolkit.pipeline import calibrate_motions
from calib_toolkit_datasets.simulated import SimulatedSensor, path


def test_a_fifth_of_wrong_readings_is_rejected_and_does_no_harm(joint):
    found = calibrate(log_of(ROUGH, [replace(s, outliers=0.2) for s in SENSORS]), JOINT)
    assert all(0.15 < share < 0.25 for share in found.statistics["rejected"].values())
    assert np.abs(sigmas(found.calibration)).max() < 3.5
    assert np.all(found.calibration.sigma[1:] < 1.5 * joint.calibration.sigma[1:])


@pytest.mark.parametrize("turned", [(180, 0, 0), (0, 180, 0), (0, 0, 180)])
def test_a_sensor_mounted_the_other_way_round_is_found(turned):
    sensors = [SENSORS[0], SimulatedSensor("back", pose(-1.2, 0.4, 0.8, *turned), dt=0.4), SENSORS[2]]
    assert np.abs(sigmas(calibrate(log_of(ROUGH, sensors), JOINT).calibration, sensors)).max() < 3.5


@pytest.mark.parametrize("late", [-80.0, 45.0])
def test_a_clock_that_is_late_by_a_minute_is_found(late):
    sensors = [SENSORS[0], replace(SENSORS[1], dt=late)]
    found = calibrate(log_of(path(120, 0), sensors), JOINT).calibration
    assert found.dt_base_sensor[1] == pytest.approx(late, abs=0.01)
    assert np.abs(sigmas(found, sensors)).max() < 3.5


@METHODS
def test_a_rig_that_turns_in_place_is_calibrated(config):
    """A sensor at the centre goes nowhere while another swings about it: both are in metres."""
    rng, n = np.random.default_rng(0), 400
    turns = np.column_stack([0.05 * rng.normal(size=(n, 2)), 0.2 * np.sin(0.1 * np.arange(n))])
    base = np.column_stack([0.002 * rng.normal(size=(n, 3)), turns])
    T = pose(1.0, 0.3, 0.5, 5, 5, 30)
    stamps, cov = 0.1 * np.arange(n + 1), np.broadcast_to(1e-6 * np.eye(6), (n, 6, 6))
    other = se3.vector(se3.invert(T) @ se3.matrix(base) @ T)
    motions = {k: Motions(stamps[:-1], stamps[1:], v, cov) for k, v in (("a", base), ("b", other))}
    assert_allclose(calibrate_motions(motions, config).calibration.T_base_sensor[1], T, atol=2e-3)
