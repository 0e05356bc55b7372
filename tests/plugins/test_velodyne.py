"""The velodyne sensor on ray-cast streets with known motion, and on real sweeps."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from ray_cast_streets import FORWARD, GROUND, PERIOD, Array, drive, forward, street, sweep, swept

from calib_toolkit import DataError, Motions, Scan, Stream, se3
from calib_toolkit_plugins import registration
from calib_toolkit_plugins.velodyne import VelodyneOptions, estimate

TUNNEL = np.array([[0.0, side, 2.0, 150.0, 1.0, 6.0, 0.0] for side in (-9.0, 9.0)])


@pytest.fixture
def stream() -> Stream:
    return forward()


@pytest.fixture(scope="module")
def motions() -> Motions:
    return estimate(forward(), VelodyneOptions())


def test_motion_is_found_to_millimetres(stream: Stream, motions: Motions) -> None:
    error = np.abs(motions.vec - FORWARD)
    assert np.array_equal(motions.start, stream.stamps[:-1])
    assert np.array_equal(motions.end, stream.stamps[1:])
    assert error[:, :3].max() < 0.008
    assert error[:, 3:].max() < 0.0008


def test_moving_points_to_the_stamp_matters(stream: Stream, motions: Motions) -> None:
    raw = estimate(stream, VelodyneOptions(deskew=False))
    backward = [replace(s, times=-s.times) for s in stream.readings]
    wrong_way = estimate(replace(stream, readings=backward), VelodyneOptions())
    error, without, wrong = (np.abs(m.vec - FORWARD)[:, :3].max() for m in (motions, raw, wrong_way))
    assert without > 2 * error
    assert wrong > 2 * error


def test_wobble_does_not_show() -> None:
    """Pitch that swings within 0.6 s: how fast it changes in the middle of a sweep, and how that changes, counts."""
    boxes, rng, readings, poses = street(5), np.random.default_rng(0), [], []
    for phase in 2 * np.pi / 6 * np.arange(12):
        pitch, rate, more = (
            0.02 * np.array([np.sin(phase), np.cos(phase), -np.sin(phase)]) * (np.pi / 3) ** np.arange(3)
        )
        poses.append(se3.matrix(np.array([1.2 * len(poses), 0, 0, 0, pitch, 0])))
        step = np.array([1.2 * np.cos(pitch), 0, 1.2 * np.sin(pitch), 0, rate, 0])
        readings.append(sweep(boxes, poses[-1], step, rng, 0.02, more=more * np.eye(6)[4]))
    wobbling = Stream("velo", "velodyne", PERIOD * np.arange(12), readings)
    steps = se3.vector(se3.relative(np.array(poses[:-1]), np.array(poses[1:])))
    error = np.sqrt(np.mean((estimate(wobbling, VelodyneOptions()).vec - steps)[1:-1, 3:] ** 2))
    assert error < 0.0004  # 0.00047 if each sweep is taken to turn evenly


def test_the_swing_of_a_mast_shows() -> None:
    """A vehicle that rolls and pitches about the ground: its lidar swings by all of its height."""
    mast = np.array([0.0, 0.0, -GROUND])

    def path(part: Array) -> Array:
        t = PERIOD * part
        roll, pitch = 0.01 * np.sin(2 * np.pi * 1.7 * t), 0.012 * np.sin(2 * np.pi * 2.3 * t + 1)
        T = se3.matrix(np.stack([8 * t, 0 * t, 0 * t, roll, pitch, 0 * t], axis=1))
        T[:, :3, 3] += T[:, :3, :3] @ mast - mast
        return T

    rng = np.random.default_rng(0)
    scans = [swept(street(5), lambda part, k=k: path(part + k), rng, 0.02) for k in range(16)]
    found = estimate(Stream("velo", "velodyne", PERIOD * np.arange(16), scans), VelodyneOptions()).vec
    poses = path(np.arange(16.0))
    true = se3.vector(se3.relative(poses[:-1], poses[1:]))
    swing = true[:, [0, 1]] - [0.8, 0.0]
    shown = np.sum((found[:, [0, 1]] - [0.8, 0.0]) * swing, axis=0) / np.sum(swing**2, axis=0)
    assert np.all(np.abs(shown - 1) < 0.03), shown  # 0.92 and 0.95 if only turns change within a sweep
    assert np.sqrt(np.mean((found - true)[1:-1, 3:5] ** 2)) < 0.0003  # 0.00042


def test_few_beams_show_roll_and_pitch() -> None:
    """Rings that are laid on those of the sweep before would follow the scanner instead of the ground."""
    rng, turns = np.random.default_rng(0), np.random.default_rng(1).normal(0.0, 0.004, (14, 2))
    steps = np.array([[0.8, 0, 0, *turn, 0] for turn in np.diff(turns, axis=0)])
    poses = [se3.matrix(np.array([0, 0, 0, *turns[0], 0]))]
    for step in steps:
        poses.append(poses[-1] @ se3.matrix(step))
    readings = [sweep(street(5), T, np.array([0.8, 0, 0, 0, 0, 0]), rng, 0.01, rings=8) for T in poses]
    found = estimate(Stream("velo", "velodyne", PERIOD * np.arange(14), readings), VelodyneOptions()).vec
    shown = np.sum(found[:, 3:5] * steps[:, 3:5], axis=0) / np.sum(steps[:, 3:5] ** 2, axis=0)
    assert np.all(shown > 0.9)  # 0.43 when laid on one sweep


def test_motion_seems_later_the_further_what_is_seen_is_from_the_stamp(stream: Stream) -> None:
    ahead = [Scan(s.points[s.times > 0.01], s.times[s.times > 0.01]) for s in stream.readings]
    whole, part = (estimate(replace(stream, readings=r), VelodyneOptions()).late for r in (stream.readings, ahead))
    assert whole == pytest.approx(0.001, rel=0.2)
    assert part == pytest.approx(0.006, rel=0.2)


@pytest.mark.parametrize("step", [[3.0, 0.05, 0.0, 0.002, 0.004, 0.09], [0.0] * 6, [-1.0, 0, 0, 0, 0, -0.03]])
def test_a_slice_starts_from_nothing(step: list[float]) -> None:
    motions = estimate(drive(street(2), np.array(step), 2), VelodyneOptions())
    assert len(motions) == 1
    assert np.abs(motions.vec[0] - step).max() < 0.01


def test_slices_agree_with_the_whole(stream: Stream, motions: Motions) -> None:
    tail = estimate(stream[2:], VelodyneOptions())
    assert np.abs(tail.vec - motions.vec[2:]).max() < 0.005


def test_same_input_same_output(stream: Stream, motions: Motions) -> None:
    again = estimate(stream, VelodyneOptions())
    assert np.array_equal(again.vec, motions.vec)
    assert np.array_equal(again.cov, motions.cov)


def test_paper_minimum_is_an_option(stream: Stream, motions: Motions) -> None:
    paper = estimate(stream, VelodyneOptions(point_to_plane=True))
    assert np.abs(paper.vec - FORWARD).max() < 0.02
    assert not np.allclose(paper.vec, motions.vec, atol=1e-6)


def test_jacobian_is_the_derivative(motions: Motions, stream: Stream) -> None:
    a, b = (registration.surface(s.points.astype(float), 0.5) for s in stream.readings[:2])
    at = registration.plane_residuals(a, b.points, se3.matrix(motions.vec[0]), 0.2)

    def errors(vec: Array) -> Array:
        T = se3.matrix(vec)
        return np.einsum("ij,ij->i", at.points @ T[:3, :3].T + T[:3, 3] - at.targets, at.normals)

    steps = 1e-6 * np.eye(6)
    vec = motions.vec[0]
    numeric = np.stack([(errors(vec + d) - errors(vec - d)) / 2e-6 for d in steps], axis=1)
    assert np.allclose(errors(vec), at.errors, atol=1e-12)
    assert np.allclose(at.jacobian, numeric, atol=1e-6)


def test_covariance_is_that_of_range_noise(motions: Motions, stream: Stream) -> None:
    """Against brute force: the minimum recomputed under noise of every range, matches and normals kept."""
    a, b = (registration.surface(s.points.astype(float), 0.5) for s in stream.readings[:2])
    T = registration.point_to_plane(a, b, se3.matrix(motions.vec[0]), 0.2, iterations=10)
    at = registration.plane_residuals(a, b.points, T, 0.2)
    claimed = registration.range_covariance(at, 0.01, 3.0)
    rng = np.random.default_rng(3)
    A, R = at.jacobian, T[:3, :3]
    base = np.linalg.lstsq(A, at.errors, rcond=None)[0]
    beam_p = at.points / np.linalg.norm(at.points, axis=1, keepdims=True)
    beam_q = a.points / np.linalg.norm(a.points, axis=1, keepdims=True)
    found = []
    for _ in range(400):
        points = at.points + 0.01 * rng.standard_normal((len(at.points), 1)) * beam_p
        targets = (a.points + 0.01 * rng.standard_normal((len(a.points), 1)) * beam_q)[at.planes]
        moved = points @ R.T
        J = np.hstack([at.normals, np.cross(moved, at.normals) @ se3.left_jacobian(se3.log_so3(R))])
        errors = np.einsum("ij,ij->i", moved + T[:3, 3] - targets, at.normals)
        found.append(base - np.linalg.lstsq(J, errors, rcond=None)[0])
    ratio = np.diag(np.cov(np.array(found).T)) / np.diag(claimed)
    assert np.all((ratio > 0.75) & (ratio < 1.33)), ratio


def test_claimed_covariance_against_errors() -> None:
    """The paper's 0.1 m covers a scanner of 2 cm: mean squared error in sigmas at most the ideal 6."""
    rng = np.random.default_rng(5)
    nees = []
    for seed in range(4):
        step = np.array([rng.uniform(0.3, 2.0), *rng.normal(0, [0.02, 0.01, 0.002, 0.004, 0.02])])
        m = estimate(drive(street(seed), step, 3, seed), VelodyneOptions())
        error = m.vec - step
        nees += list(np.einsum("ni,nij,nj->n", error, np.linalg.inv(m.cov), error))
    assert len(nees) == 8
    assert 0.1 < np.median(nees) < 6.0
    assert np.mean(nees) < 12.0


