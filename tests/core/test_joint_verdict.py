"""What a drive left open, against the true motion's own null space; in words; and which clocks it told."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest
from builders import CAMERA, INS, LIDAR, drive, in_base, known_times, pose
from numpy.testing import assert_allclose

from calib_toolkit import se3, sync
from calib_toolkit.joint import start, told, turning, verdict
from calib_toolkit.joint.clocks import Clocks, Late
from calib_toolkit.joint.model import read
from calib_toolkit.joint.readings import ready
from calib_toolkit_datasets.simulated import SimulatedSensor, path
from calib_toolkit_datasets.simulation.vehicle import GRID, MARGIN, TruePath

SIGMA = np.array([0.01, 0.01, 0.01, 5e-4, 5e-4, 5e-4])
RIG = (LIDAR, INS, CAMERA)
NAMES = ("velo", "ins", "cam")
CONSTANT = "straight-constant"
VAGUE = 0.5
"""Sigma in metres, or their worth in radians, from which a direction may be called open."""
KINDS = ("static", CONSTANT, "straight", "turn", "planar", "street")


@pytest.fixture(scope="module")
def bound():
    file = Path(__file__).parents[2] / "docs/results/bound.py"
    spec = importlib.util.spec_from_file_location("bound_of_drives", file)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def drive_of(kind, seed, seconds=60):
    if kind != CONSTANT:
        return path(seconds, seed, kind)
    stamps = np.arange(-MARGIN, seconds + MARGIN, GRID)
    ahead = np.column_stack([9.0 * stamps, np.zeros((len(stamps), 2))])
    return TruePath(stamps, se3.rigid(np.broadcast_to(np.eye(3), (len(stamps), 3, 3)), ahead))


def steps_of(kind, seed, mounts=RIG):
    return known_times(drive_of(kind, seed), mounts, SIGMA, seed, [i for i, T in enumerate(mounts) if T is CAMERA])


def spaces(bound, kind, seed, mounts, i):
    """What the true motion tells nothing of about a sensor's pose, and what nothing or less than ``VAGUE``.

    Orthonormal rows (k, 6) each, in ``verdict.UNITS``.
    """
    sensors = [
        SimulatedSensor(f"s{k}", mounts[k], sigma=tuple(SIGMA), has_scale=mounts[k] is not CAMERA) for k in (0, i)
    ]
    poses = bound.information(drive_of(kind, seed), sensors)[:6, :6] * np.outer(verdict.UNITS, verdict.UNITS)
    values, vectors = np.linalg.eigh(poses)
    return vectors.T[values < 1e-4], vectors.T[values < VAGUE**-2]


def check_open(found, nothing, vague):
    """found: (6, k). All of which nothing is told was found, and what was found beyond that is vague."""
    assert len(nothing) <= found.shape[1] <= len(vague)
    assert np.linalg.norm(nothing.T - found @ (found.T @ nothing.T), 2) < 0.1 if len(nothing) else True
    assert np.linalg.norm(found - vague.T @ (vague @ found), 2) < 0.1 if found.size else True


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("kind", KINDS)
def test_what_is_untold_is_the_null_space_of_the_true_motion(bound, kind, seed):
    steps = steps_of(kind, seed)
    found = verdict.untold(steps, in_base(RIG))
    for i in (1, 2):
        check_open(found[i - 1], *spaces(bound, kind, seed, RIG, i))


@pytest.mark.parametrize("kind", ["straight", "turn", "planar", "street"])
def test_so_it_is_with_poses_that_were_found(bound, kind):
    steps = steps_of(kind, 3)
    T = start.poses(steps)
    T[1:] = [verdict.nearest(*both) for both in zip(T[1:], verdict.untold(steps, T), strict=True)]
    for i, found in enumerate(verdict.untold(steps, T), start=1):
        check_open(found, *spaces(bound, kind, 3, RIG, i))


def test_directions_are_the_drives_not_the_axes():
    base = pose(0, 0, 1, 35, -20, 60)
    (found,) = verdict.untold(steps_of("planar", 0, (base, INS)), in_base((base, INS)))
    assert_allclose(np.abs(found[:3, 0]), np.abs(base[2, :3]), atol=0.03)


@pytest.mark.parametrize("kind", ["planar", "street"])
@pytest.mark.parametrize("stated", [0.01, 100.0])
def test_stated_noise_changes_no_verdict(kind, stated):
    steps = steps_of(kind, 1)
    other = sync.Steps(steps.ends, steps.vec, steps.cov * stated**2, steps.has_scale)
    counts = [[v.shape[1] for v in verdict.untold(s, in_base(RIG))] for s in (steps, other)]
    assert counts[0] == counts[1]


def test_what_was_left_open_is_weak_and_the_rest_strong():
    T = in_base(RIG)
    planar, street = (verdict.strengths(steps_of(kind, 1), T) for kind in ("planar", "street"))
    assert_allclose(planar[0], 1.0)
    assert planar[1, 2] < 0.1 < 0.9 < planar[1, 0]
    assert np.all(planar[1, 3:] > 0.9)
    assert street[1].min() > 0.3
    assert np.all((street >= 0) & (street <= 1))


# ---- the nearest pose that is as good


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("kind", ["straight", "turn", "planar"])
def test_the_nearest_pose_reads_the_same(bound, kind, seed):
    """Anywhere along what is open, the readings predicted are those at the true pose; after it, too."""
    stamps = np.arange(0.0, 50.0, 0.5)
    poses = drive_of(kind, seed).at(stamps) @ LIDAR
    vec = se3.vector(se3.relative(poses[:-1], poses[1:]))
    J = se3.left_jacobian(vec[:, 3:])
    twist = np.column_stack([np.linalg.solve(J, vec[:, :3, None])[..., 0], vec[:, 3:]])
    T, open_ = in_base((LIDAR, INS))[1], spaces(bound, kind, seed, (LIDAR, INS), 1)[0].T
    there = verdict.nearest(T, open_)
    before, after = (read(pose, np.zeros(3), twist)[0] for pose in (T, there))
    assert_allclose(after, before, atol=3e-3 if kind == "turn" else 1e-6)
    # shifts that are open are gone
    shifts = [v for v in open_.T if np.abs(v[3:]).max() < 1e-6]
    assert_allclose([v[:3] @ there[:3, 3] for v in shifts], 0.0, atol=1e-6)
    assert np.linalg.norm(there[:3, 3]) <= np.linalg.norm(T[:3, 3]) + 1e-6


def test_the_nearest_pose_along_nothing_is_the_pose_itself():
    T = in_base((LIDAR, INS))[1]
    assert_allclose(verdict.nearest(T, np.zeros((6, 0))), T)


def test_turning_about_a_far_point_is_an_arc():
    """So far that a straight line would have left it: 5 m off, about a point 20 m aside."""
    centre, turn = np.array([0.0, 20.0, 0.0]), np.array([0.0, 0.0, 1.0])
    T = se3.rigid(se3.exp_so3([0.1, 0.2, 0.3]), np.array([0.4, 0.3, -0.2]))
    far = se3.rigid(se3.exp_so3(0.25 * turn), np.zeros(3))
    there = se3.rigid(far[:3, :3] @ T[:3, :3], centre + far[:3, :3] @ (T[:3, 3] - centre))
    v = np.concatenate([np.cross(turn, there[:3, 3] - centre), turn / 0.1])
    back = verdict.nearest(there, (v / np.linalg.norm(v))[:, None])
    assert np.linalg.norm(there[:3, 3]) > 4
    assert np.linalg.norm(back[:3, 3]) < 0.6
    radius = [np.linalg.norm(pose[:2, 3] - centre[:2]) for pose in (there, back)]
    assert radius[0] == pytest.approx(radius[1], abs=0.05)


# ---- in words

REMEDIES = {
    "static": ["hardly moved", "bends to both sides", "ramp"],
    "straight": ["bends to both sides"],
    "turn": ["bends to both sides", "straight on"],
    "planar": ["ramp", "speed bump", "--prior"],
}


@pytest.mark.parametrize(("kind", "words"), REMEDIES.items())
def test_words_say_what_was_not_told_and_what_to_drive(kind, words):
    directions = verdict.untold(steps_of(kind, 0), in_base(RIG))[0]
    found = verdict.in_words("velo", "ins", directions)
    assert len(found) == directions.shape[1]
    everything = " ".join(u.sentence for u in found)
    for word in words:
        assert word in everything
    for u in found:
        assert "of ins" in u.sentence
        assert "not determined" in u.sentence
        assert all(key.startswith("ins.") for key in u.direction)
        assert np.linalg.norm(list(u.direction.values())) == pytest.approx(1.0)


def test_a_flat_drive_leaves_the_height_open_by_name():
    (u,) = verdict.in_words("velo", "ins", verdict.untold(steps_of("planar", 0), in_base(RIG))[0])
    assert u.direction == {"ins.z": pytest.approx(1.0)}
    assert u.sentence.startswith("the position of ins along z of velo was not determined: the vehicle turned about")


def test_a_circle_leaves_the_turn_about_its_centre_open_by_name():
    found = verdict.in_words("velo", "ins", verdict.untold(steps_of("turn", 0), in_base(RIG))[0])
    (mixed,) = [u for u in found if "against turning it" in u.sentence]
    assert "about z of velo through the point (" in mixed.sentence
    point = np.array([float(x) for x in mixed.sentence.split("point (")[1].split(")")[0].split(",")])
    assert_allclose(point[:2], [0.0, 20.0], atol=1.5)  # 6 m/s at 0.3 rad/s, to the left


def test_sensors_without_scale_have_no_positions():
    found = verdict.without_scale(("cam0", "cam1"))
    assert [u.direction for u in found] == [{f"cam1.{axis}": 1.0} for axis in "xyz"]
    assert all("add a lidar" in u.sentence for u in found)


# ---- clocks

OFFSETS = (0.0, 0.02, -0.03)


def clocks_of(kind, count=2, clocks=NAMES, known=(), seconds=12):
    """What a short drive tells of the clocks of so many sensors."""
    sensors = [
        SimulatedSensor(name, T, dt=dt, rate=rate, has_scale=T is not CAMERA)
        for name, T, dt, rate in zip(NAMES, RIG, OFFSETS, (10.0, 12.5, 10.0), strict=True)
    ]
    motions = [ready(m) for m in drive(drive_of(kind, 1, seconds), sensors[:count], 1).values()]
    chains = [sync.chain(m) for m in motions]
    first = Clocks.starting(clocks[:count], start.lags(chains), seconds / 2)
    on_base = [c.shifted(first.dt[k]) for c, k in zip(chains, first.of, strict=True)]
    R = start.poses(sync.synchronise(on_base, 100.0))[:, :3, :3]
    return told.estimate(motions, turning.estimate(motions, R, first, known), known)


@pytest.mark.parametrize("kind", ["street", "planar"])
def test_turning_at_changing_speed_tells_all_clocks(kind):
    found = clocks_of(kind, 3, seconds=30)
    assert not found.open.any()
    error = found.clocks.dt[1:] - OFFSETS[1:]
    sigma = np.sqrt(np.diag(found.cov)[:2])
    assert np.all(np.abs(error) < 4.5 * sigma)
    assert np.all(sigma < 0.005)


@pytest.mark.parametrize("kind", ["static", CONSTANT, "turn"])
def test_at_constant_speed_no_clock_is_told_and_it_is_taken_as_it_is(kind):
    found = clocks_of(kind)
    assert list(found.open) == [False, True]
    assert_allclose(found.clocks.dt, 0.0)
    assert_allclose(found.clocks.skew, 0.0)
    assert_allclose(found.cov, 0.0)


def test_straight_on_at_changing_speed_tells_the_clocks_of_sensors_with_scale():
    found = clocks_of("straight", 3, seconds=30)
    assert list(found.open) == [False, False, True]
    sigma = np.sqrt(found.cov[0, 0])
    assert 0 < sigma < 0.15
    assert abs(found.clocks.dt[1] - OFFSETS[1]) < 3 * sigma
    assert found.clocks.dt[2] == found.cov[1, 1] == 0.0


def test_a_number_tells_a_clock_that_the_drive_does_not():
    found = clocks_of("static", known=[Late(1, -0.03, 0.001)])
    assert list(found.open) == [False, False]
    assert found.clocks.dt[1] == pytest.approx(-0.03, abs=1e-3)
    assert np.sqrt(found.cov[0, 0]) == pytest.approx(0.001, rel=0.1)


def test_sensors_on_the_bases_clock_are_told():
    assert list(clocks_of("static", clocks=("a", "a")).open) == [False]


def test_an_open_clock_is_named():
    u = verdict.clock("cam0")
    assert u.direction == {"cam0.dt": 1.0}
    assert "the clock offset of cam0 was not determined" in u.sentence
    assert "changing speed" in u.sentence
