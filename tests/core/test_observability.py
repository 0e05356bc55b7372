"""What a drive did not measure: every verdict over several seeds, in whatever axes, whatever noise is stated."""

import numpy as np
import pytest
from builders import CAMERA, INS, LIDAR, drive, exact_turns, known_times, pose
from numpy.testing import assert_allclose

from calib_toolkit import observability, rotation, se3, sync
from calib_toolkit.rotation import RotationOptions
from calib_toolkit.sync import Steps
from calib_toolkit_datasets.simulated import SimulatedSensor, path

SIGMA = np.array([0.01, 0.01, 0.01, 5e-4, 5e-4, 5e-4])
RIG = (LIDAR, INS, CAMERA)


def seeds(quick, long):
    """Drives of which the first few are quick enough for every run of the tests."""
    return [*range(quick), *(pytest.param(seed, marks=pytest.mark.long) for seed in range(quick, long))]


def steps_of(kind, seed, mounts=RIG, seconds=100, cameras=(2,)):
    return known_times(path(seconds, seed, kind), mounts, SIGMA, seed, cameras)


def names_of(steps):
    return [f"s{i}" for i in range(len(steps.vec))]


def turns_left_open(steps):
    """As the pipeline asks: with the rotations that were found, which have fitted themselves to the noise."""
    R = rotation.estimate(steps, RotationOptions()).R_base_sensor
    return observability.unmeasured_turns(names_of(steps), steps, R)


def shifts_left_open(steps, mounts=RIG):
    """With the true rotations, as if something else had measured them."""
    return observability.unmeasured_shifts(names_of(steps), steps, exact_turns(mounts).R_base_sensor, [])


def directions(found, name, axes):
    """(k, 3) of one sensor."""
    keys = [f"{name}.{a}" for a in axes]
    return np.array([[u.direction[k] for k in keys] for u in found if keys[0] in u.direction]).reshape(-1, 3)


TURNS, SHIFTS = ("rx", "ry", "rz"), ("x", "y", "z")


@pytest.mark.parametrize("seed", seeds(8, 40))
def test_a_street_of_100_seconds_leaves_nothing_open(seed):
    """No false alarm: lidar, INS and camera, with true rotations."""
    steps = steps_of("street", seed)
    R = exact_turns(RIG).R_base_sensor
    assert observability.unmeasured_turns(names_of(steps), steps, R) == []
    assert shifts_left_open(steps) == []


@pytest.mark.parametrize("kind", ["street", "rough"])
@pytest.mark.parametrize("seed", seeds(2, 8))
def test_nor_do_they_with_the_rotations_that_were_found(kind, seed):
    assert turns_left_open(steps_of(kind, seed, RIG[:2], cameras=())) == []


@pytest.mark.parametrize("kind", ["planar", "turn"])
@pytest.mark.parametrize("seed", seeds(2, 8))
def test_a_flat_drive_leaves_the_turn_about_its_axis_open_and_that_axis_as_position(kind, seed):
    steps = steps_of(kind, seed)
    for found, axes in ((turns_left_open(steps), TURNS), (shifts_left_open(steps), SHIFTS)):
        for name in ("s1", "s2"):
            (v,) = directions(found, name, axes)
            assert_allclose(np.abs(v), [0, 0, 1], atol=0.05)


@pytest.mark.parametrize("kind", ["straight", "static"])
@pytest.mark.parametrize("seed", seeds(2, 8))
def test_without_turning_everything_is_open(kind, seed):
    steps = steps_of(kind, seed, RIG[:2], cameras=())
    assert len(turns_left_open(steps)) == len(shifts_left_open(steps, RIG[:2])) == 3


def test_directions_are_those_of_the_drive_not_of_the_axes():
    base = pose(0, 0, 1, 35, -20, 60)
    mounts = (base, INS)
    steps = steps_of("planar", 0, mounts, cameras=())
    up = base[:3, :3].T @ [0, 0, 1]
    (v,) = directions(shifts_left_open(steps, mounts), "s1", SHIFTS)
    assert abs(v @ up) > 0.999
    (v,) = directions(turns_left_open(steps), "s1", TURNS)
    assert abs(v @ up) > 0.999


@pytest.mark.parametrize("stated", [0.01, 1.0, 100.0])
def test_verdicts_do_not_depend_on_the_noise_that_sensors_state(stated):
    for kind, count in (("street", 0), ("planar", 1), ("straight", 3)):
        steps = steps_of(kind, 1, RIG[:2], cameras=())
        claimed = Steps(steps.ends, steps.vec, steps.cov * stated**2, steps.has_scale)
        assert len(shifts_left_open(claimed, RIG[:2])) == count