def test_what_a_tunnel_hides_is_not_claimed() -> None:
    motions = estimate(drive(TUNNEL, FORWARD, 2), VelodyneOptions())
    sigma = np.sqrt(np.diagonal(motions.cov, axis1=1, axis2=2))[0]
    assert abs(motions.vec[0, 0] - FORWARD[0]) > 0.5, "a bare tunnel shows nothing of the speed"
    assert sigma[0] > 2.0
    assert np.all(sigma[2:] < 0.02)


def test_failed_steps_are_left_out(stream: Stream) -> None:
    elsewhere = drive(street(9), FORWARD, 2, seed=4)
    few = Scan(stream.readings[1].points[:100], stream.readings[1].times[:100])
    readings = [*stream.readings[:3], *elsewhere.readings, few, *elsewhere.readings]
    motions = estimate(Stream("velo", "velodyne", PERIOD * np.arange(8), readings), VelodyneOptions())
    assert np.allclose(motions.start, [0.0, 0.1, 0.3, 0.6])
    assert np.abs(motions.vec - FORWARD).max() < 0.02


def test_a_jump_is_left_out() -> None:
    boxes = street(2)
    rng = np.random.default_rng(0)
    places = [0.0, 0.2, 0.4, 2.9, 3.1]
    poses = [se3.matrix([x, 0, 0, 0, 0, 0]) for x in places]
    readings = [sweep(boxes, T, np.zeros(6), rng, 0.02) for T in poses]
    moving = Stream("velo", "velodyne", PERIOD * np.arange(5), readings)
    motions = estimate(moving, VelodyneOptions(max_jump=1.0))
    assert np.allclose(motions.start, [0.0, 0.1, 0.3])
    assert np.abs(motions.vec[:, 0] - 0.2).max() < 0.01


