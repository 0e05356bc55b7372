"""How sensors are turned: exact without noise for any mount, laws of turning and scaling, outliers, uncertainty."""

import numpy as np
import pytest
from builders import MOUNTS, in_axes, in_base, known_times, pose, squared, turn_error
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from calib_toolkit import delta, rotation, se3
from calib_toolkit.rotation import RotationOptions
from calib_toolkit.sync import Steps
from calib_toolkit_datasets.simulated import path

TRIM, ALL = RotationOptions(), RotationOptions(trim=0.0)
SIGMA = np.array([0.01, 0.01, 0.01, 5e-4, 5e-4, 5e-4])
NONE = 0 * SIGMA
ROUGH = path(40, 0, "rough")

TURNS = {
    "none": np.zeros(3),
    "180 about x": np.array([np.pi, 0, 0]),
    "180 about y": np.array([0, np.pi, 0]),
    "180 about z": np.array([0, 0, np.pi]),
    "180 about no axis in particular": np.pi * np.array([1, -2, 2]) / 3,
    "just short of 180": (np.pi - 1e-7) * np.array([0.6, 0, 0.8]),
    **{f"random {k}": v for k, v in enumerate(Rotation.random(5, rng=0).as_rotvec())},
}


def exact(mounts, sigma=SIGMA):
    """Steps without noise that state the noise of sigma."""
    steps = known_times(ROUGH, mounts, NONE, 0)
    cov = np.broadcast_to(np.diag(sigma**2), steps.cov.shape).copy()
    return Steps(steps.ends, steps.vec, cov, steps.has_scale)


def mounted(rotvec):
    return [pose(0, 0, 1.7), se3.matrix(np.concatenate([[0.3, -0.2, 1.0], rotvec]))]


@pytest.mark.parametrize("rotvec", TURNS.values(), ids=TURNS)
def test_without_noise_any_mount_is_found_exactly(rotvec):
    steps, R = exact(mounted(rotvec)), in_base(mounted(rotvec))[:, :3, :3]
    assert_allclose(rotation.initialise(steps), R, atol=1e-9)
    assert_allclose(turn_error(rotation.estimate(steps, TRIM).R_base_sensor, R), 0.0, atol=1e-6)


def test_six_sensors_without_noise_are_found_exactly():
    R = rotation.estimate(exact(MOUNTS), TRIM).R_base_sensor
    assert_allclose(turn_error(R, in_base(MOUNTS)[:, :3, :3]), 0.0, atol=2e-6)


@pytest.mark.parametrize("n", [2, 3])
def test_from_a_wrong_start_the_search_comes_back(n):
    steps, R = exact(MOUNTS[:n]), in_base(MOUNTS[:n])[:, :3, :3]
    wrong = (
        se3.exp_so3(np.random.default_rng(0).normal(size=(n, 3)) * np.radians(1.0) * (np.arange(n) > 0)[:, None]) @ R
    )
    assert_allclose(turn_error(rotation.optimise(wrong, steps, TRIM), R), 0.0, atol=2e-5)


def test_turning_a_sensors_axes_turns_its_answer():
    steps = known_times(ROUGH, MOUNTS[:2], SIGMA, 1)
    Q = pose(0, 0, 0, 180, 30, -70)[:3, :3]
    a, b = rotation.estimate(steps, TRIM), rotation.estimate(in_axes(steps, 1, Q), TRIM)
    assert_allclose(turn_error(b.R_base_sensor[1] @ Q, a.R_base_sensor[1]), 0.0, atol=1e-6)
    assert_allclose(b.cov, a.cov, rtol=1e-3, atol=1e-12)


def test_turning_the_bases_axes_turns_answers_and_covariances():
    steps = known_times(ROUGH, MOUNTS[:2], SIGMA, 1)
    Q = pose(0, 0, 0, 10, -40, 130)[:3, :3]
    a, b = rotation.estimate(steps, ALL), rotation.estimate(in_axes(steps, 0, Q), ALL)
    step = 0.05 * np.sqrt(np.diag(a.cov)[3:].max())
    assert_allclose(turn_error(b.R_base_sensor[1], Q @ a.R_base_sensor[1]), 0.0, atol=step)
    assert_allclose(b.cov[3:, 3:], Q @ a.cov[3:, 3:] @ Q.T, rtol=1e-2, atol=1e-10)


def test_rescaled_covariances_leave_the_answer_and_scale_its_sigma():
    steps = known_times(ROUGH, MOUNTS[:2], SIGMA, 2)
    more = Steps(steps.ends, steps.vec, 16 * steps.cov, steps.has_scale)
    a, b = rotation.estimate(steps, TRIM), rotation.estimate(more, TRIM)
    sigma = np.sqrt(np.diag(a.cov)[3:])
    assert_allclose(turn_error(b.R_base_sensor[1], a.R_base_sensor[1]) / sigma, 0.0, atol=0.1)
    assert_allclose(b.cov, 16 * a.cov, rtol=0.02, atol=0.02 * b.cov.max())