def test_two_cameras_have_rotations_but_no_positions():
    mounts = (CAMERA, pose(0.2, 0.8, 1.1, -90, 0, 90))
    steps = steps_of("street", 0, mounts, cameras=(0, 1))
    assert turns_left_open(steps) == []
    found = shifts_left_open(steps, mounts)
    assert_allclose(directions(found, "s1", SHIFTS), np.eye(3))
    assert all("no sensor knows distances" in u.sentence for u in found)


def test_positions_wait_for_rotations():
    steps = steps_of("planar", 0, RIG[:2], cameras=())
    turns = turns_left_open(steps)
    found = observability.unmeasured_shifts(names_of(steps), steps, exact_turns(RIG[:2]).R_base_sensor, turns)
    assert len(found) == 3
    assert all("its rotation was not determined" in u.sentence for u in found)


def test_sentences_name_sensor_axis_base_and_remedy():
    found = shifts_left_open(steps_of("planar", 0, RIG[:2], cameras=()), RIG[:2])
    assert [u.sentence.split(":")[0] for u in found] == ["the position of s1 along z of s0 was not determined"]
    assert "ramp" in found[0].sentence


def times_left_open(kind, seed, clocks=("s0", "s1"), seconds=100):
    sensors = [SimulatedSensor(f"s{i}", T, sigma=tuple(SIGMA)) for i, T in enumerate(RIG[: len(clocks)])]
    chains = [sync.chain(m) for m in drive(path(seconds, seed, kind), sensors, seed).values()]
    return [u.direction for u in observability.unmeasured_times([s.name for s in sensors], chains, clocks)]


@pytest.mark.parametrize("seed", seeds(3, 6))
def test_time_shows_in_changing_turns_only(seed):
    assert times_left_open("street", seed) == []
    assert times_left_open("planar", seed) == []
    for kind in ("straight", "turn", "static"):
        assert times_left_open(kind, seed) == [{"s1.dt": 1.0}]


def test_a_clock_is_measured_if_one_of_its_sensors_is_and_the_bases_always():
    assert times_left_open("static", 0, ("a", "a", "b")) == [{"s2.dt": 1.0}]
    assert times_left_open("street", 0, ("a", "b", "b")) == []


def test_few_but_excellent_motions_are_enough():
    """Twenty large turns of a hand-held rig, noise a ten-thousandth of them, leave nothing open."""
    rng, T = np.random.default_rng(1), pose(0.3, 0.2, 0.1, 10, 20, 120)
    base = se3.matrix(rng.normal(size=(20, 6)) * 0.4)
    vec = np.array([se3.vector(base), se3.vector(se3.invert(T) @ base @ T)])
    vec += 1e-5 * rng.normal(size=vec.shape)
    stamps = np.arange(21.0)
    cov = np.broadcast_to(1e-10 * np.eye(6), (2, 20, 6, 6))
    steps = Steps(np.stack([stamps[:-1], stamps[1:]], axis=1), vec, cov, np.array([True, True]))
    R = np.stack([np.eye(3), T[:3, :3]])
    assert observability.unmeasured_turns(["s0", "s1"], steps, R) == []
    assert observability.unmeasured_shifts(["s0", "s1"], steps, R, []) == []


@pytest.mark.parametrize("seed", seeds(2, 8))
def test_a_tenth_of_wrong_readings_hides_nothing_and_feigns_nothing(seed):
    sensors = [SimulatedSensor(f"s{i}", T, sigma=tuple(SIGMA), outliers=0.1) for i, T in enumerate(RIG[:2])]
    for kind, times, turns in (("street", 0, 0), ("planar", 0, 1), ("static", 1, 3)):
        chains = [sync.chain(m) for m in drive(path(100, seed, kind), sensors, seed).values()]
        assert len(observability.unmeasured_times(["s0", "s1"], chains, ("a", "b"))) == times
        assert len(turns_left_open(sync.synchronise(chains))) == turns


@pytest.mark.parametrize("kind", ["static", "straight"])
@pytest.mark.parametrize("seed", range(2))
def test_a_third_of_wrong_readings_feigns_nothing(kind, seed):
    """Two sensors that are wrong at the same time now and then agree by chance."""
    sensors = [SimulatedSensor(f"s{i}", T, sigma=tuple(SIGMA), outliers=0.3) for i, T in enumerate(RIG[:2])]
    chains = [sync.chain(m) for m in drive(path(100, seed, kind), sensors, seed).values()]
    assert len(observability.unmeasured_times(["s0", "s1"], chains, ("a", "b"))) == 1
    assert len(turns_left_open(sync.synchronise(chains))) == 3