def test_nothing_usable_gives_no_motion() -> None:
    empty = Scan(np.zeros((0, 3), dtype=np.float32))
    assert len(estimate(Stream("velo", "velodyne", [0.0, 0.1], [empty, empty]), VelodyneOptions())) == 0


def test_nan_rows_are_dropped(stream: Stream, motions: Motions) -> None:
    def spoilt(scan: Scan) -> Scan:
        rows = np.full((50, 3), np.nan, dtype=np.float32)
        return Scan(np.vstack([rows, scan.points]), np.concatenate([np.full(50, np.nan, np.float32), scan.times]))

    dirty = replace(stream, readings=[spoilt(s) for s in stream.readings])
    assert np.allclose(estimate(dirty, VelodyneOptions()).vec, motions.vec, atol=1e-9)


def test_scans_without_times_are_registered_as_they_are(stream: Stream) -> None:
    timeless = replace(stream, readings=[Scan(s.points) for s in stream.readings[:2]], stamps=stream.stamps[:2])
    assert np.abs(estimate(timeless, VelodyneOptions()).vec - FORWARD).max() < 0.1


def test_one_scan_is_refused(stream: Stream) -> None:
    with pytest.raises(DataError, match=r"sensor velo: a motion takes two scans, and there are 1"):
        estimate(stream[:1], VelodyneOptions())


