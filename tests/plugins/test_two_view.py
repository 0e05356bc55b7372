"""Two-view geometry on points with known truth: signs, degenerate cases, and errors that match their covariance."""

import numpy as np
import pytest
from numpy.typing import NDArray

from calib_toolkit import se3
from calib_toolkit_plugins import epipolar
from calib_toolkit_plugins.epipolar import Points
from calib_toolkit_plugins.two_view import TwoViewMotion, two_view_motion

Array = NDArray[np.float64]
FOCAL = 550.0  # pixels
SIGMA = 0.5  # pixels
FORWARD = np.array([0.05, 0.0, 1.0, 0.002, 0.02, 0.001])


def view(
    seed: int,
    vec: Array = FORWARD,
    n: int = 300,
    outliers: float = 0.0,
    plane: Array | None = None,
    noise: float = SIGMA,
) -> tuple[Points, Points]:
    """What two cameras ``vec`` apart see of points 5 to 50 m away, or of a plane ``plane @ X = 1``."""
    rng = np.random.default_rng(seed)
    rays = np.column_stack([rng.uniform(-1.2, 1.2, n), rng.uniform(-0.4, 0.4, n), np.ones(n)])
    depth = rng.uniform(5, 50, n) if plane is None else 1 / (rays @ plane)
    T = se3.matrix(vec)
    in_curr = (rays * depth[:, None] - T[:3, 3]) @ T[:3, :3]
    curr = in_curr[:, :2] / in_curr[:, 2:]
    wrong = rng.random(n) < outliers
    curr[wrong] += rng.uniform(-30, 30, (int(wrong.sum()), 2)) / FOCAL
    cov = np.tile(np.eye(2) * (SIGMA / FOCAL) ** 2, (n, 1, 1))
    prev, curr = (xy + rng.normal(0, noise / FOCAL, (n, 2)) for xy in (rays[:, :2], curr))
    return Points(prev, cov), Points(curr, cov)


def errors(found: TwoViewMotion, vec: Array) -> Array:
    """The five errors in the axes of the covariance."""
    assert found.t is not None
    turn = se3.log_so3(se3.exp_so3(vec[3:]) @ found.R.T)
    return np.concatenate([turn, epipolar.tangent(found.t).T @ vec[:3] / np.linalg.norm(vec[:3])])


def motion(*points: Points) -> TwoViewMotion:
    found = two_view_motion(*points)
    assert found is not None
    return found


def nees(vec: Array, seeds: range, **scene: float) -> Array:
    out = []
    for seed in seeds:
        found = motion(*view(seed, vec, **scene))  # type: ignore[arg-type]
        e = errors(found, vec)
        out.append(e @ np.linalg.solve(found.cov, e))
    return np.array(out)


@pytest.mark.parametrize("seeds", [range(80), pytest.param(range(80, 480), marks=pytest.mark.long)], ids=len)
@pytest.mark.parametrize("vec", [FORWARD, np.array([1.0, 0, 0.1, 0, 0, 0])], ids=["forward", "sideways"])
def test_errors_match_the_covariance(vec: Array, seeds: range) -> None:
    assert 4.0 <= nees(vec, seeds).mean() <= 6.0


@pytest.mark.long
@pytest.mark.parametrize(("n", "speed", "turn"), [(60, 1.0, 0.02), (300, 0.6, 0.15), (800, 1.0, 0.02)])
def test_errors_match_the_covariance_elsewhere(n: int, speed: float, turn: float) -> None:
    vec = np.array([0.05, 0, speed, 0, turn, 0])
    assert 4.0 <= nees(vec, range(1000, 1400), n=n).mean() <= 6.0


def test_forward_is_forward() -> None:
    found = motion(*view(0))
    assert found.t is not None
    assert found.t[2] > 0.99
    backward = motion(*view(0)[::-1])
    assert backward.t is not None
    assert backward.t[2] < -0.99


def test_wrong_matches_are_left_out() -> None:
    squares = nees(FORWARD, range(40), outliers=0.15)
    assert np.median(squares) < 7.0  # a wrong match along its epipolar line can not be told
    assert squares.max() < 100.0
    prev, curr = view(3, outliers=0.3)
    assert 0.6 * 300 < motion(prev, curr).inliers.sum() < 0.8 * 300


def test_the_jacobian_is_the_derivative() -> None:
    prev, curr = view(1)
    R, t = se3.exp_so3([0.01, 0.03, -0.02]), np.array([0.1, -0.1, 1.0])
    t /= np.linalg.norm(t)
    h = 1e-7
    numeric = []
    for step in h * np.eye(5):
        moved = t + epipolar.tangent(t) @ step[3:]
        ends = (epipolar.sampson(prev, curr, se3.exp_so3(s * step[:3]) @ R, t + s * (moved - t))[0] for s in (1, -1))
        numeric.append(np.subtract(*ends) / (2 * h))
    J = epipolar.sampson(prev, curr, R, t)[1]
    np.testing.assert_allclose(J, np.transpose(numeric), rtol=1e-4, atol=1e-4 * np.abs(J).max())


