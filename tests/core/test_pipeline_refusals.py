"""Every drive or rig that is refused, in its own sentence."""

from dataclasses import replace

import numpy as np
import pytest
from builders import INS, LIDAR, drive
from calibrated_rigs import JOINT, METHODS, QUICK, SENSORS, STREET, flat, log_of

from calib_toolkit import Config, Motions, calibrate
from calib_toolkit.errors import ConfigError, DataError, NotObservableError
from calib_toolkit.pipeline import calibrate_motions
from calib_toolkit.timing import TimingOptions
from calib_toolkit_datasets.simulated import SimulatedSensor, path


@pytest.mark.parametrize("kind", ["static", "straight"])
def test_a_drive_without_turns_is_refused_by_the_papers_method(kind):
    with pytest.raises(NotObservableError, match="the vehicle hardly turned"):
        calibrate(log_of(path(60, 0, kind), SENSORS[:2]), QUICK)


def test_a_static_drive_is_refused():
    for sensors in (SENSORS[:2], SENSORS, [*SENSORS[2:], replace(SENSORS[2], name="cam1")]):
        with pytest.raises(NotObservableError, match="the vehicle hardly moved or turned"):
            calibrate(log_of(path(20, 0, "static"), sensors), JOINT)


@pytest.mark.parametrize("start", ["correlation", "zero"])
def test_a_drive_without_any_motion_at_all_is_refused_for_the_right_reason(start):
    with pytest.raises(NotObservableError, match="the vehicle hardly turned"):
        calibrate_motions(flat(turning=False), replace(QUICK, timing=TimingOptions(steps=500, start=start)))


def test_joint_refuses_a_drive_without_any_motion_at_all():
    with pytest.raises(NotObservableError, match="the vehicle hardly moved or turned"):
        calibrate_motions(flat(turning=False), JOINT)


@METHODS
def test_millimetres_are_refused(config):
    motions = drive(STREET, SENSORS[:2], 0)
    m = motions["ins"]
    units = np.array([1000.0] * 3 + [1] * 3)
    motions["ins"] = Motions(m.start, m.end, m.vec * units, m.cov * units * units[:, None])
    with pytest.raises(DataError, match=r"ins says it drove .* not in metres"):
        calibrate_motions(motions, config)


def test_one_sensor_is_refused():
    with pytest.raises(DataError, match="drive: calibrating takes at least two sensors, and this is velo"):
        calibrate(log_of(STREET, SENSORS[:1]), QUICK)


@METHODS
def test_recordings_of_different_times_are_refused_by_name(config):
    motions = drive(STREET, SENSORS[:2], 0)
    motions["ins"] = motions["ins"].shifted(1000.0)
    with pytest.raises(DataError, match=r"sensor ins starts 9\d\d\.\d s after sensor velo ends"):
        calibrate_motions(motions, config)


@METHODS
def test_too_few_steps_are_refused(config):
    sensors = [SimulatedSensor(n, T, rate=1.0) for n, T in (("a", LIDAR), ("b", INS))]
    with pytest.raises(NotObservableError, match=r"only \d+ steps, too few"):
        calibrate_motions(drive(path(15, 0, "rough"), sensors, 0), config)


def test_a_base_that_is_not_there_is_refused_with_those_that_are():
    with pytest.raises(ConfigError, match="'radar' is not among the sensors; there are: velo, ins, cam"):
        calibrate(log_of(STREET), Config(base="radar", jobs=1))


def test_a_camera_as_base_is_refused_with_those_that_could_be():
    with pytest.raises(ConfigError, match="'cam' is a camera and knows no distances; choose one of: velo, ins"):
        calibrate(log_of(STREET), Config(base="cam", jobs=1))


def test_a_sensor_without_any_motion_is_refused_by_name():
    (moving,) = drive(path(20, 0), [SimulatedSensor("lidar", LIDAR)], 0).values()
    with pytest.raises(DataError, match="sensor camera has no motion in this part"):
        calibrate_motions({"lidar": moving, "camera": moving[:0]})
