"""Common steps: laws that interpolation must keep, gaps, overlap, the gate, and how timing noise enters."""

import numpy as np
import pytest
from builders import INS, LIDAR, QUIET, motions_of
from numpy.testing import assert_allclose

from calib_toolkit import se3, sync
from calib_toolkit.types import Motions
from calib_toolkit_datasets.simulated import SimulatedSensor, path

COV = np.diag([1e-4, 4e-4, 9e-4, 1e-6, 2e-6, 3e-6])


def uniform(vec, period=0.1, start=0.0, cov=COV, has_scale=True):
    """Motions vec (n, 6) one after the other, ``period`` seconds each."""
    stamps = start + period * np.arange(len(vec) + 1)
    return Motions(stamps[:-1], stamps[1:], vec, np.broadcast_to(cov, (len(vec), 6, 6)).copy(), has_scale)


def wandering(n, seed=0):
    """Smooth motions (n, 6), a metre and a few degrees each."""
    phase = np.linspace(0, 6, n)[:, None] + np.random.default_rng(seed).uniform(0, 6, 6)
    return np.array([1.0, 0.1, 0.02, 0.01, 0.01, 0.1]) * np.sin(phase) + np.array([1.0, 0, 0, 0, 0, 0.02])


def screw(rate, n, period):
    """A constant screw, (6,) velocity and angular velocity, as n motions."""
    twist = np.asarray(rate) * period
    vec = np.concatenate([se3.left_jacobian(twist[3:]) @ twist[:3], twist[3:]])
    return np.tile(vec, (n, 1))


def synchronise(*motions, gate=10.0):
    return sync.synchronise([sync.chain(m) for m in motions], gate)


def test_what_is_synchronous_already_comes_back():
    a, b = uniform(wandering(40)), uniform(wandering(40))
    steps = synchronise(a, b)
    assert_allclose(steps.vec, [a.vec, b.vec], atol=1e-9)
    assert_allclose(steps.cov, [a.cov, b.cov], atol=1e-15)
    assert_allclose(steps.ends, np.stack([a.start, a.end], axis=1))
    assert steps.rejected == 0


def test_synchronising_twice_changes_nothing():
    sensors = [SimulatedSensor("a", LIDAR), SimulatedSensor("b", INS, rate=13.0)]
    once = synchronise(*(motions_of(path(20, 0), s, 0) for s in sensors))
    again = synchronise(*(Motions(*once.ends.T, v, c) for v, c in zip(once.vec, once.cov, strict=True)))
    assert len(again) == len(once) > 150
    assert_allclose(again.vec, once.vec, atol=1e-9)
    assert_allclose(again.cov, once.cov, atol=1e-12)


def test_steps_of_a_faster_sensor_are_joined_by_composition():
    slow, fast = uniform(wandering(20)), uniform(wandering(40) / 2, period=0.05)
    steps = synchronise(slow, fast, gate=1e9)
    T = se3.matrix(fast.vec)
    assert_allclose(steps.vec[1], se3.vector(T[0::2] @ T[1::2]), atol=1e-9)
    assert_allclose(steps.cov[1], fast.cov[0::2] + fast.cov[1::2], atol=1e-15)


@pytest.mark.parametrize("late", [0.0, 0.013, 0.05, 0.099])
def test_splitting_steps_and_joining_them_gives_the_same_motion(late):
    sensor = uniform(wandering(60))
    clock = np.zeros((50, 6))
    halves = synchronise(uniform(clock, 0.1, late), sensor, gate=np.inf)
    wholes = synchronise(uniform(clock[::2], 0.2, late), sensor, gate=np.inf)
    T = se3.matrix(halves.vec[1])
    assert_allclose(se3.vector(T[0::2] @ T[1::2]), wholes.vec[1], atol=1e-9)
    assert_allclose(halves.cov[1, 0::2] + halves.cov[1, 1::2], wholes.cov[1], atol=1e-15)


@pytest.mark.parametrize("late", [0.021, 0.05])
def test_a_constant_screw_is_interpolated_exactly(late):
    rate = [3.0, 0.5, -0.2, 0.1, -0.3, 0.6]
    steps = synchronise(uniform(screw(rate, 20, 0.1)), uniform(screw(rate, 30, 0.07), 0.07, late))
    assert_allclose(steps.vec[1], steps.vec[0], atol=1e-9)


