"""Clock offsets from angles alone: laws, shared clocks, far starts, outliers, and what it refuses."""

import numpy as np
import pytest
from builders import CAMERA, INS, LIDAR, QUIET, drive, pose
from numpy.testing import assert_allclose

from calib_toolkit import se3, sync, timing
from calib_toolkit.errors import NotObservableError
from calib_toolkit.timing import TimingOptions
from calib_toolkit.types import Motions
from calib_toolkit_datasets.simulated import SimulatedSensor, path

FEWER = TimingOptions(steps=2000)
SAME = 1e-3
"""Seconds within which two searches for one answer end."""


def street(sensors, seconds=40, seed=0):
    return drive(path(seconds, seed), sensors, seed)


def two(dt=0.03, seed=0, **both):
    return street([SimulatedSensor("lidar", LIDAR, **both), SimulatedSensor("ins", INS, dt=dt, **both)], seed=seed)


def offsets(motions, clocks=None, options=FEWER):
    return timing.estimate([sync.chain(m) for m in motions.values()], clocks or list(motions), options)


def synchronous(motions, dt):
    """A second sensor that reads at the very instants of the first, its clock ``dt`` behind."""
    return {"a": motions, "b": motions.shifted(-dt)}


@pytest.mark.parametrize("dt", [0.0, 0.0123, -0.37, 2.5, -4.9])
def test_sensors_read_at_the_same_instants_are_found_exactly(dt):
    (motions,) = street([SimulatedSensor("lidar", LIDAR, sigma=QUIET)]).values()
    assert offsets(synchronous(motions, dt)).dt == pytest.approx([0.0, dt], abs=1e-4)


@pytest.mark.parametrize("dt", [0.03, -4.8])
def test_sensors_read_at_other_instants_are_found_to_what_interpolation_allows(dt):
    """10 Hz against 13 Hz without noise; what is left is the motion between readings that neither saw."""
    sensors = [SimulatedSensor("a", LIDAR, sigma=QUIET), SimulatedSensor("b", INS, dt=dt, rate=13.0, sigma=QUIET)]
    assert offsets(street(sensors, 60)).dt[1] == pytest.approx(dt, abs=0.006)


def test_zero_is_a_start_for_small_offsets_as_in_the_paper():
    from_zero = offsets(two(dt=0.04), options=TimingOptions(steps=2000, start="zero"))
    assert_allclose(from_zero.dt, offsets(two(dt=0.04)).dt, atol=0.004)  # two sigma: the trimmed sum has ripples


def test_what_is_added_to_the_stamps_is_taken_off_the_offset():
    motions = two()
    moved = {"lidar": motions["lidar"].shifted(7.0), "ins": motions["ins"].shifted(7.8)}
    assert offsets(moved).dt[1] == pytest.approx(offsets(motions).dt[1] - 0.8, abs=SAME)


def test_the_other_sensor_as_base_gives_the_opposite_offset():
    motions = two()
    swapped = dict(reversed(motions.items()))
    assert offsets(swapped).dt[1] == pytest.approx(-offsets(motions).dt[1], abs=SAME)


def test_how_a_sensor_is_turned_does_not_matter():
    motions = two()
    R = pose(0, 0, 0, 180, 20, 70)[:3, :3]
    turned = {**motions, "ins": Motions(motions["ins"].start, motions["ins"].end, *in_axes(R, motions["ins"]))}
    assert_allclose(offsets(turned).dt, offsets(motions).dt, atol=SAME)


def in_axes(R, motions):
    both = np.kron(np.eye(2), R)
    return motions.vec @ both.T, both @ motions.cov @ both.T


def test_rescaled_covariances_leave_the_offset_and_scale_its_sigma():
    motions = two()
    larger = {n: Motions(m.start, m.end, m.vec, 9 * m.cov) for n, m in motions.items()}
    a, b = offsets(motions), offsets(larger)
    assert_allclose(b.dt, a.dt, atol=SAME)
    assert np.sqrt(b.cov[1, 1] / a.cov[1, 1]) == pytest.approx(3.0, rel=0.1)


def test_a_camera_needs_no_scale():
    sensors = [SimulatedSensor("lidar", LIDAR), SimulatedSensor("cam", CAMERA, dt=-0.05, has_scale=False)]
    assert offsets(street(sensors)).dt[1] == pytest.approx(-0.05, abs=0.02)


def test_a_fifth_of_wrong_readings_does_little():
    assert offsets(two(outliers=0.2)).dt[1] == pytest.approx(0.03, abs=0.02)


