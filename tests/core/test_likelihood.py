"""What the stages share, against textbook densities and quadratics whose maximum is known."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.stats import multivariate_normal, norm

from calib_toolkit.likelihood import all_pairs, log_normal, log_normal_3d, maximise, trimmed


def some_covs(rng, n):
    A = rng.normal(size=(n, 3, 3))
    return A @ np.swapaxes(A, 1, 2) + 0.1 * np.eye(3)


def test_each_pair_of_sensors_comes_once():
    assert all_pairs(4) == [(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)]
    assert all_pairs(1) == []


def test_log_densities_are_those_of_the_textbook():
    rng = np.random.default_rng(0)
    residual, cov = rng.normal(size=(30, 3)), some_covs(rng, 30)
    assert_allclose(
        log_normal(residual[:, 0], cov[:, 0, 0]), norm.logpdf(residual[:, 0], scale=np.sqrt(cov[:, 0, 0]))
    )
    expected = [multivariate_normal.logpdf(r, cov=c) for r, c in zip(residual, cov, strict=True)]
    assert_allclose(log_normal_3d(residual, cov), expected)


def test_turning_a_residual_and_its_covariance_leaves_the_density():
    rng = np.random.default_rng(1)
    residual, cov = rng.normal(size=(10, 3)), some_covs(rng, 10)
    Q = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    assert_allclose(log_normal_3d(residual @ Q.T, Q @ cov @ Q.T), log_normal_3d(residual, cov))


@pytest.mark.parametrize(("trim", "left"), [(0.0, 40), (0.25, 30), (0.5, 20)])
def test_the_worst_share_is_left_out(trim, left):
    values = np.random.default_rng(2).normal(size=40)
    total, keep = trimmed(values, trim)
    assert keep.sum() == left
    assert total == pytest.approx(np.sort(values)[40 - left :].sum())
    assert values[keep].min() >= values[~keep].max(initial=-np.inf)


def test_trimming_nothing_gives_nothing():
    total, keep = trimmed(np.zeros(0), 0.25)
    assert (total, len(keep)) == (0.0, 0)


@pytest.mark.parametrize("q", [1, 3, 9, 15])
def test_the_search_finds_the_top_of_a_hill_however_stretched(q):
    rng = np.random.default_rng(q)
    A = rng.normal(size=(q, q)) * 10.0 ** rng.uniform(-4, 0, size=(q, 1))
    cov, top = A @ A.T, rng.normal(size=q)
    information = np.linalg.inv(cov)
    start = top + np.linalg.cholesky(cov) @ rng.normal(size=q) * 3  # three sigma off in every direction
    found = maximise(lambda p: -0.5 * float((p - top) @ information @ (p - top)), start, cov)
    assert (found - top) @ information @ (found - top) < 0.05**2 * q


def test_the_search_copes_with_a_shape_that_is_ten_times_wrong():
    found = maximise(lambda p: -0.5 * float(np.sum((p - [1.0, 2.0]) ** 2)), np.zeros(2), 0.01 * np.eye(2))
    assert_allclose(found, [1.0, 2.0], atol=0.01)


def test_nothing_to_search_is_found_at_once():
    assert maximise(lambda p: 1 / 0, np.zeros(0), np.zeros((0, 0))).size == 0