def test_large_turns_are_interpolated_on_the_group():
    """Half a step of 170 degrees joined to half of the next is a step again: no jump where vectors turn over."""
    vec = screw([0.5, 0, 0, 0, 0, np.radians(170)], 20, 1.0)
    half = synchronise(uniform(np.zeros((18, 6)), 1.0, 0.5), uniform(vec, 1.0), gate=np.inf)
    assert_allclose(half.vec[1], vec[:18], atol=1e-9)
    quarter = sync.angles([sync.chain(uniform(vec, 1.0))], np.arange(2.0, 8.0, 0.1), 0.25)[0]
    assert_allclose(quarter, np.radians(170) / 4, atol=1e-9)


def test_a_street_is_interpolated_to_about_a_sensors_noise():
    """The suspension is in part faster than 10 Hz shows: 0.013 degrees of roll and 2 mm are left."""
    sensors = [SimulatedSensor("a", LIDAR, sigma=QUIET), SimulatedSensor("b", LIDAR, sigma=QUIET)]
    a, b = (motions_of(path(30, 1), s, 1) for s in sensors)
    assert abs((b.start[0] - a.start[0]) % 0.1 - 0.05) < 0.045  # not read at the same instants
    steps = synchronise(a, b, gate=np.inf)
    error = (steps.vec[1] - steps.vec[0])[5:-5]
    assert np.all(np.std(error[:, 3:], axis=0) < np.radians([0.02, 0.015, 0.005]))
    assert np.all(np.std(error[:, :3], axis=0) < 0.004)


def test_only_time_shared_by_all_is_used():
    steps = synchronise(uniform(wandering(40)), uniform(wandering(40)[5:], start=0.5), uniform(wandering(40)[:30]))
    assert_allclose(steps.ends[[0, -1], [0, 1]], [0.5, 3.0])


def test_a_shift_of_everything_shifts_the_steps_only():
    a, b = uniform(wandering(30)), uniform(wandering(30), 0.11, 0.02)
    here, there = synchronise(a, b), synchronise(a.shifted(1e5), b.shifted(1e5))
    assert_allclose(there.ends - 1e5, here.ends, atol=1e-9)
    assert_allclose(there.vec, here.vec, atol=1e-8)


def test_a_shifted_chain_is_the_chain_of_shifted_motions():
    motions = uniform(wandering(30))
    a, b = sync.chain(motions).shifted(0.7), sync.chain(motions.shifted(0.7))
    assert_allclose(a.knots, b.knots)
    stamps = np.linspace(1, 3, 50)
    assert_allclose(a.summed(stamps), b.summed(stamps))


def test_nothing_is_made_up_across_a_gap():
    whole, broken = uniform(wandering(60)), uniform(wandering(60))[np.r_[:20, 30:60]]
    steps = synchronise(whole, broken)
    assert len(steps) == 50
    assert not np.any((steps.ends[:, 0] > 1.95) & (steps.ends[:, 1] < 3.05))
    assert_allclose(steps.vec[1], steps.vec[0], atol=1e-9)
    stamps = np.arange(0.005, 5.9, 0.01)
    angle, variance = sync.angles([sync.chain(broken)], stamps, 0.1)
    assert np.array_equal(np.isnan(angle), np.isnan(variance))
    assert_allclose(np.isnan(angle[0]), (stamps > 1.9) & (stamps < 3.0))


def test_motions_in_any_order_make_the_same_chain():
    motions = uniform(wandering(30))
    mixed = motions[np.random.default_rng(0).permutation(30)]
    assert_allclose(sync.chain(mixed).vec, motions.vec)
    assert_allclose(sync.chain(mixed).knots, sync.chain(motions).knots)


def test_of_overlapping_motions_the_earlier_stays():
    singles = uniform(wandering(30))
    T = se3.matrix(singles.vec)
    doubles = Motions(singles.start[:-1], singles.end[1:], se3.vector(T[:-1] @ T[1:]), 2 * singles.cov[1:])
    chain = sync.chain(doubles)
    assert_allclose(chain.vec, doubles.vec[::2])
    assert_allclose(np.diff(chain.knots), 0.2)
    assert chain.known.all()


def test_outside_its_recording_a_sensor_turns_through_no_known_angle():
    stamps = np.linspace(-0.55, 1.45, 21)
    angle, variance = sync.angles([sync.chain(uniform(wandering(10)))], stamps, 0.1)
    assert_allclose(np.isfinite(angle[0]), (stamps > 0) & (stamps < 0.9))
    assert np.array_equal(np.isnan(angle), np.isnan(variance))


def test_a_clock_that_is_late_shows_earlier_angles():
    chain, stamps = sync.chain(uniform(wandering(30))), np.linspace(0.5, 2.0, 20)
    found = sync.angles([chain, chain.shifted(0.3)], stamps, 0.2, np.array([0.3, 0.0]))
    assert_allclose(found[0][0], found[0][1])
    assert_allclose(found[0][0], sync.angles([chain], stamps - 0.3, 0.2)[0][0])


