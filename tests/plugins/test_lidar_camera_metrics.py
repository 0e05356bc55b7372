"""The metrics of a lidar and a camera on drawn scenes: checkered walls, or boxes before a plain wall."""

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from calib_toolkit import CameraIntrinsics, CostMetric, Motions, Pair, Scan, Stream, Transform, se3
from calib_toolkit.errors import ConfigError
from calib_toolkit_plugins.metrics.gom import Gom
from calib_toolkit_plugins.metrics.im import Im
from calib_toolkit_plugins.metrics.levinson import Levinson
from calib_toolkit_plugins.metrics.nmi import Nmi, NmiOptions
from calib_toolkit_plugins.metrics.points import evened, steps_behind

Array = NDArray[np.float64]

AXES = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
TRUE = se3.rigid(AXES @ se3.exp_so3([0.01, -0.02, 0.015]), [0.2, -0.1, -0.2])
SIZE = (480, 240)
K = np.array([[300.0, 0.0, 239.5], [0.0, 300.0, 119.5], [0.0, 0.0, 1.0]])
STEP = np.array([1.2, 0.1, 0.0, 0.0, 0.0, 0.02])
"""From one image to the next."""
PERIOD = 0.1
WALL, GROUND = 14.0, -1.7
BOXES = np.array([[8.0, -4.0, 1.0], [10.0, 0.5, 1.2], [7.0, 3.0, 0.6], [11.0, 6.0, 1.0]])
"""Distance of the front, middle and width; 6 m high and 1 m deep."""
SHADES = np.random.default_rng(3).uniform(0.1, 0.9, (3, 64, 64))
METRICS: list[CostMetric] = [Nmi(), Gom(), Levinson(), Im()]


def cast(T_world_eye: Array, rays: Array, scene: str) -> tuple[Array, Array]:
    """Distances along rays (n, 3) from a pose, and how bright what they hit is."""
    origin, ray = T_world_eye[:3, 3], rays @ T_world_eye[:3, :3].T
    with np.errstate(divide="ignore"):
        hits = [(WALL - origin[0]) / ray[:, 0], (GROUND - origin[2]) / ray[:, 2]]
    distance, what = np.full(len(ray), np.inf), np.zeros(len(ray), dtype=int)
    for k, hit in enumerate(hits):
        nearer = (hit > 0) & (hit < distance)
        distance[nearer], what[nearer] = hit[nearer], k
    if scene == "boxes":
        for x, y, width in BOXES:
            low, high = np.array([x, y - width / 2, GROUND]), np.array([x + 1, y + width / 2, GROUND + 6])
            with np.errstate(divide="ignore"):
                sides = np.stack([(low - origin) / ray, (high - origin) / ray])
            enter, leave = sides.min(axis=0).max(axis=1), sides.max(axis=0).min(axis=1)
            nearer = (enter < leave) & (enter > 0) & (enter < distance)
            distance[nearer], what[nearer] = enter[nearer], 2
    at = origin + ray * distance[:, None]
    if scene == "boxes":
        return distance, np.where(what == 2, 0.2, 0.7)
    across = np.where(what == 0, at[:, 2], at[:, 0])
    cell = np.floor(np.stack([at[:, 1], across]) / 0.8).astype(int) % 64
    return distance, SHADES[what, cell[0], cell[1]]


def photograph(T_world_cam: Array, scene: str) -> NDArray[np.uint8]:
    """Each pixel the mean of nine rays."""
    fine = (np.arange(3) - 1) / 3
    u = (np.arange(SIZE[0])[:, None] + fine).ravel()
    v = (np.arange(SIZE[1])[:, None] + fine).ravel()
    x, y = np.meshgrid((u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1])
    _, shade = cast(T_world_cam, np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3), scene)
    mean = shade.reshape(SIZE[1], 3, SIZE[0], 3).mean(axis=(1, 3))
    return np.round(255 * mean).astype(np.uint8)


def sweep(T_world_lidar: Array, scene: str) -> Scan:
    azimuth, elevation = np.radians(np.arange(-42, 42, 0.2)), np.radians(np.arange(-20, 16, 0.3))
    a, e = (m.ravel() for m in np.meshgrid(azimuth, elevation))
    rays = np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], axis=1)
    distance, shade = cast(T_world_lidar, rays, scene)
    return Scan((rays * distance[:, None]).astype(np.float32), intensity=shade.astype(np.float32))