def test_eight_points_without_noise_give_the_essential_matrix() -> None:
    prev, curr = view(2, n=12)
    T = se3.matrix(FORWARD)
    X = prev.rays * np.linspace(5, 30, 12)[:, None]
    seen = (X - T[:3, 3]) @ T[:3, :3]
    curr = Points(seen[:, :2] / seen[:, 2:], curr.cov)
    E = epipolar.eight_point(prev, curr)
    R, t = epipolar.pose_of(E, prev, curr)
    np.testing.assert_allclose(R, T[:3, :3], atol=1e-9)
    np.testing.assert_allclose(t, T[:3, 3] / np.linalg.norm(T[:3, 3]), atol=1e-8)


def test_refinement_is_better_than_the_eight_points() -> None:
    ratios = []
    for seed in range(20):
        prev, curr = view(seed)
        start = epipolar.pose_of(epipolar.eight_point(prev, curr), prev, curr)
        end = epipolar.refine(prev, curr, *start)
        truth = FORWARD[:3] / np.linalg.norm(FORWARD[:3])
        ratios.append(np.linalg.norm(end[1] - truth) / np.linalg.norm(start[1] - truth))
    assert np.median(ratios) < 1.0


@pytest.mark.parametrize("angle", [0.0, 0.002, 0.1])
def test_a_turn_without_translation_says_nothing_of_the_direction(angle: float) -> None:
    vec = np.array([0, 0, 0, 0, angle, 0])
    for seed in range(10):
        found = motion(*view(seed, vec))
        assert found.t is None
        delta = se3.log_so3(se3.exp_so3(vec[3:]) @ found.R.T)
        assert delta @ np.linalg.solve(found.cov, delta) < 16.3  # 99.9 % of chi-square with three
        assert np.sqrt(found.cov[1, 1]) < 2e-3


def test_a_crawl_never_claims_a_direction_it_did_not_see() -> None:
    """At a centimetre a step the points move less than their noise."""
    vec = np.array([0, 0, 0.01, 0, 0.03, 0])
    assert all(motion(*view(seed, vec)).t is None for seed in range(10))


def test_a_standing_camera_among_moving_things_only_turns() -> None:
    prev, curr = view(0, np.zeros(6))
    curr.xy[:80] += np.array([8.0, 0.0]) / FOCAL  # cars cross the view
    found = motion(prev, curr)
    assert found.t is None
    assert np.linalg.norm(se3.log_so3(found.R)) < 1e-3


def test_a_plane_alone_has_two_motions_and_gives_none() -> None:
    road = np.array([0.02, 0.1, 0.08])
    assert all(two_view_motion(*view(seed, plane=road)) is None for seed in range(10))


def test_a_plane_with_a_few_points_off_it_has_one_motion() -> None:
    for seed in range(10):
        flat, deep = view(seed, n=200, plane=np.array([0.02, 0.1, 0.08])), view(seed + 100, n=80)
        pair = [
            Points(np.concatenate([a.xy, b.xy]), np.concatenate([a.cov, b.cov]))
            for a, b in zip(flat, deep, strict=True)
        ]
        found = motion(*pair)
        e = errors(found, FORWARD)
        assert e @ np.linalg.solve(found.cov, e) < 25


def test_no_motion_out_of_chance_or_too_few() -> None:
    rng = np.random.default_rng(0)
    cov = np.tile(np.eye(2) * (SIGMA / FOCAL) ** 2, (200, 1, 1))
    assert two_view_motion(*(Points(rng.uniform(-0.5, 0.5, (200, 2)), cov) for _ in range(2))) is None
    prev, curr = view(0, n=19)
    assert two_view_motion(prev, curr) is None


def test_the_same_image_twice_is_a_camera_at_rest() -> None:
    prev, _ = view(0)
    found = motion(prev, prev)
    assert found.t is None
    np.testing.assert_allclose(found.R, np.eye(3), atol=1e-9)
    assert np.linalg.eigvalsh(found.cov)[0] > 0


def test_points_that_all_err_one_way_within_the_gate_hardly_pull() -> None:
    """As corners of outlines do: an eighth of the points lies half a pixel too high where noise is a tenth."""
    R = se3.exp_so3(FORWARD[3:])
    robust, plain = [], []
    for seed in range(20):
        prev, curr = view(seed, noise=0.1)
        low = np.flatnonzero(curr.xy[:, 1] > 0)[::4]
        curr.xy[low, 1] -= 0.5 / FOCAL
        found = motion(prev, curr)
        assert found.t is not None
        least = epipolar.refine(prev[found.inliers], curr[found.inliers], found.R, found.t)[0]
        robust.append(se3.log_so3(R @ found.R.T))
        plain.append(se3.log_so3(R @ least.T))
    bias, bias_plain = (np.abs(np.mean(e, axis=0))[0] for e in (robust, plain))
    assert bias < bias_plain / 2