def test_angles_and_their_variances_add_up_to_those_of_a_step():
    motions = uniform(screw([1, 0, 0, 0.1, 0.2, 0.3], 10, 0.1))
    angle, variance = sync.angles([sync.chain(motions)], np.arange(100) * 0.01, 0.01)
    assert_allclose(angle.reshape(10, 10).sum(axis=1), np.linalg.norm(motions.vec[:, 3:], axis=1))
    expected = sync.angle_variance(motions.vec[:, 3:], motions.cov[:, 3:, 3:])
    assert_allclose(variance.reshape(10, 10).sum(axis=1), expected)


def test_the_variance_of_an_angle_is_that_of_many_draws():
    rng = np.random.default_rng(3)
    rotvec, cov = np.array([0.2, -0.1, 0.3]), 1e-4 * np.array([[1.0, 0.3, 0], [0.3, 2, 0.5], [0, 0.5, 3]])
    drawn = np.linalg.norm(rotvec + rng.multivariate_normal(np.zeros(3), cov, 40_000), axis=1)
    assert sync.angle_variance(rotvec, cov) == pytest.approx(np.var(drawn), rel=0.03)
    assert sync.angle_variance(np.zeros(3), cov) == pytest.approx(np.trace(cov) / 3)


def test_steps_whose_angles_disagree_are_dropped_and_counted():
    good = wandering(40)
    bad = good.copy()
    sigma = np.sqrt(2 * COV[5, 5])
    bad[7, 5] += 9 * sigma
    bad[20, 5] += 30 * sigma
    steps = synchronise(uniform(good), uniform(bad))
    assert steps.rejected == 1
    assert len(steps) == 39
    assert 2.0 not in steps.ends[:, 0].round(6)
    assert synchronise(uniform(good), uniform(bad), gate=100.0).rejected == 0


def test_the_slowest_sets_the_steps_and_among_equals_one_without_scale():
    fast, slow = uniform(np.zeros((40, 6)), 0.05), uniform(np.zeros((20, 6)), 0.1)
    camera = uniform(np.zeros((20, 6)), 0.098, has_scale=False)
    assert sync.slowest([sync.chain(m) for m in (fast, slow)]) == 1
    assert sync.slowest([sync.chain(m) for m in (fast, slow, camera)]) == 2


def test_joined_steps_of_a_camera_have_length_one_and_the_noise_that_joining_leaves():
    rng = np.random.default_rng(0)
    vec = np.tile([1.0, 0, 0, 0, 0, 0.003], (3000, 1))
    vec[:, 1:3] += 0.02 * rng.normal(size=(3000, 2))
    vec[:, :3] /= np.linalg.norm(vec[:, :3], axis=1, keepdims=True)
    cov = np.diag([0, 0.02**2, 0.02**2, 1e-8, 1e-8, 1e-8])
    camera = uniform(vec, 1 / 30, cov=cov, has_scale=False)
    steps = synchronise(uniform(np.tile([1.0, 0, 0, 0, 0, 0.009], (1000, 1))), camera, gate=np.inf)
    assert_allclose(np.linalg.norm(steps.vec[1, :, :3], axis=1), 1.0)
    assert not steps.has_scale[1]
    stated = np.sqrt(np.median(steps.cov[1, :, 1, 1]))
    assert stated == pytest.approx(np.std(steps.vec[1, :, 1]), rel=0.1)


def test_a_clock_that_may_be_off_adds_nothing_to_steady_motion():
    steps = synchronise(uniform(screw([5, 0, 0, 0, 0, 0.3], 30, 0.1)), uniform(screw([5, 0, 0, 0, 0, 0.3], 30, 0.1)))
    noisy = sync.add_timing_noise(steps, np.diag([0.0, 0.01**2]))
    assert_allclose(noisy.cov, steps.cov, atol=1e-15)


def test_a_clock_that_may_be_off_adds_its_sigma_times_the_change_of_motion():
    """Equation (20): a yaw rate that grows by 0.5 rad/s every second turns 0.05 rad/s more in each step of 0.1 s."""
    vec = np.zeros((30, 6))
    vec[:, 5] = 0.5 * 0.1 * 0.1 * np.arange(30)
    steps = synchronise(uniform(vec), uniform(vec))
    noisy = sync.add_timing_noise(steps, np.diag([0.0, 0.01**2]))
    assert_allclose(noisy.cov[0], steps.cov[0])
    extra = noisy.cov[1] - steps.cov[1]
    assert_allclose(extra[:, 5, 5], (0.01 * 0.5 * 0.1) ** 2)
    assert_allclose(np.delete(extra.reshape(len(steps), 36), 35, axis=1), 0.0, atol=1e-15)
