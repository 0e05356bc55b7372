"""The map metric on ray-cast walks through a yard whose path, mounts and clocks are known exactly."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from calib_toolkit import DataError, Motions, NoOptions, Pair, Scan, Stream, Trajectory, Transform, se3
from calib_toolkit_plugins.metrics import map as map_
from calib_toolkit_plugins.metrics.map import Map
from calib_toolkit_plugins.metrics.map_scans import Sweep, misfit, straighten

Array = NDArray[np.float64]

SECONDS, PERIOD = 10.0, 0.2
BEAMS, COLUMNS = 24, 240
GROUND = -0.1
T_INS_LIDAR = se3.matrix([0.8, -0.3, 0.9, 0.01, -0.02, 0.7])
T_FRONT_REAR = se3.matrix([-1.5, 0.2, -0.1, 0.02, 0.01, 3.1])
CLOCK = 0.03
ANYWHERE, AHEAD = np.pi, np.radians(85)
SIGMA = np.repeat([0.1, np.radians(0.3)], 3)


def yard() -> Array:
    """(n, 6) boxes: centre and half sizes."""
    rng = np.random.default_rng(5)
    n = 26
    spots = np.column_stack(
        [rng.uniform(-25, 85, n), rng.choice([-1, 1], n) * rng.uniform(7, 18, n), np.full(n, 1.5)]
    )
    return np.vstack(
        [np.hstack([spots, rng.uniform([0.5, 0.5, 1.6], [3, 3, 4], (n, 3))]), [30.0, 26.0, 3.0, 80.0, 1.0, 4.0]]
    )


BOXES = yard()


def path(t: Array, bumps: float = 1.0) -> Array:
    """(n, 4, 4) poses in the world at seconds t: a winding way, with pitch and roll."""
    yaw = 0.6 * np.sin(1.1 * t)
    place = np.stack([6.0 * t, 2.0 * np.sin(0.5 * t), 0.05 * bumps * np.sin(3.0 * t)], axis=-1)
    tilt = bumps * np.stack([0.03 * np.sin(5.0 * t), 0.04 * np.sin(6.3 * t + 1.0), 0 * t], axis=-1)
    turn = np.stack([0 * t, 0 * t, yaw], axis=-1)
    return se3.rigid(se3.exp_so3(turn) @ se3.exp_so3(tilt), place)


def sweep(
    T_path_lidar: Array, t: float, half_view: float, bumps: float, columns: int, rng: np.random.Generator
) -> Scan:
    """One turn, its points in the axes of their instants."""
    azimuth = np.linspace(-np.pi, np.pi, columns, endpoint=False)
    part = -azimuth / (2 * np.pi) * PERIOD
    elevation = np.radians(np.linspace(-22, 6, BEAMS))
    a, e = (m.ravel() for m in np.meshgrid(azimuth, elevation, indexing="ij"))
    rays = np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], axis=1)
    T = np.repeat(path(t + part, bumps) @ T_path_lidar, len(elevation), axis=0)
    origin, beam = T[:, :3, 3], np.einsum("nij,nj->ni", T[:, :3, :3], rays)
    distance = np.where(beam[:, 2] < 0, (GROUND - origin[:, 2]) / beam[:, 2], np.inf)
    level = np.linalg.norm(beam[:, :2], axis=1)
    for box in BOXES:
        x, y = (box[:2] - origin[:, :2]).T
        near = np.abs(beam[:, 0] * y - beam[:, 1] * x) <= np.hypot(*box[3:5]) * level  # others pass it by
        one, other = ((box[:3] + s * box[3:] - origin[near]) / beam[near] for s in (-1, 1))
        enter, leave = np.minimum(one, other).max(axis=1), np.maximum(one, other).min(axis=1)
        hit = (enter < leave) & (enter > 0) & (enter < distance[near])
        distance[near] = np.where(hit, enter, distance[near])
    seen = (distance < 60.0) & (np.abs(a) < half_view)
    distance = np.where(seen, distance, 0.0)
    points = rays * (distance + 0.01 * rng.standard_normal(len(a)))[:, None]
    return Scan(points[seen].astype(np.float32), np.repeat(part, len(elevation))[seen].astype(np.float32))


def lidar(name: str, T: Array, dt: float, seed: int, half_view: float = ANYWHERE, bumps: float = 1.0) -> Stream:
    rng = np.random.default_rng(seed)
    true = np.arange(0.3, SECONDS - 0.3, PERIOD)
    columns = COLUMNS if half_view == ANYWHERE else 3 * COLUMNS // 2
    return Stream(name, "velodyne", true - dt, [sweep(T, t, half_view, bumps, columns, rng) for t in true])


def motion(T: Array, rate: float, bumps: float, noise: float, seed: int = 1) -> tuple[Array, Motions]:
    """Stamps and steps of a sensor mounted at T, whose errors add up."""
    t = np.arange(0.0, SECONDS, 1 / rate)
    vec = se3.vector(se3.relative(path(t[:-1], bumps) @ T, path(t[1:], bumps) @ T))
    sigma = np.repeat([noise, noise / 30], 3) / np.sqrt(rate)
    vec = vec + sigma * np.random.default_rng(seed).standard_normal(vec.shape)
    return t, Motions(t[:-1], t[1:], vec, np.tile(np.diag(sigma**2), (len(vec), 1, 1)))


def off(T: Array, seed: int) -> Array:
    error = SIGMA * np.random.default_rng(seed).standard_normal(6)
    return se3.rigid(se3.exp_so3(error[3:]) @ T[:3, :3], T[:3, 3] + error[:3])


def with_ins(bumps: float) -> Pair:
    """An INS and a lidar whose clock is late, the mount known to a decimetre."""
    stamps, steps = motion(np.eye(4), 50.0, bumps, 0.002)
    ins = Stream("ins", "gps_ins", stamps, [None] * len(stamps))
    velo = lidar("velo", T_INS_LIDAR, CLOCK, 2, bumps=bumps)
    rows = np.arange(5, len(velo) - 5, 4)
    selected = np.column_stack([np.searchsorted(stamps, velo.stamps[rows] + CLOCK), rows])
    prior = Transform("ins", "velo", off(T_INS_LIDAR, 3), np.diag(SIGMA**2))
    return Pair(ins, velo, steps, steps, CLOCK, selected, prior)


def two_lidars() -> Pair:
    """One looks ahead and one back, and neither sees what the other sees at that moment."""
    _, steps = motion(np.eye(4), 10.0, 1.0, 0.002)
    front = lidar("front", np.eye(4), 0.0, 6, AHEAD)
    rear = lidar("rear", T_FRONT_REAR, CLOCK, 7, AHEAD)
    rows = np.arange(2, len(rear) - 2, 2)
    selected = np.column_stack([rows, rows])
    prior = Transform("front", "rear", off(T_FRONT_REAR, 4), np.diag(SIGMA**2))
    return Pair(front, rear, steps, steps, CLOCK, selected, prior)


def swapped(pair: Pair) -> Pair:
    T = pair.prior.T_a_b
    J = se3.relative_jacobians(T, np.eye(4))[0]
    prior = Transform(pair.b.name, pair.a.name, se3.invert(T), J @ pair.prior.cov @ J.T)
    return Pair(pair.b, pair.a, pair.motion_b, pair.motion_a, -pair.dt_a_b, pair.selected[:, ::-1], prior)


def error(found: Transform, T_true: Array) -> Array:
    """``(dt, delta)``, axes of a."""
    turned = se3.log_so3(T_true[:3, :3] @ found.T_a_b[:3, :3].T)
    return np.concatenate([T_true[:3, 3] - found.T_a_b[:3, 3], turned])


@pytest.fixture(scope="module")
def bumpy():
    pair = with_ins(1.0)
    return pair, Map().estimate(pair, NoOptions())


@pytest.fixture(scope="module")
def rig():
    return two_lidars()


def test_it_takes_a_lidar_and_something_that_has_a_path():
    metric = Map()
    assert metric.accepts("velodyne", "gps_ins")
    assert metric.accepts("odometry", "velodyne")
    assert metric.accepts("velodyne", "velodyne")
    assert not metric.accepts("velodyne", "monocular")
    assert not metric.accepts("gps_ins", "odometry")


def test_a_lidar_finds_its_mount_on_an_ins_height_included(bumpy):
    pair, found = bumpy
    assert found.converged
    e = error(found.transform, T_INS_LIDAR)
    assert np.all(np.abs(e[:3]) < 0.02)
    assert np.all(np.abs(e[3:]) < np.radians(0.05))
    assert np.linalg.norm(error(pair.prior, T_INS_LIDAR)[:3]) > 0.1
    sigma = np.sqrt(np.diag(found.transform.cov))
    assert np.all(np.abs(e) < 4 * sigma)
    assert np.all(sigma < [0.02, 0.02, 0.03, 2e-3, 2e-3, 2e-3])


def test_the_other_order_gives_the_inverse(bumpy):
    pair, found = bumpy
    other = Map().estimate(swapped(pair), NoOptions())
    assert (other.transform.a, other.transform.b) == ("velo", "ins")
    J = se3.relative_jacobians(found.transform.T_a_b, np.eye(4))[0]
    assert np.allclose(other.transform.T_a_b, se3.invert(found.transform.T_a_b), atol=2e-4)
    assert np.allclose(other.transform.cov, J @ found.transform.cov @ J.T, rtol=0.1, atol=1e-6)
    assert np.linalg.norm(other.by_clock + J @ found.by_clock) < 0.4 * np.linalg.norm(found.by_clock)


def test_an_error_of_the_clock_moves_the_estimate_as_it_says(bumpy):
    pair, found = bumpy
    late = Map().estimate(replace(pair, dt_a_b=pair.dt_a_b + 4e-3), NoOptions())
    moved = -error(late.transform, found.transform.T_a_b)
    weighed = np.linalg.cholesky(np.linalg.inv(found.transform.cov)).T
    assert np.linalg.norm(weighed @ moved) > 3.0
    assert np.linalg.norm(weighed @ (moved - 4e-3 * found.by_clock)) < 0.4 * np.linalg.norm(weighed @ moved)


def test_a_search_that_runs_out_of_rounds_says_so_and_is_as_near_as_it_got(bumpy, monkeypatch):
    pair, found = bumpy
    monkeypatch.setattr(map_, "ROUNDS", 6)
    stopped = Map().estimate(pair, NoOptions())
    assert not stopped.converged
    assert stopped.note == "its search did not come to rest within 6 rounds"
    off = error(stopped.transform, found.transform.T_a_b)
    assert np.all(np.abs(off) < 0.5 * np.sqrt(np.diag(found.transform.cov)))


def test_a_plane_leaves_the_height_open_and_the_prior_does_not_fill_it():
    pair = with_ins(0.0)
    found = Map().estimate(pair, NoOptions())
    sigma = np.sqrt(np.diag(found.transform.cov))
    assert sigma[2] > 0.5
    assert np.all(sigma[:2] < 0.3)
    assert np.all(sigma[3:] < np.radians(0.2))


def test_the_attitude_that_an_ins_states_is_not_averaged_away(bumpy):
    pair, found = bumpy
    t = np.arange(0.0, SECONDS, 0.02)
    cov = np.diag([1e-4, 1e-4, 1e-4, 1e-6, 1e-6, 4e-6])
    poses = Trajectory(t, path(t), np.tile(cov, (len(t), 1, 1)), np.zeros((len(t), 6, 6)))
    stated = Map().estimate(replace(pair, motion_a=poses), NoOptions())
    assert np.sqrt(stated.transform.cov[5, 5]) > 1.9e-3 > np.sqrt(found.transform.cov[5, 5])


def test_two_lidars_that_look_apart_meet_in_the_map(rig):
    assert Map().overlap(rig)
    found = Map().estimate(rig, NoOptions())
    assert found.converged
    e = error(found.transform, T_FRONT_REAR)
    assert np.all(np.abs(e[:3]) < 0.02)
    assert np.all(np.abs(e[3:]) < np.radians(0.1))
    assert np.all(np.abs(e) < 4 * np.sqrt(np.diag(found.transform.cov)))


def patch(first: float, last: float, height: float, seed: int) -> Sweep:
    """Level ground from ``first`` to ``last`` metres ahead, 20 m wide."""
    rng = np.random.default_rng(seed)
    xy = rng.uniform([first, -10.0], [last, 10.0], (8000, 2))
    points = np.column_stack([xy, height + 0.01 * rng.standard_normal(len(xy))])
    return Sweep(points.astype(np.float32), np.full(len(xy), 1.0), 1.0)


@pytest.mark.parametrize(("first", "seen_twice"), [(4.0, True), (10.1, False)])
def test_ground_that_only_adjoins_is_not_seen_twice(first, seen_twice):
    _, steps = motion(np.eye(4), 10.0, 1.0, 0.0)
    near = straighten(patch(2.0, 10.0, -1.5, 1), steps, np.eye(4))
    far = straighten(patch(first, 18.0, -1.4, 2), steps, np.eye(4))
    found = misfit(near, far, np.eye(4), 0.5)
    assert (found is not None) == seen_twice


def test_lidars_whose_scans_lie_far_apart_do_not_overlap(rig):
    away = se3.matrix([0.0, 0.0, 40.0, 0.0, 0.0, 0.0])
    assert not Map().overlap(replace(rig, prior=replace(rig.prior, T_a_b=away)))


def test_too_few_places_are_refused(bumpy):
    pair, _ = bumpy
    found = Map().estimate(pair[:3], NoOptions())
    assert not found.converged
    assert "3 places" in found.note


def test_scans_without_points_are_refused(bumpy):
    pair, _ = bumpy
    empty = [Scan(np.zeros((0, 3), dtype=np.float32))] * len(pair.b)
    found = Map().estimate(replace(pair, b=replace(pair.b, readings=empty)), NoOptions())
    assert not found.converged
    assert "enough points" in found.note


def test_a_reading_that_is_no_scan_is_named(bumpy):
    pair, _ = bumpy
    with pytest.raises(DataError, match=r"velo, scan \d+"):
        Map().estimate(replace(pair, b=replace(pair.b, readings=["picture"] * len(pair.b))), NoOptions())
