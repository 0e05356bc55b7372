"""Noise told by residuals: scales that are recovered, a gate that lets good readings through, expectations."""

import numpy as np
import pytest
from builders import LIDAR, motions_of
from numpy.testing import assert_allclose
from scipy.stats import chi2

from calib_toolkit.joint import noise, turning
from calib_toolkit.joint.noise import Readings
from calib_toolkit.joint.readings import travel
from calib_toolkit_datasets.simulated import SimulatedSensor, path

SETTLED, LATE = noise.SETTLING, noise.LATE
ROUNDS = 25


def readings(squared, size=3, expected=None, usable=None):
    n = len(squared)
    expected = np.full(n, float(size)) if expected is None else expected
    return Readings(np.asarray(squared), expected, size, np.ones(n, dtype=bool) if usable is None else usable)


def settled(true, n, wrong=0.0, together=()):
    """Scales and weights after all rounds, of sensors whose variance is so many times what they state."""
    rng = np.random.default_rng(0)
    squared = [s * chi2.rvs(3, size=n, random_state=rng) for s in true]
    for s in squared:
        s[rng.random(n) < wrong] *= 400
    scales, weights = np.ones(len(true)), [np.ones(n) for _ in true]
    for round_ in range(ROUNDS):
        now = [readings(s / f) for s, f in zip(squared, scales, strict=True)]
        weights = [noise.weights(r, round_, w) for r, w in zip(now, weights, strict=True)]
        change = noise.ratios(now, [w > 0 for w in weights], round_, scales, together)
        scales = scales * noise.damped(change, round_)
    return scales, weights


@pytest.mark.parametrize("true", [(1.0, 1.0, 1.0), (0.25, 9.0, 1.0), (0.1, 40.0, 1.0, 4.0)])
@pytest.mark.parametrize("wrong", [0.0, 0.3])
def test_each_scale_is_recovered_among_three_or_more(true, wrong):
    scales, weights = settled(true, 4000, wrong)
    assert_allclose(scales, true, rtol=0.05)
    for w in weights:
        assert np.mean(w == 0) == pytest.approx(wrong, abs=0.02)


@pytest.mark.parametrize("true", [(4.0, 4.0, 1.0), (0.1, 0.1)])
def test_of_two_that_are_told_together_the_common_scale_is_recovered(true):
    scales, _ = settled(true, 4000, together=(0, 1))
    assert_allclose(scales, true, rtol=0.06)
    assert scales[0] == scales[1]


def test_those_told_together_keep_the_ratio_that_they_had():
    now, kept = (
        [readings(np.full(50, 6.0)), readings(np.full(50, 1.0)), readings(np.full(50, 3.0))],
        [np.ones(50) > 0] * 3,
    )
    for round_ in (0, SETTLED):
        change = noise.ratios(now, kept, round_, np.array([4.0, 1.0, 1.0]), (0, 1))
        assert change[0] == change[1]
    assert change[0] == pytest.approx(3.5 / 3, rel=0.1)
    assert change[2] == pytest.approx(1.0)


@pytest.mark.parametrize("stated", [0.5, 2.0])
def test_the_jitter_of_a_sensors_travel_tells_its_noise(stated):
    m = motions_of(path(60, 1, "street"), SimulatedSensor("velo", LIDAR, stated=stated), 1)
    assert turning.alone(travel(m)) * stated**2 == pytest.approx(1.0, abs=0.25)


def test_without_residuals_the_stated_scale_is_right():
    none = [readings(np.zeros(5))] * 3
    scales = np.array([4.0, 0.5, 1.0])
    kept = [np.zeros(5, dtype=bool)] * 3
    assert_allclose(noise.ratios(none, kept, SETTLED, scales) * scales, 1.0)
    assert_allclose(noise.ratios(none[:2], kept[:2], SETTLED, np.full(2, 4.0), (0, 1)), 0.25)
    nothing = [readings(np.zeros(5), usable=np.zeros(5, dtype=bool))] * 3
    assert_allclose(noise.ratios(nothing, kept, 0, scales), 1.0)


