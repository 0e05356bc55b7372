"""A sensor whose travel is turned against its turns, and one whose turns are wrong."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from builders import drive, pose, turn_error
from numpy.testing import assert_allclose

from calib_toolkit import Config, calibrate_motions, se3
from calib_toolkit.joint import leaning
from calib_toolkit.joint.moving import Moving
from calib_toolkit_datasets.simulated import SimulatedSensor, path

MOUNT = pose(0.4, 0.1, 0.9, 0.01, 0.02, 0.03)


@pytest.fixture(scope="module")
def rough():
    """Motions of a lidar and an INS over rough ground, where turns tell all of a rotation."""
    sensors = [SimulatedSensor("velo", np.eye(4)), SimulatedSensor("ins", MOUNT)]
    return drive(path(60, 3, "rough"), sensors, 5)


def turned(motions, part, angles):
    """The motions with travel (or turns) turned by angles in the sensor's axes."""
    vec, at = motions.vec.copy(), slice(0, 3) if part == "travel" else slice(3, 6)
    vec[:, at] = vec[:, at] @ se3.exp_so3(np.radians(angles)).T
    return replace(motions, vec=vec)


def solved(rough, part, angles):
    result = calibrate_motions({**rough, "ins": turned(rough["ins"], part, angles)}, Config())
    c = result.calibration
    return np.degrees(turn_error(c.T_base_sensor[1, :3, :3], MOUNT[:3, :3])), np.degrees(c.sigma[1, 3:6]), result


def test_without_a_fault_nothing_is_open(rough):
    error, sigma, result = solved(rough, "travel", [0.0, 0.0, 0.0])
    assert result.statistics["bias_deg"]["ins"] == 0.0
    assert sigma.max() < 0.1
    assert np.all(np.abs(error) < 3 * sigma)


@pytest.mark.parametrize("part", ["travel", "turns"])
@pytest.mark.parametrize("angles", [[0.0, 1.0, 0.0], [0.0, 0.0, -0.8]])
def test_the_rotation_lies_between_and_sigma_reaches_both(rough, part, angles):
    error, sigma, result = solved(rough, part, angles)
    size = np.linalg.norm(angles)
    assert result.statistics["bias_deg"]["ins"] == pytest.approx(size, abs=0.1)
    assert np.linalg.norm(error) == pytest.approx(size / 2, abs=0.15)
    about = np.abs(angles) / size
    assert about @ np.abs(error) < 1.3 * about @ sigma


def test_turns_far_from_the_travel_give_way(rough):
    error, sigma, _ = solved(rough, "turns", [0.0, 0.0, 4.0])
    assert np.abs(error).max() < 0.15
    assert 0.45 < sigma[2] < 0.7


def found(bias, n=3):
    """A result with the biases (n - 1, 3) of the sensors but the base."""
    p = 9 * (n - 1)
    T = np.array([np.eye(4), *[pose(0.1, 0.2, 0.3, 0.4 * k, 0.5, 0.6) for k in range(1, n)]])
    none = np.zeros(0)
    zeros = np.zeros((p, p))
    return Moving(
        T, np.vstack([np.zeros(3), bias]), 1, zeros, zeros, zeros, np.eye(p), none, none, (), none, ()
    )  # fmt: skip


@pytest.mark.parametrize("size", [0.01, 0.06])
def test_errors_of_the_rotation_are_those_of_turns_and_bias(size):
    """``by_found`` against finite differences."""
    bias, axes = np.array([[0.0, size, 0.0], [0.0, 0.0, 0.0]]), [np.eye(3), np.zeros((3, 0))]
    before = found(bias)
    T, by_found = leaning.between(before, axes)
    assert_allclose(T[[0, 2]], before.T_base_sensor[[0, 2]])
    assert_allclose(by_found[6:12, :], np.eye(18)[6:12])
    h = 1e-5
    for column in (3, 4, 5, 12, 13, 14):
        changed = []
        for step in (h, -h):
            there = found(bias)
            if column < 6:
                R = there.T_base_sensor[1, :3, :3]
                there.T_base_sensor[1, :3, :3] = se3.exp_so3(step * np.eye(3)[column - 3]) @ R
            else:
                there.bias[1, column - 12] += step
            # how far it goes depends on the size of the bias, which is no error of the rotation
            share = 1.0 if size > leaning.MOST else 0.5
            back = se3.exp_so3(-share * there.bias[1])
            changed.append(se3.log_so3(back @ there.T_base_sensor[1, :3, :3] @ T[1, :3, :3].T))
        assert_allclose((changed[0] - changed[1]) / (2 * h), by_found[3:6, column], atol=1e-6)


def test_a_fault_of_the_base_leaves_the_others_known_to_each_other(rough):
    lidar = turned(rough["velo"], "travel", [0.0, 1.0, 0.0])
    motions = {"velo": lidar, "ins": rough["ins"], "ins1": rough["ins"]}
    c = calibrate_motions(motions, Config()).calibration
    assert np.degrees(c.sigma[1:, 4]).min() > 0.4
    assert np.degrees(np.sqrt(np.diag(c.between("ins", "ins1").cov)[3:6])).max() < 0.1


def test_travel_is_never_turned_about_itself():
    """That would change nothing, and an axis that has a part of it lets a small lean look like a large one."""
    turn = se3.exp_so3(np.radians([0.3, 0.5, 0.0]))
    there = found(np.zeros((1, 3)), n=2)
    by_turns = SimpleNamespace(
        R_base_sensor=turn @ there.T_base_sensor[:, :3, :3], cov=np.radians(0.1) ** 2 * np.eye(3)
    )
    nothing = [np.zeros((6, 0))]
    (about,) = leaning.axes(by_turns, np.zeros((3, 3)), nothing, nothing, there, np.array([8.0, 0.0, 0.0]))
    assert_allclose(np.abs(about.T), [[0.0, 1.0, 0.0]], atol=1e-9)
