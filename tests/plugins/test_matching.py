"""Camera to camera on rendered images of a textured street and on points with known truth."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray
from test_monocular import CAMERA, WIDE, R_vehicle_camera, render

from calib_toolkit import CameraIntrinsics, Motions, Pair, PairEstimate, Stream, Transform, se3
from calib_toolkit.errors import DataError
from calib_toolkit_plugins.epipolar import Points, tangent
from calib_toolkit_plugins.metrics import matching, matching_geometry
from calib_toolkit_plugins.metrics.matching import MatchingOptions

Array = NDArray[np.float64]
(MATCHING,) = matching.calib_register_metrics()
ROWS = 4
BESIDE = np.array([0.5, 0.02, 0.1, 0.01, 0.05, -0.02])
SIGMA = np.array([0.1, 0.1, 0.1, 0.01, 0.01, 0.01])
STILL = Motions(np.zeros(0), np.zeros(0), np.zeros((0, 6)), np.zeros((0, 6, 6)), has_scale=False)


@cache
def pictures(vec: tuple[float, ...], distorted: bool) -> list[NDArray[np.uint8]]:
    """What a camera sees that sits ``vec`` from the first one, in its axes."""
    T = se3.rigid(R_vehicle_camera, np.zeros(3)) @ se3.matrix(vec)
    places = [se3.matrix([4.0 * k, 0.3 * k, 0, 0, 0, 0.1 * k]) for k in range(ROWS)]
    return [render(P @ T, WIDE if distorted else CAMERA, 10 * k + any(vec)) for k, P in enumerate(places)]


def pair(vec: Array, camera: CameraIntrinsics = CAMERA, off: float = 1.0, dt: float = 0.0) -> Pair:
    """Two cameras, b ``vec`` from a in a's axes, in four places of a street; the prior is ``off`` sigmas off."""
    T_a_b, stamps = se3.matrix(vec), 0.5 * np.arange(ROWS)
    streams = [
        Stream(f"cam{n}", "monocular", stamps - n * dt, pictures(tuple(v), camera is WIDE), camera, has_scale=False)
        for n, v in enumerate((np.zeros(6), vec))
    ]
    error = off * SIGMA * [0.5, -0.8, 0.6, 0.5, -0.6, 0.4]
    prior = se3.rigid(se3.exp_so3(error[3:]) @ T_a_b[:3, :3], T_a_b[:3, 3] + error[:3])
    rows = np.column_stack([np.arange(ROWS)] * 2)
    return Pair(*streams, STILL, STILL, dt, rows, Transform("cam0", "cam1", prior, np.diag(SIGMA**2)))


def estimate(p: Pair) -> PairEstimate:
    return MATCHING.estimate(p, MatchingOptions(features=500))


def five(t: Transform, vec: Array) -> tuple[Array, Array]:
    """The five errors of a scale-free transform, and their covariance."""
    R, t_est = t.T_a_b[:3, :3], t.T_a_b[:3, 3]
    B = tangent(t_est)
    e = np.append(se3.log_so3(se3.exp_so3(vec[3:]) @ R.T), B.T @ vec[:3] / np.linalg.norm(vec[:3]))
    A = np.zeros((5, 6))
    A[:3, 3:], A[3:, :3] = np.eye(3), B.T
    return e, A @ t.cov @ A.T


def test_it_compares_cameras_with_cameras() -> None:
    assert MATCHING.accepts("monocular", "ladybug")
    assert not MATCHING.accepts("velodyne", "monocular")
    assert not MATCHING.accepts("monocular", "gps_ins")


@pytest.mark.parametrize("camera", [CAMERA, WIDE], ids=["rectified", "distorted"])
def test_two_cameras_side_by_side(camera: CameraIntrinsics) -> None:
    p = pair(BESIDE, camera)
    assert MATCHING.overlap(p)
    found = estimate(p)
    assert found.converged, found.note
    assert found.note == ""
    assert not found.transform.has_scale
    e, cov = five(found.transform, BESIDE)
    assert np.abs(e[:3]).max() < 2e-3
    assert np.abs(e[3:]).max() < 0.02
    assert e @ np.linalg.solve(cov, e) < 20.5  # 99.9 % of chi-square with five
    assert np.sqrt(np.diag(cov)).max() < 0.02
    t = found.transform.T_a_b[:3, 3]
    assert np.linalg.norm(t) == pytest.approx(1.0)
    np.testing.assert_allclose(found.transform.cov[:, :3] @ t, 0.0, atol=1e-12)
    assert np.linalg.matrix_rank(found.transform.cov[:3, :3], hermitian=True) == 2