@cache
def drive(scene: str) -> Pair:
    """Three scans and images of a walk; the middle one of each is compared."""
    path = [np.eye(4)]
    for _ in range(3):
        path.append(path[-1] @ se3.matrix(STEP))
    stamps = np.arange(4) * PERIOD
    lidar = Stream("velo", "velodyne", stamps, [sweep(T, scene) for T in path])
    lens = CameraIntrinsics(K, size=SIZE)
    camera = Stream("cam0", "monocular", stamps, [photograph(T @ TRUE, scene) for T in path], lens)
    motion = Motions(stamps[:-1], stamps[1:], np.tile(STEP, (3, 1)), np.tile(1e-6 * np.eye(6), (3, 1, 1)))
    prior = Transform("velo", "cam0", TRUE, np.diag(np.repeat([0.05, np.radians(0.5)], 3)) ** 2)
    return Pair(lidar, camera, motion, motion, 0.0, np.array([[1, 1]]), prior)


def scene_of(metric: CostMetric) -> str:
    return "boxes" if metric.id == "levinson" else "checkers"


@cache
def ready(metric: CostMetric) -> Any:
    """The moment, its picture at its sharpest."""
    pair = drive(scene_of(metric))
    moment = metric.focus(metric.prepare(pair, metric.options()), pair.prior, 0.5)
    assert moment is not None
    return moment


def off(steps: Array) -> Array:
    """(k, 4, 4) poses a step (k, 6) from the truth."""
    return se3.rigid(se3.exp_so3(steps[:, 3:]) @ TRUE[:3, :3], TRUE[:3, 3] + steps[:, :3])


def with_readings(pair: Pair, **readings: list[object]) -> Pair:
    """The pair, its streams a and b with other readings."""
    return replace(pair, **{name: replace(getattr(pair, name), readings=r) for name, r in readings.items()})


@pytest.fixture(params=METRICS, ids=lambda m: m.id)
def metric(request: pytest.FixtureRequest) -> CostMetric:
    chosen: CostMetric = request.param
    return chosen


SHOWN = {
    "nmi": {0: 0.015, 1: 0.01, 2: 0.01, 3: 0.06, 4: 0.06, 5: 0.06},
    "gom": {0: 0.02, 1: 0.01, 2: 0.01, 3: 0.06, 4: 0.06, 5: 0.06},
    "levinson": {0: 0.01, 1: 0.01, 5: 0.06},
    "im": {2: 0.03, 3: 0.12, 4: 0.12, 5: 0.12},
}
"""Metres, degrees: how near the truth the least cost of one moment must be along each axis that its scene shows."""


def test_cost_is_least_at_the_truth(metric: CostMetric) -> None:
    moment = ready(metric)
    for axis, tolerance in SHOWN[metric.id].items():
        unit, half = (1.0, 0.15) if axis < 3 else (np.radians(1), 0.6)
        along = np.linspace(-half, half, 61)
        costs = metric.costs(off(np.eye(6)[axis] * along[:, None] * unit), moment)
        assert abs(along[np.argmin(costs)]) <= tolerance, (axis, along[np.argmin(costs)])
        assert min(costs[0], costs[-1]) > costs.min() + 0.02 * abs(costs.min())


def test_many_poses_cost_what_each_does(metric: CostMetric) -> None:
    moment = ready(metric)
    poses = off(np.random.default_rng(0).normal(size=(7, 6)) * np.repeat([0.1, 0.02], 3))
    one_by_one = [metric.cost(T, moment) for T in poses]
    np.testing.assert_allclose(metric.costs(poses, moment), one_by_one, rtol=1e-5)


def test_looking_away_does_not_win(metric: CostMetric) -> None:
    moment = ready(metric)
    turns = np.zeros((12, 6))
    turns[:6, 5] = turns[6:, 4] = np.radians([-180, -90, -30, 20, 60, 150])
    back = np.zeros((2, 6))
    back[:, 0] = [-200.0, 60.0]
    best = metric.cost(TRUE, moment)
    assert np.all(metric.costs(off(np.concatenate([turns, back])), moment) > best + 0.1 * abs(best))


def test_a_plain_image_tells_nothing(metric: CostMetric) -> None:
    pair = drive(scene_of(metric))
    plain = np.full(SIZE[::-1], 100, np.uint8)
    moment = metric.focus(metric.prepare(with_readings(pair, b=[plain] * 4), metric.options()), pair.prior, 0.5)
    if moment is not None:
        poses = off(np.random.default_rng(0).normal(size=(9, 6)) * np.repeat([0.3, 0.1], 3))
        assert np.ptp(metric.costs(poses, moment)) < 1e-6