def test_the_order_of_the_other_sensors_does_not_matter():
    steps = known_times(ROUGH, MOUNTS[:3], SIGMA, 3)
    order = [0, 2, 1]
    swapped = Steps(steps.ends, steps.vec[order], steps.cov[order], steps.has_scale[order])
    a, b = rotation.estimate(steps, TRIM), rotation.estimate(swapped, TRIM)
    sigma = np.sqrt(np.diag(a.cov)[3:].reshape(-1, 3))
    assert_allclose(turn_error(b.R_base_sensor[order], a.R_base_sensor)[1:] / sigma, 0.0, atol=0.1)


def test_precise_steps_count_for_more():
    steps = known_times(ROUGH, MOUNTS[:2], SIGMA, 4)
    vec, cov = steps.vec.copy(), steps.cov.copy()
    bad = np.arange(len(steps)) % 2 == 0
    vec[1, bad, 3:] += np.radians(2) * np.random.default_rng(0).normal(size=(bad.sum(), 3)) + np.radians(1)
    cov[1, bad] *= 1e4
    R = in_base(MOUNTS[:2])[:, :3, :3]
    weighted = rotation.initialise(Steps(steps.ends, vec, cov, steps.has_scale))
    unweighted = rotation.initialise(Steps(steps.ends, vec, steps.cov, steps.has_scale))
    assert np.linalg.norm(turn_error(weighted, R)) < 0.2 * np.linalg.norm(turn_error(unweighted, R))


def test_a_fifth_of_wrong_readings_hardly_moves_the_answer():
    steps = known_times(ROUGH, MOUNTS[:3], SIGMA, 5)
    rng, vec = np.random.default_rng(5), steps.vec.copy()
    wrong = rng.random(len(steps)) < 0.2
    vec[1, wrong, 3:] += rng.uniform(0, 40, (wrong.sum(), 3)) * SIGMA[3:]
    found = rotation.estimate(Steps(steps.ends, vec, steps.cov, steps.has_scale), TRIM)
    error = turn_error(found.R_base_sensor, in_base(MOUNTS[:3])[:, :3, :3])[1:]
    assert np.all(np.abs(error).ravel() < 4 * np.sqrt(np.diag(found.cov)[3:]))


def test_the_uncertainty_is_the_curvature_of_the_likelihood():
    """Two sensors, nothing trimmed, no noise: Cramer-Rao, delta method and curvature must be one."""
    steps, R = exact(MOUNTS[:2]), in_base(MOUNTS[:2])[:, :3, :3]

    def slope(d):
        turned = [se3.exp_so3(np.stack([np.zeros(3), d + s])) @ R for s in np.vstack([np.eye(3), -np.eye(3)]) * 1e-4]
        value = np.array([rotation.log_likelihood(r, steps, ALL) for r in turned])
        return (value[:3] - value[3:]) / 2e-4

    curvature = -delta.jacobian(slope, np.zeros(3), 1e-4)
    assert_allclose(np.linalg.inv(curvature), rotation.uncertainty(R, steps, ALL)[3:, 3:], rtol=1e-3, atol=1e-12)


def test_three_equal_sensors_are_as_uncertain_as_algebra_says():
    """The base's noise is common to both others: variances 2, covariance 1, in units of one sensor's share."""
    steps, R = exact(MOUNTS[:3]), in_base(MOUNTS[:3])[:, :3, :3]
    S = se3.skew(steps.vec[0, :, 3:])
    one = SIGMA[5] ** 2 * np.linalg.inv(np.einsum("mia,mib->ab", S, S))
    assert_allclose(
        rotation.uncertainty(R, steps, ALL)[3:, 3:], np.kron([[2, 1], [1, 2]], one), rtol=1e-6, atol=1e-15
    )


def test_errors_are_as_large_as_stated_when_nothing_is_trimmed():
    """30 drives of 40 s, two sensors: 0.96 measured; the ideal of one has a spread of 0.15."""
    R, found = in_base(MOUNTS[:2])[:, :3, :3], []
    for seed in range(30):
        steps = known_times(ROUGH, MOUNTS[:2], SIGMA, seed)
        estimate = rotation.estimate(steps, ALL)
        found.append(squared(turn_error(estimate.R_base_sensor, R)[1], estimate.cov[3:, 3:]))
    assert 0.6 < np.mean(found) < 1.5


def test_the_bases_own_rows_are_zero():
    found = rotation.estimate(known_times(ROUGH, MOUNTS[:3], SIGMA, 0), TRIM)
    assert_allclose(found.R_base_sensor[0], np.eye(3))
    assert_allclose(found.cov[:3], 0.0)
    assert np.linalg.eigvalsh(found.cov[3:, 3:]).min() > 0
