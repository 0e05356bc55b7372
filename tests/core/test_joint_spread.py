"""From information to sigmas: against what simulated gradients make of an estimate."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.signal import lfilter

from calib_toolkit.joint import spread

P = 5


def definite(rng, p=P):
    root = rng.normal(size=(p, p))
    return root @ root.T + 0.3 * np.eye(p)


def test_without_noise_in_it_the_covariance_is_the_inverse_information():
    S = definite(np.random.default_rng(0))
    cov, gain = spread.covariance(S, np.zeros((P, P)), np.eye(P))
    assert_allclose(cov, np.linalg.inv(S), atol=1e-12)
    assert_allclose(gain, cov, atol=1e-12)


def test_what_noise_feigns_holds_nothing():
    rng = np.random.default_rng(1)
    S = definite(rng)
    L = np.linalg.cholesky(S)
    axes = np.linalg.qr(rng.normal(size=(P, P)))[0]
    feigned = L @ axes @ np.diag([0.0, 0.1, 0.3, 0.5, 0.7]) @ axes.T @ L.T
    cov, gain = spread.covariance(S, feigned, np.eye(P))
    D = np.linalg.inv(S - feigned)
    assert_allclose(gain, D, atol=1e-10)
    assert_allclose(cov, D @ S @ D, atol=1e-10)


def test_a_direction_that_is_all_noise_keeps_a_fifth():
    cov, gain = spread.covariance(np.eye(2) * 4, np.diag([4.4, 0.0]), np.eye(2))
    assert_allclose(gain, np.diag([1 / 0.8, 0.25]))
    assert_allclose(cov, np.diag([4 / 0.64, 0.25]))


def test_directions_that_were_not_searched_have_no_variance():
    rng = np.random.default_rng(2)
    S, free = definite(rng), np.linalg.qr(rng.normal(size=(P, 3)))[0]
    cov, gain = spread.covariance(S, 0.2 * S, free)
    D = free.T @ (0.8 * S) @ free
    assert_allclose(free.T @ cov @ free, np.linalg.inv(D) @ free.T @ S @ free @ np.linalg.inv(D), atol=1e-12)
    assert np.linalg.matrix_rank(cov, tol=1e-9) == np.linalg.matrix_rank(gain, tol=1e-9) == 3
    nothing, none = spread.covariance(S, 0.2 * S, np.zeros((P, 0)))
    assert_allclose(nothing, 0.0)
    assert_allclose(none, 0.0)


GROUPS = [np.arange(3), np.array([3, 4])]
PERIOD = 0.1


def drawn(rng, seconds, alike=0.0, sensors=2):
    """Pulls of sensors whose errors are AR(1) in time, stamps, and what independent errors would make of them."""
    stamps = [np.arange(0.03 * i, seconds, PERIOD) for i in range(sensors)]
    A, B = rng.normal(size=(2, 3, P))  # changing slowly, so that what goes together is not torn apart
    J = [A + B * np.sin(2 * np.pi * s / 40)[:, None, None] for s in stamps]
    if not alike:
        J = [A + rng.normal(size=(len(s), 3, P)) for s in stamps]
    error = [
        np.sqrt(1 - alike**2) * lfilter([1.0], [1.0, -alike], rng.normal(size=(len(s) + 200, 3)), axis=0)[200:]
        for s in stamps
    ]
    information = sum(np.einsum("ndp,ndq->pq", j, j) for j in J)
    cov, gain = spread.covariance(information, np.zeros((P, P)), np.eye(P))
    pulls = [np.einsum("ndp,nd->np", j, e) for j, e in zip(J, error, strict=True)]
    return pulls, stamps, gain, cov


def test_independent_errors_are_left_alone():
    rng = np.random.default_rng(3)
    found = np.array([spread.inflation(*drawn(rng, 60.0, sensors=1), GROUPS) for _ in range(500)])
    alarms = [np.any(found[:, g] != 1, axis=1).sum() for g in GROUPS]
    assert max(alarms) <= 4  # 0.5 on average


@pytest.mark.parametrize("alike", [0.3, 0.6, 0.8])
def test_errors_that_go_together_widen_the_variance_as_they_should(alike):
    """AR(1): sums have (1 + a) / (1 - a) times the variance."""
    rng = np.random.default_rng(4)
    found = np.array([spread.inflation(*drawn(rng, 300.0, alike), GROUPS) for _ in range(12)])
    assert_allclose(np.median(found, axis=0), (1 + alike) / (1 - alike), rtol=0.3)


def test_a_group_that_is_white_is_not_widened_with_another():
    rng = np.random.default_rng(5)
    n, stamps = 3000, [np.arange(3000) * PERIOD]
    error = rng.normal(size=(n, 4))
    error[:, :2] = lfilter([0.3], [1.0, -0.95], error[:, :2], axis=0)
    factor = spread.inflation([error], stamps, np.eye(4) / n, np.eye(4) / n, [np.arange(2), np.arange(2, 4)])
    assert np.all(factor[:2] > 5)
    assert_allclose(factor[2:], 1.0)


def test_parameters_without_variance_and_short_drives_are_left_alone():
    rng = np.random.default_rng(6)
    pulls, stamps, gain, cov = drawn(rng, 300.0, 0.95)
    gain[3:], gain[:, 3:], cov[3:], cov[:, 3:] = 0, 0, 0, 0
    assert_allclose(spread.inflation(pulls, stamps, gain, cov, GROUPS)[3:], 1.0)
    assert_allclose(spread.inflation(*drawn(rng, 30.0, 0.95), GROUPS), 1.0)