@pytest.mark.parametrize("metric", [Nmi(), Gom()], ids=lambda m: m.id)
@pytest.mark.parametrize("intensity", [None, 0.0])
def test_without_intensity_there_is_nothing_to_compare(metric: CostMetric, intensity: float | None) -> None:
    pair = drive("checkers")
    scan = pair.a.readings[1]
    same = None if intensity is None else np.full(len(scan.points), intensity, np.float32)
    moment = metric.prepare(with_readings(pair, a=[replace(scan, intensity=same)] * 4), metric.options())
    assert moment is None or metric.focus(moment, pair.prior, 1.0) is None


def test_lidars_and_cameras_overlap_where_they_look_the_same_way(metric: CostMetric) -> None:
    pair = drive(scene_of(metric))
    away = replace(pair.prior, T_a_b=off(np.array([[0.0, 0.0, 0.0, 0.0, 0.0, np.pi]]))[0])
    assert metric.accepts("velodyne", "monocular")
    assert not metric.accepts("monocular", "velodyne")
    assert metric.overlap(pair)
    assert not metric.overlap(replace(pair, prior=away))


def test_nmi_takes_any_sensible_number_of_bins() -> None:
    metric, pair = Nmi(), drive("checkers")
    for bins in (8, 50):
        moment = metric.focus(metric.prepare(pair, NmiOptions(bins)), pair.prior, 0.5)
        assert moment.bins == bins
        assert metric.cost(TRUE, moment) < metric.costs(off(0.03 * np.eye(6)), moment).min()
    for bad in (1, 1000, 2.5):
        with pytest.raises(ConfigError, match=r"nmi: bins"):
            NmiOptions(bad)


def test_gom_is_the_agreement_of_angles_in_the_image() -> None:
    metric, moment = Gom(), ready(METRICS[1])
    T = se3.rigid(TRUE[:3, :3], np.zeros(3))  # from where the lidar is: what is constant along rays is known there

    def pixel(uv: Array) -> Array:
        """What a function on the sphere with these gradients shows at pixels (n, 2), each near its own point."""
        rays = np.concatenate([(uv - K[:2, 2]) / np.diag(K)[:2], np.ones((len(uv), 1))], axis=1) @ T[:3, :3].T
        return np.sum(moment.facts["gradient"] * rays / np.linalg.norm(rays, axis=1, keepdims=True), axis=1)

    moment = moment[np.isfinite(moment.pixels(T[None])[0]).all(axis=0)]
    uv = moment.pixels(T[None])[0].T.astype(float)
    gx, gy = (pixel(uv + d) - pixel(uv - d) for d in np.eye(2) * 1e-3)
    (image,), weight = moment.read(T[None])
    assert len(uv) > 3000
    assert np.all(weight == 1)
    apart = np.arctan2(gy, gx) - np.arctan2(image[1, 0], image[0, 0])
    slant = np.linalg.norm(np.column_stack([(uv - K[:2, 2]) / np.diag(K)[:2], np.ones(len(uv))]), axis=1)
    both = slant * np.hypot(gx, gy) * np.hypot(image[0, 0], image[1, 0])
    assert metric.cost(T, moment) == pytest.approx(
        -np.sum(both * (np.cos(2 * apart) + 1)) / (2 * np.sum(both)), abs=1e-4
    )


def test_beams_that_return_more_are_evened_out() -> None:
    scan = drive("checkers").a.readings[1]
    elevation = np.arcsin(scan.points[:, 2] / np.linalg.norm(scan.points, axis=1))
    ring = np.unique(np.round(elevation, 5), return_inverse=True)[1].astype(np.int32)
    louder = np.random.default_rng(1).normal(scale=0.15, size=ring.max() + 1)[ring].astype(np.float32)
    noisy = replace(scan, intensity=scan.intensity + louder)

    def like(a: Array) -> float:
        return float(np.corrcoef(a, scan.intensity)[0, 1])

    for known in (ring, None):
        assert like(evened(replace(noisy, ring=known))) > 0.5 * (1 + like(noisy.intensity))


def test_steps_are_the_edges_of_boxes_and_not_the_ground() -> None:
    points = drive("boxes").a.readings[0].points
    front = np.isclose(points[:, :1], BOXES[:, 0], atol=1e-3)
    edge = np.abs(np.abs(points[:, 1:2] - BOXES[:, 1]) - BOXES[:, 2] / 2)
    found = steps_behind(points, np.arange(len(points))) > 0.3
    near = np.any(front & (edge < 0.05), axis=1)
    assert found[near & (points[:, 2] > -1)].mean() > 0.3
    ground = (np.abs(points[:, 2] - GROUND) < 1e-3) & (points[:, 0] < 6)
    inner = np.any(front & (edge > 0.15), axis=1)
    assert ground.sum() > 1000
    assert not found[ground].any()
    assert not found[inner].any()