@pytest.mark.parametrize("size", [2, 3, 5, 6])
def test_the_gate_lets_that_share_of_good_readings_through(size):
    n = 200_000
    squared = chi2.ppf((np.arange(n) + 0.5) / n, size)
    kept = noise.weights(readings(squared, size), SETTLED, np.ones(n))
    assert set(np.unique(kept)) == {0.0, 1.0}
    assert np.mean(kept) == pytest.approx(0.9999, abs=1e-5)
    # those that are smaller because the latents followed them are judged as strictly
    followed = noise.weights(readings(0.7 * squared, size, np.full(n, 0.7 * size)), SETTLED, np.ones(n))
    assert_allclose(followed, kept)


def test_at_first_readings_count_less_the_worse_they_fit():
    squared = np.linspace(0, 500, 100)
    soft = noise.weights(readings(squared), 0, np.ones(100))
    assert soft[0] == 1
    assert np.all(np.diff(soft) <= 0)
    assert 0 < soft[-1] < 0.02


def test_one_that_was_rejected_late_does_not_come_back():
    fits, before = readings([1.0, 1.0, 99.0]), np.array([0.0, 1.0, 1.0])
    assert_allclose(noise.weights(fits, LATE - 1, before), [1, 1, 0])
    assert_allclose(noise.weights(fits, LATE, before), [0, 1, 0])


def test_what_is_not_usable_never_counts():
    one = readings([1.0, 1.0], usable=np.array([True, False]))
    for round_ in (0, SETTLED, LATE):
        assert_allclose(noise.weights(one, round_, np.ones(2)), [1, 0])


def test_a_residual_that_the_fit_left_little_of_is_not_made_much_of():
    """A squared residual of half its size passes, though next to nothing was expected."""
    tiny = readings([1.5, 1.5], expected=np.array([1e-6, -0.5]))
    assert_allclose(noise.weights(tiny, SETTLED, np.ones(2)), 1)


def test_expected_squares_of_residuals_that_counted_and_that_did_not():
    """A line through 3D points, weighed 0, a half or 1 in the fit, over many draws."""
    rng = np.random.default_rng(1)
    n, size, draws = 8, 3, 20_000
    J = rng.normal(size=(n, size, 4))
    root = rng.normal(size=(n, size, size))
    cov = root @ np.swapaxes(root, 1, 2) + 0.1 * np.eye(size)
    weight, counted = np.linalg.inv(cov), np.array([1.0, 0, 1, 1, 0, 1, 1, 1])
    pull = np.swapaxes(J, 1, 2) @ weight * counted[:, None, None]
    fit = np.linalg.inv((pull @ J).sum(axis=0))
    error = (np.linalg.cholesky(cov) @ rng.normal(size=(draws, n, size, 1)))[..., 0]
    x = np.einsum("npd,tnd->tp", pull, error) @ fit
    left = error - np.einsum("ndp,tp->tnd", J, x)
    squared = np.einsum("tni,nij,tnj->tn", left, weight, left)
    share = np.einsum("nij,nji->n", weight, J @ fit @ np.swapaxes(J, 1, 2))
    expected = noise.expected(size, share, counted)
    assert_allclose(squared.mean(axis=0), expected, rtol=0.04)
    assert np.ptp(expected) > 2
    kept = counted > 0
    assert noise.freedoms([readings(squared[0], expected=expected)], [kept])[0] == pytest.approx(
        size * kept.sum() - 4
    )


def test_steps_of_a_scale_are_bounded():
    assert_allclose(noise.damped(np.array([1.0]), SETTLED), 1.0)
    early, late = (noise.damped(np.array([1e-9, 1e9]), r) for r in (0, SETTLED))
    assert np.all((early > 0.05) & (early < 20))
    assert np.all((late > 0.3) & (late < 3))
