"""Propagation of noise, against problems whose covariance linear algebra gives exactly."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from calib_toolkit import delta


def test_finite_differences_match_the_derivative():
    x = np.array([0.3, -1.2])
    J = delta.jacobian(lambda v: np.array([[np.sin(v[0]), v[0] * v[1]], [v[1] ** 2, 1.0]]), x)
    assert J.shape == (2, 2, 2)
    assert_allclose(J, [[[np.cos(0.3), 0], [-1.2, 0.3]], [[0, -2.4], [0, 0]]], atol=1e-8)


def test_larger_takes_each_variance_from_whichever_is_larger():
    a, b = np.diag([4.0, 1.0]), np.array([[1.0, 1.5], [1.5, 9.0]])
    assert_allclose(delta.larger(a, b), [[4.0, 0.5 * 2 * 3], [0.5 * 2 * 3, 9.0]])


def test_larger_stays_a_covariance():
    rng = np.random.default_rng(0)
    for _ in range(20):
        A, B = rng.normal(size=(2, 5, 5))
        found = delta.larger(A @ A.T, B @ B.T)
        assert np.linalg.eigvalsh(found).min() > -1e-12
        assert_allclose(np.diag(found), np.maximum(np.diag(A @ A.T), np.diag(B @ B.T)))


def test_a_parameter_that_nothing_pulls_at_does_not_spoil_the_others():
    found = delta.larger(np.diag([1.0, 0.0]), np.diag([2.0, 0.0]))
    assert np.all(np.isfinite(found))
    assert found[0, 0] == pytest.approx(2.0)


def chain_of_scalars(n, m, stated, true, seed=0):
    """n sensors read ``z[i, k] = slope[k] * p[i] + noise``; pairs compare differences; p[0] = 0.

    Returns the Sums over all pairs, and the exact covariance of the pairwise weighted least-squares answer.
    """
    rng = np.random.default_rng(seed)
    slope = rng.normal(size=m)
    sums = delta.Sums.zero(n - 1, n, m)
    H, G = np.zeros((n - 1, n - 1)), np.zeros((n - 1, n, m))
    for x in range(n):
        for y in range(x + 1, n):
            J = np.zeros((m, n))
            J[:, x], J[:, y] = -slope, slope  # residual = (z_x - slope p_x) - (z_y - slope p_y)
            weight = 1 / (stated[x] + stated[y])
            W = np.full((m, 1, 1), weight)
            sums.add(np.arange(m), x, y, J[:, None, 1:], W, np.ones((1, 1)), -np.ones((1, 1)))
            H += weight * J[:, 1:].T @ J[:, 1:]
            G[:, x] += weight * J[:, 1:].T
            G[:, y] -= weight * J[:, 1:].T
    answer = np.einsum("ab,bik->aik", np.linalg.inv(H), G)  # d answer / d readings, up to sign
    return sums, np.einsum("aik,i,bik->ab", answer, true, answer)


@pytest.mark.parametrize("n", [2, 3, 5])
def test_the_approximate_delta_method_is_exact_for_a_linear_problem(n):
    true = np.arange(1.0, n + 1)
    sums, exact = chain_of_scalars(n, 50, true, true)
    cov = np.broadcast_to(true[:, None, None, None], (n, 50, 1, 1))
    assert_allclose(sums.approximate_delta(cov), exact)


def test_for_two_sensors_the_bound_and_the_delta_method_agree():
    true = np.array([1.0, 3.0])
    sums, exact = chain_of_scalars(2, 50, true, true)
    assert_allclose(sums.cramer_rao(), exact)


def test_with_more_sensors_the_pairwise_bound_is_too_small():
    """Each reading enters n - 1 pairs as if they were independent: the reason why VI-D1 takes the larger of two."""
    true = np.ones(5)
    sums, exact = chain_of_scalars(5, 50, true, true)
    assert np.all(np.diag(sums.cramer_rao()) < 0.75 * np.diag(exact))


def test_the_delta_method_reports_the_noise_it_is_given_not_the_weights():
    stated, true = np.ones(3), np.array([1.0, 4.0, 9.0])
    sums, exact = chain_of_scalars(3, 50, stated, true)
    assert_allclose(sums.approximate_delta(np.broadcast_to(true[:, None, None, None], (3, 50, 1, 1))), exact)


def test_readings_of_unknown_covariance_are_left_out():
    sums, _ = chain_of_scalars(2, 10, np.ones(2), np.ones(2))
    cov = np.ones((2, 10, 1, 1))
    cov[0, 3] = np.nan
    assert np.all(np.isfinite(sums.approximate_delta(cov)))
