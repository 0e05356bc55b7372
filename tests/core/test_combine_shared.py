"""Errors that several estimates have in common, the clock's among them."""

from dataclasses import replace

import numpy as np
from combined_rigs import (
    BY_LOOK,
    BY_MOTION,
    NAMES,
    definite,
    drawn,
    moved,
    seen,
)
from numpy.testing import assert_allclose

from calib_toolkit.combine import combine, shared
from calib_toolkit.combine.factors import factor


def test_metrics_of_a_pair_count_as_little_more_than_one():
    one, two = (combine(moved(), [seen(0, 2, m) for m in metrics]) for metrics in (["im"], ["im", "gom"]))
    ratio = two.calibration.sigma[2, 1] / one.calibration.sigma[2, 1]
    assert 0.93 < ratio < 0.97
    coarse = seen(0, 2, "nmi", cov=np.diag((10 * BY_LOOK) ** 2))
    both = combine(moved(), [seen(0, 2), coarse])
    assert 0.99 < both.calibration.sigma[2, 1] / one.calibration.sigma[2, 1] <= 1


def test_pairs_of_one_sensor_go_together():
    everything = [factor(e, NAMES) for e in drawn(np.random.default_rng(1))[2]]
    T = drawn(np.random.default_rng(1))[0]
    cov = shared.covariance(everything, T)
    unit = np.sqrt(np.diag(cov))
    assert np.linalg.eigvalsh(cov / np.outer(unit, unit)).min() > 0
    assert_allclose(cov[:6, :6], everything[0].cov, rtol=1e-9)
    assert np.abs(cov[:6, 12:18]).max() > 0  # both see through the lidar


def test_the_larger_of_two_informations_is_above_both_and_touches_them():
    rng = np.random.default_rng(0)
    A, B = definite(rng, np.ones(4)), definite(rng, np.ones(4))
    C = shared.larger(A, B)
    for D in (A, B):
        assert np.linalg.eigvalsh(C - D).min() > -1e-9
        assert_allclose(np.linalg.det(C - D), 0, atol=1e-9)
    assert_allclose(shared.larger(A, 4 * A), 4 * A, rtol=1e-9)
    along = np.diag([1e6, 0.0])
    assert_allclose(shared.larger(along, np.diag([0.0, 1e-2])), np.diag([1e6, 1e-2]), rtol=1e-3)


def test_the_clock_moves_its_pairs_together():
    # the clock of the cameras is 4 ms off; both estimates went 8 m/s wrong with it, and motion knows the poses well
    cov = moved().covariance.copy().reshape(4, 7, 4, 7)
    for i in range(1, 4):
        cov[i, :6, i, :6] = np.diag([1e-8] * 6)
    for i in (2, 3):
        for j in (2, 3):
            cov[i, 6, j, 6] = 0.003**2  # one clock
    error = np.zeros((4, 7))
    error[2:, 6] = 0.004
    by_clock = np.array([8.0, 0, 0, 0, 0, 0])
    motion = moved(error=error, cov=cov)
    off = by_clock * 0.004
    tight = np.diag([0.001**2] * 3 + [1e-6] * 3)
    pairs = [seen(0, k, error=off, cov=tight, by_clock=by_clock) for k in (2, 3)]
    found = combine(motion, pairs)
    assert all(found.used)
    c = found.calibration
    assert_allclose(c.dt_base_sensor, 0, atol=2e-4)
    assert_allclose(c.dt_base_sensor[2], c.dt_base_sensor[3], atol=1e-9)
    assert c.sigma[2, 6] < 2e-4
    # without it the clock's error is the pairs' own
    assert not all(combine(motion, [replace(p, by_clock=np.zeros(6)) for p in pairs]).used)


def test_the_clock_is_an_error_of_the_pair_where_nothing_else_tells_it():
    by_clock = np.array([8.0, 0, 0, 0, 0, 0])
    tight = np.diag([1e-3**2] * 3 + [1e-6] * 3)
    c = combine(moved(), [seen(0, 2, cov=tight, by_clock=by_clock)]).calibration
    expected = 1 / np.sqrt(1 / (1e-6 + (8 * BY_MOTION[6]) ** 2) + 1 / BY_MOTION[0] ** 2)
    assert_allclose(c.sigma[2, 0], expected, rtol=1e-2)
