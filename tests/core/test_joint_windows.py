"""Which knots a reading sees and how much, against integrals and products taken in small pieces."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.interpolate import BSpline
from scipy.spatial.transform import RigidTransform

from calib_toolkit import se3, sync
from calib_toolkit.joint.windows import coning, hats, splines
from calib_toolkit.types import Motions

START, SPACING, SIZE = -3.0, 0.05, 200
LATER = 1e-5


def intervals(first, last, longest, n=400, seed=0):
    """(n,) starts and ends in order of their starts; some of no length, some on the first and last instant."""
    rng = np.random.default_rng(seed)
    length = np.append(rng.uniform(0, longest, n - 20), np.zeros(20))
    a = rng.uniform(first, last - length)
    a[:2], a[2:4] = first, last - length[2:4]
    order = np.argsort(a, kind="stable")
    return a[order], (a + length)[order]


@pytest.mark.parametrize("longest", [0.01, 0.05, 0.1, 1.7])
def test_hats_integrate_a_signal_that_is_linear_between_knots(longest):
    knots = START + SPACING * np.arange(SIZE)
    a, b = intervals(knots[0], knots[-1], longest)
    signal = np.random.default_rng(1).normal(size=(SIZE, 3))
    windows = hats(START, SPACING, SIZE, a, b)
    assert np.all(np.diff(windows.first) >= 0)
    for found, begin, end in zip(windows.of(signal), a, b, strict=True):
        at = np.concatenate([[begin], knots[(knots > begin) & (knots < end)], [end]])
        values = np.column_stack([np.interp(at, knots, s) for s in signal.T])
        assert_allclose(found, np.trapezoid(values, at, axis=0), atol=1e-12)
    assert_allclose(windows.weights.sum(axis=1), b - a, atol=1e-12)


def test_how_hats_change_as_they_move():
    a, b = intervals(START + 0.1, START + 9.0, 0.3)
    signal = np.random.default_rng(1).normal(size=(SIZE, 3))
    windows = hats(START, SPACING, SIZE, a, b)
    early, late = (hats(START, SPACING, SIZE, a + h, b + h).of(signal) for h in (-LATER, LATER))
    assert_allclose(windows.of(signal, windows.rate), (late - early) / (2 * LATER), atol=1e-3)


def irregular(seed=0):
    """Knots of a cubic spline: of all distances, a gap of five seconds among them."""
    rng = np.random.default_rng(seed)
    breaks = np.cumsum(np.concatenate([[1.0], rng.uniform(0.02, 0.3, 40), [5.0], rng.uniform(0.02, 0.3, 40)]))
    return np.concatenate([np.repeat(breaks[0], 3), breaks, np.repeat(breaks[-1], 3)])


@pytest.mark.parametrize("longest", [0.01, 0.1, 1.0, 7.0])
def test_splines_are_differences_of_a_spline_over_gaps_too(longest):
    knots = irregular()
    a, b = intervals(knots[0], knots[-1], longest)
    coefficients = np.random.default_rng(1).normal(size=(len(knots) - 4, 3))
    signal, windows = BSpline(knots, coefficients, 3), splines(knots, a, b)
    assert np.all(np.diff(windows.first) >= 0)
    assert_allclose(windows.of(coefficients), signal(b) - signal(a), atol=1e-6)
    rate = signal.derivative()
    assert_allclose(windows.of(coefficients, windows.rate), rate(b) - rate(a), atol=1e-3)
    assert_allclose(windows.of(np.ones((len(knots) - 4, 1))), 0.0, atol=1e-12)


def test_a_window_of_no_length_sees_nothing():
    at = np.array([1.3, 2.0, 2.0, 5.0])
    for windows in (hats(0.0, 0.05, 200, at, at), splines(irregular(), at, at)):
        assert_allclose(windows.weights, 0.0, atol=1e-12)
        assert_allclose(windows.rate, 0.0, atol=1e-12)


def swaying(scale, period=0.02, seconds=6.0):
    """A base that coils, (v, w) in phases of their own; its readings and its exact poses every millisecond."""
    fine = 1e-3
    stamps = np.arange(0.0, seconds, fine)
    phase = 2 * np.pi * np.array([0.3, 0.5, 0.7, 0.4, 0.6, 0.9]) * (stamps[:, None] + fine / 2) + np.arange(6)
    rate = scale * np.array([3.0, 1.0, 1.0, 0.5, 0.6, 0.8]) * np.sin(phase)
    steps = RigidTransform.from_exp_coords((rate * fine)[:, [3, 4, 5, 0, 1, 2]]).as_matrix()
    poses = np.empty((len(stamps) + 1, 4, 4))
    poses[0] = np.eye(4)
    for k, step in enumerate(steps):
        poses[k + 1] = poses[k] @ step
    every = round(period / fine)
    at = poses[::every]
    knots = fine * every * np.arange(len(at))
    vec = se3.vector(se3.relative(at[:-1], at[1:]))
    cov = np.broadcast_to(1e-8 * np.eye(6), (len(vec), 6, 6))
    return sync.chain(Motions(knots[:-1], knots[1:], vec, cov)), poses


def log(T):
    """Twists ``[v w]`` of transforms."""
    return RigidTransform.from_matrix(T).as_exp_coords()[:, [3, 4, 5, 0, 1, 2]]


def conings(scale, window):
    """What the twist over windows is more than the sum of its parts: exactly, and as it is estimated."""
    base, poses = swaying(scale)
    first = np.arange(500, 5000, 60)
    last = first + round(window * 1000)
    a, b = first * 1e-3, last * 1e-3
    more = log(se3.relative(poses[first], poses[last])) - (base.summed(b) - base.summed(a))
    return more, coning(base, a, b)


@pytest.mark.parametrize("window", [0.3, 0.6])
def test_coning_is_what_products_of_small_motions_show(window):
    more, found = conings(0.3, window)
    assert np.abs(found).max() > 1e-4
    assert np.abs(found - more).max() < 0.06 * np.abs(more).max()


def test_what_it_leaves_out_is_of_third_order():
    (small, by_small), (large, by_large) = (conings(s, 0.6) for s in (0.5, 2.0))
    assert np.abs(by_large).max() == pytest.approx(16 * np.abs(by_small).max(), rel=0.02)
    left = [np.abs(more - found).max() for more, found in ((small, by_small), (large, by_large))]
    assert 30 < left[1] / left[0] < 80


def test_a_constant_screw_does_not_cone():
    twist = np.array([0.5, 0.1, -0.2, 0.02, 0.05, -0.1])
    vec = np.concatenate([se3.left_jacobian(twist[3:]) @ twist[:3], twist[3:]])
    knots = 0.1 * np.arange(51)
    cov = np.broadcast_to(1e-8 * np.eye(6), (50, 6, 6))
    base = sync.chain(Motions(knots[:-1], knots[1:], np.tile(vec, (50, 1)), cov))
    a = np.linspace(0.5, 4.0, 20)
    assert_allclose(coning(base, a, a + 0.4), 0.0, atol=1e-12)
    assert_allclose(coning(base, a, a), 0.0, atol=1e-12)


def test_before_and_after_the_base_there_is_no_coning():
    base, _ = swaying(1.0)
    a = np.array([-2.0, 8.0])
    assert_allclose(coning(base, a, a + 0.5), 0.0)