def test_sensors_of_one_clock_have_one_offset():
    sensors = [SimulatedSensor("lidar", LIDAR), *(SimulatedSensor(f"head{k}", INS, dt=0.4) for k in range(2))]
    found = offsets(street(sensors), ["lidar", "ladybug", "ladybug"])
    assert found.dt[1] == found.dt[2] == pytest.approx(0.4, abs=0.02)
    assert_allclose(found.cov[1:, 1:], found.cov[1, 1])


def test_a_sensor_on_the_bases_clock_has_no_offset_and_no_doubt():
    sensors = [SimulatedSensor(n, LIDAR, dt=dt) for n, dt in (("a", 0.0), ("b", 0.2), ("c", 0.0))]
    found = offsets(street(sensors), ["vehicle", "b", "vehicle"])
    assert (found.dt[0], found.dt[2]) == (0.0, 0.0)
    assert found.dt[1] == pytest.approx(0.2, abs=0.02)
    assert_allclose(np.delete(found.cov.ravel(), 4), 0.0)


def test_one_clock_for_all_leaves_nothing_to_find():
    found = offsets(two(dt=0.0), ["vehicle", "vehicle"])
    assert_allclose(found.dt, 0.0)
    assert_allclose(found.cov, 0.0)


def test_the_covariance_is_one():
    sensors = [SimulatedSensor(f"s{k}", LIDAR, dt=0.01 * k) for k in range(4)]
    cov = offsets(street(sensors)).cov
    assert_allclose(cov, cov.T)
    assert np.linalg.eigvalsh(cov[1:, 1:]).min() > 0
    assert_allclose(cov[0], 0.0)


def test_two_sensors_share_the_doubt_that_the_bases_noise_leaves():
    """Three equally noisy sensors: offsets to the first are correlated by a half."""
    cov = offsets(street([SimulatedSensor(f"s{k}", LIDAR) for k in range(3)])).cov[1:, 1:]
    assert cov[0, 1] / np.sqrt(cov[0, 0] * cov[1, 1]) == pytest.approx(0.5, abs=0.15)


def test_comparing_at_more_instants_makes_nobody_surer():
    motions = two()
    few, many = (offsets(motions, options=TimingOptions(steps=n)) for n in (2000, 6000))
    assert many.cov[1, 1] == pytest.approx(few.cov[1, 1], rel=0.1)
    assert many.dt[1] == pytest.approx(few.dt[1], abs=SAME)


def test_errors_are_about_as_large_as_stated():
    """Twelve drives of 40 s: 0.8 stated sigmas measured, root mean square."""
    pulls = []
    for seed in range(12):
        found = offsets(two(seed=seed))
        pulls.append((found.dt[1] - 0.03) / np.sqrt(found.cov[1, 1]))
    assert 0.4 < np.sqrt(np.mean(np.square(pulls))) < 1.6


def test_recordings_that_never_overlap_are_refused():
    motions = two()
    motions["ins"] = motions["ins"].shifted(100.0)
    with pytest.raises(NotObservableError, match="overlap"):
        offsets(motions)


def test_offsets_not_known_are_taken_as_zero():
    found = timing.without(timing.TimeOffsets(np.array([0, 0.3, 0.4]), np.ones((3, 3))), np.array([0, 1, 0], bool))
    assert_allclose(found.dt, [0, 0, 0.4])
    assert_allclose(found.cov[1], 0.0)
    assert found.cov[2, 2] == 1.0


@pytest.mark.parametrize("seed", range(4))
def test_a_short_recording_whose_ends_do_not_match_is_not_pulled_apart(seed):
    """One sensor starts last and the other ends first: a larger offset would shorten what they share."""
    sigma = (0.01,) * 3 + (5e-4,) * 3
    motions = street([SimulatedSensor(n, LIDAR, sigma=sigma) for n in "ab"], 15, seed)
    found = offsets({"a": motions["a"][10:], "b": motions["b"][:-10]}, options=TimingOptions())
    assert abs(found.dt[1]) < 0.04


def test_a_lone_reading_apart_does_not_stop_it():
    motions = two()
    late = motions["ins"]
    T = se3.vector(np.eye(4))
    extra = Motions(late.end[-1:] + 3, late.end[-1:] + 3.1, T[None], late.cov[:1])
    found = offsets({**motions, "ins": Motions.concatenate([late, extra])})
    assert found.dt[1] == pytest.approx(0.03, abs=0.02)
