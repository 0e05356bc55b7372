"""Errors against the truth, and the baselines beside the toolkit's own methods."""

import numpy as np
import pytest
from builders import CAMERA, INS, LIDAR, QUIET, exact_turns, in_base, known_times
from scipy.spatial.transform import Rotation

from calib_toolkit import se3
from calib_toolkit.errors import NotObservableError
from calib_toolkit.evaluation import baselines
from calib_toolkit.evaluation.errors import euler_sigma, rotation_error, rotation_sigma
from calib_toolkit_datasets.simulated import path

# ---- errors


def test_a_rotation_error_is_the_turn_from_the_estimate_to_the_truth():
    R_est = Rotation.from_rotvec([0.3, -1.2, 0.7]).as_matrix()
    delta = np.array([0.02, -0.01, 0.03])
    found = rotation_error(se3.exp_so3(delta) @ R_est @ R_est.T)
    np.testing.assert_allclose([found[k] for k in ("rx", "ry", "rz")], np.degrees(delta))
    assert found["rotation"] == pytest.approx(np.degrees(np.linalg.norm(delta)))
    turn = Rotation.from_euler("ZYX", [3.0, -2.0, 1.0], degrees=True).as_matrix()
    euler = rotation_error(turn)
    np.testing.assert_allclose([euler[k] for k in ("roll", "pitch", "yaw")], [1.0, -2.0, 3.0])


def test_monte_carlo_sigma_of_euler_angles_is_the_linear_one_where_small():
    A = np.random.default_rng(4).normal(size=(3, 3))
    cov = A @ A.T * np.radians(0.4) ** 2
    np.testing.assert_allclose(euler_sigma(cov), np.sqrt(np.diag(cov)), rtol=0.03)
    stated = rotation_sigma(cov)
    np.testing.assert_allclose([stated[k] for k in ("rx", "ry", "rz")], np.degrees(np.sqrt(np.diag(cov))))
    assert not euler_sigma(np.zeros((3, 3))).any()


def test_monte_carlo_sigma_of_euler_angles_knows_large_turns():
    cov = np.diag(np.radians([5.0, 60.0, 5.0]) ** 2)
    many = Rotation.from_rotvec(np.random.default_rng(9).multivariate_normal(np.zeros(3), cov, size=100_000))
    np.testing.assert_allclose(euler_sigma(cov), many.as_euler("ZYX")[:, ::-1].std(axis=0), rtol=0.05)
    assert np.abs(euler_sigma(cov)[1] / np.radians(60.0) - 1) > 0.1  # pitch ends at a right angle


# ---- baselines


def test_least_squares_is_exact_without_noise():
    steps = known_times(path(30.0, 2, "rough"), [LIDAR, INS], np.array(QUIET), 1)
    np.testing.assert_allclose(baselines.least_squares(steps), in_base([LIDAR, INS])[1], atol=1e-4)


def test_least_squares_weighs_every_step_alike():
    """One wild step pulls it; the paper's estimator does not move for that (its own tests)."""
    steps = known_times(path(30.0, 2, "rough"), [LIDAR, INS], np.array(QUIET), 1)
    steps.vec[1, 40, :3] += [5.0, 0.0, 0.0]
    assert np.linalg.norm(baselines.least_squares(steps)[:3, 3] - in_base([LIDAR, INS])[1, :3, 3]) > 0.01


def test_least_squares_knows_no_position_without_scale():
    steps = known_times(path(30.0, 2, "rough"), [LIDAR, CAMERA], np.array(QUIET), 1, cameras=[1])
    T = baselines.least_squares(steps)
    np.testing.assert_allclose(T[:3, :3], exact_turns([LIDAR, CAMERA]).R_base_sensor[1], atol=1e-5)
    assert np.isnan(T[:3, 3]).all()


@pytest.mark.skipif(not baselines.opencv_has_hand_eye(), reason="this OpenCV has no calibrateHandEye")
@pytest.mark.parametrize("method", baselines.OPENCV_METHODS)
def test_opencv_is_asked_in_its_own_convention(method):
    steps = known_times(path(60.0, 2, "rough"), [LIDAR, INS], np.array(QUIET), 1)
    T = baselines.opencv_hand_eye(steps, method)
    np.testing.assert_allclose(T, in_base([LIDAR, INS])[1], atol=2e-3)
    # steps may be missing: what is left still belongs together
    keep = np.random.default_rng(1).random(len(steps)) < 0.7
    np.testing.assert_allclose(baselines.opencv_hand_eye(steps[keep], method), T, atol=2e-3)


def test_opencv_refuses_a_camera():
    steps = known_times(path(30.0, 2, "rough"), [LIDAR, CAMERA], np.array(QUIET), 1, cameras=[1])
    with pytest.raises(NotObservableError, match="two sensors that measure distances"):
        baselines.opencv_hand_eye(steps, "opencv-park")
