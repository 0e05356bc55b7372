"""True motions of a simulated drive go in, the true rig must come out."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calib_toolkit import Config, Motions, calibrate_motions, se3
from calib_toolkit_datasets.simulation.vehicle import path


def pose(xyz, rpy_deg):
    return se3.rigid(Rotation.from_euler("ZYX", rpy_deg[::-1], degrees=True).as_matrix(), np.array(xyz))


RIG = {
    "velo": pose([0.0, 0.0, 1.7], [0, 0, 0]),
    "ins": pose([-0.8, 0.3, 0.9], [0.8, -0.1, 1.0]),
    "cam": pose([0.3, 0.1, 1.6], [-90, 0, -90]),
    "front": pose([0.3, 0.7, 1.6], [10, 20, -90]),
}
SECONDS = 100.0


def motions(true, T_vehicle_sensor, sigma, rate, first=0.0, dt=0.0):
    at = np.arange(first, SECONDS, 1 / rate)
    poses = true.at(at) @ T_vehicle_sensor
    vec = se3.vector(se3.relative(poses[:-1], poses[1:]))
    cov = np.tile(np.diag(np.repeat([sigma, sigma / 10], 3) ** 2), (len(vec), 1, 1))
    return Motions(at[:-1] - dt, at[1:] - dt, vec, cov)


def errors(found):
    """Metres, degrees and seconds, each (3, 3), (3, 3) and (3,), of all but the base."""
    true = np.array([se3.relative(RIG["velo"], T) for T in RIG.values()])
    turned = np.degrees(se3.log_so3(found.T_base_sensor[:, :3, :3] @ np.swapaxes(true[:, :3, :3], 1, 2)))
    return (found.T_base_sensor[:, :3, 3] - true[:, :3, 3])[1:], turned[1:], found.dt_base_sensor[1:]


METHODS = pytest.mark.parametrize("method", ["paper", "joint"])


@METHODS
def test_common_stamps_without_offset_give_the_truth_to_a_millionth(method):
    true = path(SECONDS, 1)
    result = calibrate_motions({n: motions(true, T, 1e-7, 10.0) for n, T in RIG.items()}, Config(method=method))
    shifts, turns, dt = errors(result.calibration)
    assert np.abs(shifts).max() < 1e-6
    assert np.abs(np.radians(turns)).max() < 1e-6
    assert np.abs(dt).max() < 1e-6


CLOCKS = {"velo": (0.0, 0.0), "ins": (0.0031, -0.06), "cam": (0.0037, 0.025), "front": (0.0057, 0.3)}
"""Phase of the readings and offset of the clock, seconds."""


@pytest.mark.long
@METHODS
@pytest.mark.parametrize("drive", ["street", "court"])
def test_other_stamps_and_clocks_give_it_to_a_millimetre(drive, method):
    """At 100 Hz nothing of the motion lies between readings: 0.6 mm, 0.0005 degrees and 0.004 ms are seen."""
    true, rates = path(SECONDS, 1, drive), {"front": 130.0}
    given = {n: motions(true, T, 1e-4, rates.get(n, 100.0), CLOCKS[n][0], CLOCKS[n][1]) for n, T in RIG.items()}
    shifts, turns, dt = errors(calibrate_motions(given, Config(method=method)).calibration)
    assert np.abs(shifts).max() < 1e-3
    assert np.abs(turns).max() < 0.01
    assert np.abs(dt - [CLOCKS[n][1] for n in list(RIG)[1:]]).max() < 1e-4


@pytest.mark.long
@METHODS
@pytest.mark.parametrize("drive", ["street", "rough", "court"])
def test_at_ten_hertz_the_suspension_between_readings_is_the_limit(drive, method):
    """Two to ten hertz of roll and pitch fall between readings: up to 16 mm, 0.23 degrees and 0.2 ms are seen."""
    true = path(SECONDS, 1, drive)
    given = {n: motions(true, T, 1e-3, 10.0, 10 * CLOCKS[n][0], CLOCKS[n][1]) for n, T in RIG.items()}
    shifts, turns, dt = errors(calibrate_motions(given, Config(method=method)).calibration)
    assert np.abs(shifts).max() < 0.03
    assert np.abs(turns).max() < 0.3
    assert np.abs(dt - [CLOCKS[n][1] for n in list(RIG)[1:]]).max() < 3e-4