def test_seen_from_the_other_side_it_is_the_inverse() -> None:
    p = pair(BESIDE)
    there = estimate(p).transform.T_a_b
    T = se3.invert(p.prior.T_a_b)
    back = estimate(replace(p, a=p.b, b=p.a, prior=Transform("cam1", "cam0", T, p.prior.cov))).transform.T_a_b
    np.testing.assert_allclose(back[:3, :3], there[:3, :3].T, atol=1e-3)
    np.testing.assert_allclose(back[:3, 3], -there[:3, :3].T @ there[:3, 3], atol=0.01)


def test_the_prior_steers_but_is_not_in_the_answer() -> None:
    one, other = (estimate(pair(BESIDE, off=off)).transform for off in (0.0, 1.5))
    sigma = np.sqrt(np.diag(one.cov))
    assert np.abs(se3.log_so3(one.T_a_b[:3, :3] @ other.T_a_b[:3, :3].T)).max() < 3 * sigma[3:].max()
    np.testing.assert_allclose(np.diag(other.cov), np.diag(one.cov), rtol=1.0)


def test_two_cameras_at_one_place_tell_only_how_they_are_turned() -> None:
    vec = np.array([0, 0, 0, 0.02, 0.3, 0.01])
    found = estimate(pair(vec))
    assert found.converged, found.note
    assert "only their rotation" in found.note
    assert not found.transform.has_scale
    delta = se3.log_so3(se3.exp_so3(vec[3:]) @ found.transform.T_a_b[:3, :3].T)
    assert np.abs(delta).max() < 2e-3
    assert np.linalg.eigvalsh(found.transform.cov[:3, :3])[0] >= 100.0
    assert np.sqrt(np.diag(found.transform.cov)[3:]).max() < 5e-3


def test_cameras_that_look_away_from_each_other() -> None:
    p = pair(np.array([0.3, 0, 0, 0, 2.0, 0]))
    assert not MATCHING.overlap(p)
    found = estimate(p)
    assert not found.converged
    assert "cam0 and cam1" in found.note
    assert np.linalg.eigvalsh(found.transform.cov)[0] >= 100.0


def test_a_narrow_overlap_is_recognised() -> None:
    """The pictures are 67 degrees wide, so that two of them share two degrees: less than a tenth."""
    p = pair(np.array([0.3, 0, 0, 0, np.radians(65), 0]), off=0.3)
    assert not MATCHING.overlap(p)
    found = estimate(p)
    assert not found.converged
    assert "cam0 and cam1" in found.note


def test_half_of_a_picture_is_enough() -> None:
    vec = np.array([0.5, 0, 0.1, 0, np.radians(30), 0])
    p = pair(vec)
    assert MATCHING.overlap(p)
    found = estimate(p)
    assert found.converged, found.note
    e, cov = five(found.transform, vec)
    assert e @ np.linalg.solve(cov, e) < 20.5
    assert np.abs(e[:3]).max() < 0.01


def test_an_unknown_rotation_may_overlap() -> None:
    p = pair(np.array([0.3, 0, 0, 0, 1.3, 0]))
    assert not MATCHING.overlap(p)
    assert MATCHING.overlap(replace(p, prior=replace(p.prior, cov=np.diag([4.0] * 3 + [1.0] * 3))))


def test_only_images_of_one_instant_are_compared() -> None:
    p = pair(BESIDE, dt=0.04)
    assert estimate(p).converged
    late = replace(p, dt_a_b=0.03)
    assert not MATCHING.overlap(late)
    assert not estimate(late).converged
    assert "same instant" in estimate(late).note
    stamps = p.b.stamps + np.array([0, 0, 0.01, 0])
    some = estimate(replace(p, b=replace(p.b, stamps=stamps)))
    assert some.converged
    assert some.note.startswith("1 of 4 rows left out")


def test_black_images_and_noise_are_no_evidence() -> None:
    p = pair(BESIDE)
    rng = np.random.default_rng(0)
    black = [np.zeros_like(image) for image in p.b.readings]
    noise = [rng.integers(0, 255, image.shape, dtype=np.uint8) for image in p.b.readings]
    for images in (black, noise):
        found = estimate(replace(p, b=replace(p.b, readings=images)))
        assert not found.converged
        assert "cam0 and cam1" in found.note


