"""Motion combined with estimates of pairs: exactness, the law that nothing gets worse, honest covariances."""

from dataclasses import replace

import numpy as np
from combined_rigs import (
    BY_MOTION,
    NAMES,
    TRUE,
    at_most,
    difference,
    difference_of,
    drawn,
    moved,
    random_rig,
    seen,
)
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy.stats import chi2

from calib_toolkit import se3
from calib_toolkit.combine import combine, combine_paper
from calib_toolkit.combine.factors import factor
from calib_toolkit.types import PairEstimate, Transform

NEVER = chi2.isf(1e-7, 6)
"""Normalised square of a pose's error that is not reached by chance."""


def own(e, c):
    """An estimate's covariance with the error that the clock adds to it, sigma of dt by motion."""
    i, j = c.index(e.transform.a), c.index(e.transform.b)
    C = c.covariance[np.ix_([7 * i + 6, 7 * j + 6], [7 * i + 6, 7 * j + 6])]
    return e.transform.cov + np.outer(e.by_clock, e.by_clock) * (C[0, 0] + C[1, 1] - 2 * C[0, 1])


@settings(max_examples=8, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_no_pair_comes_out_worse_than_its_own_covariance_allows(seed):
    T, motion, estimates = drawn(np.random.default_rng(seed))
    found = combine(motion, estimates)
    for i, a in enumerate(NAMES):
        for b in NAMES[:i]:
            # both at the same poses, or the lever arms differ
            by_motion = replace(found.calibration, covariance=motion.covariance).between(a, b).cov
            if not any("by motion contradicts" in n for n in found.notes):
                assert at_most(found.calibration.between(a, b).cov, by_motion, 1e-2)
    for e, used in zip(estimates, found.used, strict=True):
        if used and e.transform.has_scale:
            pair = found.calibration.between(e.transform.a, e.transform.b)
            assert at_most(pair.cov, own(e, motion), 1e-2)
            # nor is the rig further from the truth than the estimate's own sigma makes likely
            a, b = motion.index(e.transform.a), motion.index(e.transform.b)
            error = difference_of(pair.T_a_b, se3.relative(T[a], T[b]))
            assert error @ np.linalg.solve(own(e, motion), error) < NEVER


def test_the_law_holds_to_rounding_where_nothing_is_off():
    for seed in range(10):
        T, motion, estimates = drawn(np.random.default_rng(seed))
        motion = replace(motion, T_base_sensor=T)
        right = []
        for e in estimates:
            a, b = NAMES.index(e.transform.a), NAMES.index(e.transform.b)
            right.append(seen(a, b, e.metric, None, e.transform.cov, e.by_clock, e.transform.has_scale, T))
        found = combine(motion, right)
        assert all(found.used)
        assert at_most(found.calibration.covariance[7:, 7:], motion.covariance[7:, 7:])
        for e in right:
            pair = found.calibration.between(e.transform.a, e.transform.b)
            if e.transform.has_scale:
                assert at_most(pair.cov, own(e, motion))
            else:
                distance = np.linalg.norm(pair.T_a_b[:3, 3])
                across = factor(e, NAMES).across
                told = np.block([[across.T / distance, np.zeros((2, 3))], [np.zeros((3, 3)), np.eye(3)]])
                assert at_most(told @ pair.cov @ told.T, factor(e, NAMES).cov)


def test_errors_are_what_the_covariance_says_and_less_than_before():
    squares, better = [], []
    for seed in range(12):
        T, motion, estimates = drawn(np.random.default_rng(seed))
        # one metric a pair: then what is drawn is what is assumed, but for what pairs of a sensor share
        estimates = [e for e in estimates if e.metric != "gom"]
        c = combine(motion, estimates).calibration
        error = difference(c, T)[1:]
        rows = [7 * i + k for i in (1, 2, 3) for k in range(6)]
        squares.append(error.ravel() @ np.linalg.solve(c.covariance[np.ix_(rows, rows)], error.ravel()) / 18)
        better.append([error**2, difference(motion, T)[1:] ** 2])
    assert 0.7 < np.mean(squares) < 1.35
    after, before = np.sum(better, axis=(0, 2))
    assert after[:3].sum() < 0.1 * before[:3].sum()
    assert after[3:].sum() < 0.5 * before[3:].sum()


def test_exact_estimates_give_the_truth():
    rng = np.random.default_rng(3)
    T = random_rig(rng)
    pairs = [seen(0, 1, T=T), seen(2, 0, T=T), seen(1, 3, T=T), seen(2, 3, has_scale=False, T=T)]
    found = combine(moved(T), pairs)
    assert all(found.used)
    assert_allclose(found.calibration.T_base_sensor, T, atol=1e-9)
    assert found.notes == ()


def test_estimates_that_are_sure_win_over_a_motion_result_that_is_not():
    T = random_rig(np.random.default_rng(4))
    error = np.random.default_rng(5).normal(size=(4, 7)) * BY_MOTION * (np.arange(4) > 0)[:, None]
    sure = np.diag(np.full(6, 1e-12))
    pairs = [seen(0, 1, cov=sure, T=T), seen(2, 0, cov=sure, T=T), seen(1, 3, cov=sure, T=T)]
    found = combine(moved(T, error), pairs)
    assert_allclose(found.calibration.T_base_sensor, T, atol=1e-8)


def test_without_estimates_motion_stays_as_it_is():
    motion = moved(error=np.random.default_rng(0).normal(size=(4, 7)) * 0.01)
    for method in (combine, combine_paper):
        c = method(motion, []).calibration
        assert_allclose(c.T_base_sensor, motion.T_base_sensor, atol=1e-9)
    assert_allclose(combine(motion, []).calibration.covariance, motion.covariance, atol=1e-15)


def test_a_pair_in_either_order_says_the_same():
    error = np.array([0.02, 0.01, -0.01, 0.001, 0.002, -0.001])
    one = seen(0, 2, error=error, by_clock=np.array([8.0, 1, 0, 0, 0, 0.1]))
    T, cov = one.transform.T_a_b, one.transform.cov
    J = se3.relative_jacobians(T, np.eye(4))[0]
    other = PairEstimate("im", Transform("cam0", "velo", se3.invert(T), J @ cov @ J.T), by_clock=-J @ one.by_clock)
    a, b = (combine(moved(), [e]).calibration for e in (one, other))
    # a large turn's Jacobians differ by the second order of the error
    assert_allclose(a.T_base_sensor, b.T_base_sensor, atol=2e-5)
    assert_allclose(a.covariance, b.covariance, atol=1e-6)


def test_half_a_turn_off_is_no_obstacle():
    T = TRUE.copy()
    T[1, :3, :3] = np.diag([-1.0, -1.0, 1.0])
    error = np.zeros((4, 7))
    error[1, :6] = [0.05, -0.05, 0.1, 0.003, -0.003, 0.002]
    found = combine(moved(T, error), [seen(0, 1, cov=np.diag([1e-12] * 6), T=T)])
    assert_allclose(found.calibration.T_base_sensor[1], T[1], atol=1e-8)


def test_inputs_are_left_alone_and_answers_repeat():
    _, motion, estimates = drawn(np.random.default_rng(2))
    before = motion.covariance.copy(), motion.T_base_sensor.copy()
    first, again = (combine(motion, estimates).calibration for _ in range(2))
    assert_allclose(first.covariance, again.covariance, rtol=0, atol=0)
    assert_allclose(motion.covariance, before[0], rtol=0, atol=0)
    assert_allclose(motion.T_base_sensor, before[1], rtol=0, atol=0)