@pytest.mark.parametrize(
    ("reading", "sentence"),
    [
        (np.zeros((5, 3)), "not ndarray"),
        (Scan(np.zeros((5, 4), dtype=np.float32)), r"Scans of \(n, 3\) points"),
        (Scan(np.zeros((5, 3), dtype=np.float32), np.zeros(4, dtype=np.float32)), "4 times for 5 points"),
    ],
)
def test_what_is_not_a_scan_is_refused(stream: Stream, reading: object, sentence: str) -> None:
    wrong = replace(stream[:2], readings=[stream.readings[0], reading])
    with pytest.raises(DataError, match=f"sensor velo, scan 1 .*{sentence}"):
        estimate(wrong, VelodyneOptions())


@pytest.fixture(scope="module")
def real(recordings: Path) -> Stream:
    """KITTI-360, about 36 km/h."""
    files = sorted((recordings / "kitti360-3000/velodyne_points/data").glob("*.bin"))
    period, readings = 0.1046, []
    for file in files:
        points = np.fromfile(file, dtype="<f4").reshape(-1, 4)[:, :3]
        times = -np.arctan2(points[:, 1], points[:, 0]) / (2 * np.pi) * period
        readings.append(Scan(points, times.astype(np.float32)))
    return Stream("velo", "velodyne", period * np.arange(len(files)), readings)


def test_real_sweeps_chain(real: Stream) -> None:
    """Two steps against the one step over both."""
    single, double = (estimate(real[part], VelodyneOptions()) for part in (slice(0, 7), slice(0, 7, 2)))
    assert (len(single), len(double)) == (6, 3)
    T = se3.matrix(single.vec)
    error = se3.vector(se3.invert(T[0::2] @ T[1::2]) @ se3.matrix(double.vec))
    assert np.all(np.abs(single.vec[:, 0] - 1.02) < 0.05)
    assert np.abs(error[:, :3]).max() < 0.04
    assert np.abs(error[:, 3:]).max() < 0.004


def test_three_metres_are_found_from_nothing(real: Stream) -> None:
    """Without the coarse cells three of these four stop short, at 1.3 to 2.1 m."""
    for k in (8, 16, 24, 32):
        pair = Stream("velo", "velodyne", [0.0, 0.1], [real.readings[k], real.readings[k + 3]])
        motions = estimate(pair, VelodyneOptions())
        assert len(motions) == 1
        assert 3.0 < motions.vec[0, 0] < 3.15


@pytest.mark.long
def test_real_steps_are_all_found_and_agree(real: Stream) -> None:
    """Over 49 steps: the rms of two steps against one, per axis."""
    single, double = (estimate(real[part], VelodyneOptions()) for part in (slice(None), slice(0, None, 2)))
    assert (len(single), len(double)) == (49, 24)
    T = se3.matrix(single.vec[:48])
    error = se3.vector(se3.invert(T[0::2] @ T[1::2]) @ se3.matrix(double.vec))
    rms = np.sqrt(np.mean(error**2, axis=0))
    assert np.all(rms < [0.015, 0.006, 0.01, 0.002, 0.002, 0.0005]), rms


def test_real_travel_is_even(real: Stream) -> None:
    """A car does not jump back and forth by a centimetre: noise of one pass that the next would add to shows so."""
    travel = estimate(real[:25], VelodyneOptions()).vec[:, 0]
    assert np.diff(travel, 2).std() / np.sqrt(6) < 0.006  # 0.0146 over 50 sweeps where travel is told to accelerate