def test_a_mask_and_colour_are_respected() -> None:
    p = pair(BESIDE)
    mask = np.full((240, 400), 255, np.uint8)
    mask[:, :150] = 0
    colour = [np.repeat(image[..., None], 3, axis=2) for image in p.b.readings]
    b = replace(p.b, readings=colour, intrinsics=replace(CAMERA, mask=mask))
    found, whole = estimate(replace(p, b=b)), estimate(p)
    assert found.converged, found.note
    assert 0.3 < found.statistics["matches"] / whole.statistics["matches"] < 0.8


def test_a_camera_without_intrinsics_is_refused() -> None:
    p = pair(BESIDE)
    with pytest.raises(DataError, match="cam1 has no intrinsics"):
        estimate(replace(p, b=replace(p.b, intrinsics=None)))


def test_the_same_pair_gives_the_same_answer() -> None:
    p = pair(BESIDE)
    one, other = estimate(p), estimate(p)
    np.testing.assert_array_equal(one.transform.T_a_b, other.transform.T_a_b)
    np.testing.assert_array_equal(one.transform.cov, other.transform.cov)


def matches(vec: Array, seed: int, outliers: float = 0.1) -> matching_geometry.Matches:
    """Points of eight rows, 5 to 50 m away, half a pixel noisy; b's seen as if the prior's rotation were none."""
    rng = np.random.default_rng(seed)
    n, rows, sigma = 300, 8, 0.5 / 550
    rays = np.column_stack([rng.uniform(-0.8, 0.8, n), rng.uniform(-0.4, 0.4, n), np.ones(n)])
    T = se3.matrix(vec)
    X = (rays * rng.uniform(5, 50, n)[:, None] - T[:3, 3]) @ T[:3, :3]
    xy = X[:, :2] / X[:, 2:]
    wrong = rng.random(n) < outliers
    xy[wrong] += rng.uniform(-40, 40, (int(wrong.sum()), 2)) / 550
    a, b = (
        Points(p + rng.normal(0, sigma, (n, 2)), np.tile(np.eye(2) * sigma**2, (n, 1, 1))) for p in (rays[:, :2], xy)
    )
    cell = np.unique(np.floor(a.xy / 0.25), axis=0, return_inverse=True)[1].ravel()
    return matching_geometry.Matches(a, b, np.arange(n) % rows, cell)


@pytest.mark.parametrize("baseline", [0.1, 0.5])
def test_errors_match_the_covariance(baseline: float) -> None:
    vec = np.array([baseline, 0.02 * baseline, 0.1 * baseline, 0.004, -0.006, 0.003])
    squares = []
    for seed in range(25):
        found = matching_geometry.solve(matches(vec, seed))
        assert found is not None
        assert found.t is not None
        e = np.append(
            se3.log_so3(se3.exp_so3(vec[3:]) @ found.R.T), tangent(found.t).T @ vec[:3] / np.linalg.norm(vec[:3])
        )
        squares.append(e @ np.linalg.solve(found.cov, e))
    assert 3.0 < np.mean(squares) < 7.0


def test_the_jacobian_is_the_derivative() -> None:
    m = matches(BESIDE, 0, outliers=0.0)
    R, t = se3.exp_so3(BESIDE[3:] + 0.002), np.array([0.9, 0.1, 0.3])
    t /= np.linalg.norm(t)
    h, numeric = 1e-7, []
    for step in h * np.eye(5):
        ends = []
        for s in (step, -step):
            moved = t + tangent(t) @ s[3:]
            ends.append(matching_geometry._residuals(m, se3.exp_so3(s[:3]) @ R, moved / np.linalg.norm(moved))[0])
        numeric.append((ends[0] - ends[1]) / (2 * h))
    J = matching_geometry._residuals(m, R, t)[1]
    np.testing.assert_allclose(J[:, :3], np.transpose(numeric)[:, :3], rtol=0.02, atol=0.01 * np.abs(J).max())
    np.testing.assert_allclose(J[:, 3:], np.transpose(numeric)[:, 3:], rtol=0.02, atol=0.01 * np.abs(J[:, 3:]).max())
