"""What a drive leaves open is told, and measured numbers hold it."""

from dataclasses import replace

import numpy as np
import pytest
from builders import CAMERA, INS, LIDAR, pose, turn_error
from calibrated_rigs import (
    JOINT,
    METHODS,
    NAMES,
    QUICK,
    ROUGH,
    SENSORS,
    STREET,
    flat,
    log_of,
    open_parameters,
    sigmas,
)
from numpy.testing import assert_allclose

from calib_toolkit import calibrate
from calib_toolkit.errors import ConfigError
from calib_toolkit.pipeline import calibrate_motions
from calib_toolkit.types import Measured
from calib_toolkit_datasets.simulated import SimulatedSensor, path


@METHODS
def test_cameras_alone_give_time_and_rotation_but_no_positions(config):
    sensors = [SimulatedSensor(n, T, has_scale=False) for n, T in (("left", CAMERA), ("right", pose(0, -1, 1, -90)))]
    found = calibrate(log_of(ROUGH, sensors), config).calibration
    assert_allclose(found.determined[1], [False] * 3 + [True] * 4)
    assert np.all(np.isnan(found.sigma[1, :3]))
    assert all("no sensor knows distances" in u.sentence for u in found.undetermined)
    assert np.abs(sigmas(found, sensors)[0, 3:]).max() < (5 if config.method == "paper" else 3.5)


@pytest.mark.parametrize(
    ("config", "kind", "open_"),
    [
        (QUICK, "planar", {"x", "y", "z", "rz"}),
        (QUICK, "turn", {"x", "y", "z", "rz", "dt"}),
        (JOINT, "planar", {"z"}),
        (JOINT, "turn", {"x", "z", "rz", "dt"}),
    ],
    ids=["paper-planar", "paper-turn", "joint-planar", "joint-turn"],
)
def test_what_a_flat_drive_leaves_open_has_no_sigma(config, kind, open_):
    """The paper's rotation stage looks at turns alone, so about the one axis of a flat drive it knows nothing.

    Turning a sensor about the centre of a circle, to the left, moves it ahead or back.
    """
    found = calibrate(log_of(path(60, 1, kind), SENSORS[:2]), config).calibration
    assert open_parameters(found, "ins") == open_
    assert set(NAMES[np.isnan(found.sigma[1])]) == open_


@pytest.mark.parametrize("noise", [0.0, 1e-3])
def test_two_flat_odometries_are_told_what_they_can_not_know(noise):
    found = calibrate_motions(flat(noise=noise), QUICK).calibration
    assert not found.determined[1, 5]
    assert np.all(np.isfinite(found.covariance))


@pytest.mark.parametrize("noise", [0.0, 1e-3])
def test_joint_two_flat_odometries_differ_by_all_but_their_height(noise):
    found = calibrate_motions(flat(noise=noise), JOINT).calibration
    assert open_parameters(found, "b") == {"z"}
    assert np.all(np.isfinite(found.covariance))
    assert_allclose(found.T_base_sensor[1, :2, 3], [1.0, 0.5], atol=5e-3)
    assert np.degrees(turn_error(found.T_base_sensor[1, :3, :3], pose(0, 0, 0, 0, 0, 20)[:3, :3]))[2] < 0.05


def test_a_straight_drive_tells_where_ahead_is_and_nothing_else():
    found = calibrate(log_of(path(40, 0, "straight"), SENSORS), JOINT).calibration
    assert open_parameters(found, "ins") >= {"x", "y", "z", "rx"}
    assert open_parameters(found, "ins") <= {"x", "y", "z", "rx", "dt"}
    assert "cam.dt" in {key for u in found.undetermined for key in u.direction}
    told = found.determined[1:]
    assert told[:, 4:6].all()
    assert np.abs(sigmas(found)[told]).max() < 3.5
    assert np.degrees(found.sigma[1:, 4:6]).max() < 0.2


def test_a_measured_height_holds_what_a_plane_leaves_open():
    log, height = log_of(path(60, 1, "planar"), SENSORS[:2]), INS[2, 3] - LIDAR[2, 3]
    known = (Measured("ins", "z", height, 0.015),)
    held = calibrate(log, replace(JOINT, prior=known))
    assert held.complete
    assert held.calibration.T_base_sensor[1, 2, 3] == pytest.approx(height, abs=1e-3)
    assert held.calibration.sigma[1, 2] == pytest.approx(0.015, rel=0.02)
    assert held.statistics["prior"] == ["ins.z"]
    assert held.configuration["prior"] == [{"sensor": "ins", "parameter": "z", "value": height, "sigma": 0.015}]
    told = [0, 1, 3, 4, 5, 6]
    assert np.all(np.abs(sigmas(held.calibration, SENSORS[:2])[0, told]) < 3.5)


@pytest.mark.parametrize(
    ("config", "sensor", "words"),
    [
        (JOINT, "radar", "the prior tells of 'radar', which is not calibrated; there are: velo, ins"),
        (JOINT, "velo", "the prior tells of 'velo', in whose frame all numbers are"),
        (QUICK, "ins", "the paper's method takes no measured numbers"),
    ],
    ids=["unknown", "base", "paper"],
)
def test_measured_numbers_that_have_no_place_are_refused(config, sensor, words):
    with pytest.raises(ConfigError, match=words):
        calibrate(log_of(STREET, SENSORS[:2]), replace(config, prior=(Measured(sensor, "z", 1.0, 0.1),)))
