"""Where sensors sit: derivatives against finite differences, exact answers without noise, cameras, laws, outliers."""

import numpy as np
import pytest
from builders import CAMERA, INS, LIDAR, MOUNTS, exact_turns, in_axes, in_base, known_times, pose, squared
from numpy.testing import assert_allclose

from calib_toolkit import delta, rotation, se3, translation
from calib_toolkit.rotation import RotationOptions, Rotations
from calib_toolkit.sync import Steps
from calib_toolkit.translation import TranslationOptions, turn
from calib_toolkit_datasets.simulated import path

TRIM, ALL = TranslationOptions(), TranslationOptions(trim=0.0)
SIGMA = np.array([0.01, 0.01, 0.01, 5e-4, 5e-4, 5e-4])
TIGHT = SIGMA / 100
ROUGH, SHORT = path(40, 0, "rough"), path(20, 0, "rough")


def stating(steps, sigma):
    """The same steps with another stated noise."""
    return Steps(steps.ends, steps.vec, np.broadcast_to(np.diag(sigma**2), steps.cov.shape).copy(), steps.has_scale)


def exact(mounts, cameras=(), sigma=TIGHT, drive=ROUGH):
    return stating(known_times(drive, mounts, 0 * SIGMA, 0, cameras), sigma)


def positions(mounts):
    return in_base(mounts)[:, :3, 3]


def correlated(rng, shape):
    """Covariances (*shape, 6, 6) without a zero anywhere, millimetres and milliradians."""
    A = 1e-3 * rng.normal(size=(*shape, 6, 6))
    return A @ np.swapaxes(A, -1, -2)


def residual_of(motion, term, p_x, p_y, W, lever, length=None):
    """Equations (14) and (16) written out again, for one step."""
    rest = W @ lever - lever - p_x
    if length is None:
        length = -(p_y @ rest) / (p_y @ p_y) if term.unscaled else 1.0
    return rest + length * p_y


CASES = pytest.mark.parametrize(("cameras", "k"), [((), 0), ((), 1), ((1,), 0), ((1,), 1)])


def term_at_truth(cameras, k):
    """A term of (lidar, other) turned by sensor k, its motion and lever; readings are consistent."""
    mounts = (LIDAR, CAMERA if cameras else INS)
    steps = known_times(ROUGH, mounts, 0 * SIGMA, 0, cameras)
    cov = correlated(np.random.default_rng(1), steps.vec.shape[:2])
    turns = Rotations(in_base(mounts)[:, :3, :3], np.zeros((6, 6)))
    turns.cov[3:, 3:] = 1e-6 * np.array([[4, 1, 0], [1, 3, -1], [0, -1, 2]])
    motion = turn(Steps(steps.ends, steps.vec, cov, steps.has_scale), turns)
    t = positions(mounts)
    (term,) = [m for m in translation.likelihood_terms(t, motion) if m.turned_by == k]
    return term, motion, t[0] - t[1]


@CASES
def test_derivatives_match_finite_differences(cameras, k):
    term, motion, lever = term_at_truth(cameras, k)
    by_lever, by_x, by_y = term.jacobians(lever)
    for m in range(0, len(term.p_x), 50):
        p_x, p_y, W = motion.p[0, m], motion.p[1, m], motion.W[k, m]

        def f(v, p_x=p_x, p_y=p_y, W=W):
            turned = se3.exp_so3(v[6:9]) @ W
            return residual_of(motion, term, p_x + v[:3], p_y + v[3:6], turned, lever + v[9:])

        J = delta.jacobian(f, np.zeros(12))
        x_turns, y_turns = (J[:, 6:9] * (k == i) for i in (0, 1))
        assert_allclose(by_lever[m], J[:, 9:], atol=1e-7)
        assert_allclose(by_x[m], np.column_stack([J[:, :3], x_turns]), atol=1e-7)
        assert_allclose(by_y[m], np.column_stack([J[:, 3:6], y_turns]), atol=1e-7)


@CASES
def test_the_residual_and_its_covariance_are_those_of_the_delta_method(cameras, k):
    """With the solved length held, then its own variance along p_y added, and the part of the uncertain turns."""
    term, motion, lever = term_at_truth(cameras, k)
    error, cov = term.residual(lever)
    lengths = term.length(term.D @ lever - term.p_x)[:, 0]
    R_cov = motion.cov_turns
    for m in range(0, len(term.p_x), 50):
        p, W, s = motion.p[:, m], motion.W[k, m], lengths[m]

        def f(v, p=p, W=W, s=s):
            turn_x, turn_y = se3.exp_so3(v[9:12]), se3.exp_so3(v[12:15])
            outer = turn_x if k == 0 else turn_y
            turned = outer @ (se3.exp_so3(v[6:9]) @ W) @ outer.T
            return residual_of(motion, term, turn_x @ (p[0] + v[:3]), turn_y @ (p[1] + v[3:6]), turned, lever, s)

        J = delta.jacobian(f, np.zeros(15))
        noise = np.zeros((15, 15))
        noise[:3, :3], noise[3:6, 3:6] = motion.cov_p[0, m], motion.cov_p[1, m]
        noise[6:9, 6:9] = motion.cov_w[k, m]
        at = slice(0, 3) if k == 0 else slice(3, 6)
        noise[at, 6:9] = motion.cov_pw[k, m]
        noise[6:9, at] = motion.cov_pw[k, m].T
        noise[9:, 9:] = R_cov
        expected = J @ noise @ J.T
        if term.unscaled:
            u = p[1]
            expected = expected + (u @ expected @ u) / (u @ u) ** 2 * np.outer(u, u)
        assert_allclose(cov[m], expected, rtol=1e-5, atol=1e-14)
        assert_allclose(error[m], 0.0, atol=1e-9)


def test_noise_in_base_axes_is_that_of_many_draws():
    rng = np.random.default_rng(0)
    vec, cov = np.array([1.0, 0.2, -0.1, 0.3, -0.5, 0.8]), correlated(rng, ())
    turns = Rotations(pose(0, 0, 0, 20, 40, 150)[None, :3, :3], np.zeros((3, 3)))
    one = turn(Steps(np.zeros((1, 2)), vec[None, None], cov[None, None], np.array([True])), turns)
    drawn = vec + rng.multivariate_normal(np.zeros(6), cov, 20_000)
    many = turn(Steps(np.zeros((20_000, 2)), drawn[None], np.zeros((1, 20_000, 6, 6)), np.array([True])), turns)
    noise = np.column_stack([many.p[0] - one.p[0], se3.log_so3(many.W[0] @ one.W[0, 0].T)])
    found = np.cov(noise.T)
    stated = np.block([[one.cov_p[0, 0], one.cov_pw[0, 0]], [one.cov_pw[0, 0].T, one.cov_w[0, 0]]])
    assert_allclose(found, stated, atol=0.05 * np.sqrt(np.outer(np.diag(stated), np.diag(stated))).max())


RIGS = {
    "two": (MOUNTS[:2], ()),
    "lidar and camera": ((LIDAR, CAMERA), (1,)),
    "lidar, INS, two cameras": ((LIDAR, INS, CAMERA, pose(0.2, 0.8, 1.1, -90, 0, 90)), (2, 3)),
    "six, three of them cameras": (MOUNTS, (2, 3, 4)),
    "upside down": ((LIDAR, pose(0.5, -0.4, 1, 180, 0, 0)), ()),
    "one place, other axes": ((LIDAR, LIDAR @ pose(0, 0, 0, 90, 0, 180)), ()),
    "three metres apart": ((LIDAR, pose(-3, 1, -0.5, 0, 0, 180)), ()),
}


@pytest.mark.parametrize(
    ("mounts", "cameras"),
    [pytest.param(*rig, id=name, marks=[pytest.mark.long] if len(rig[0]) > 4 else []) for name, rig in RIGS.items()],
)
def test_without_noise_every_rig_is_found_exactly(mounts, cameras):
    """To a tenth of a millimetre."""
    found = translation.estimate(exact(mounts, cameras, drive=SHORT), exact_turns(mounts), TRIM)
    assert_allclose(found.t_base_sensor, positions(mounts), atol=1e-4)


def test_least_squares_alone_is_exact_for_sensors_with_scale():
    t = translation.initialise(turn(exact(MOUNTS), exact_turns(MOUNTS)))
    assert_allclose(t, positions(MOUNTS), atol=1e-8)


def test_a_camera_starts_near_where_it_sits():
    mounts = (LIDAR, CAMERA)
    t = translation.initialise(turn(exact(mounts, (1,)), exact_turns(mounts)))
    assert_allclose(t[1], positions(mounts)[1], atol=0.1)


def test_standing_still_now_and_then_does_no_harm():
    mounts = (LIDAR, INS, CAMERA)
    steps = exact(mounts, (2,))
    vec = steps.vec.copy()
    vec[:, ::3] = 0.0
    vec[2, ::3, 0] = 1.0  # a camera at rest still names some direction
    vec[2, 1, :3] = 0.0  # or, if it is honest, none
    vec[:2, 1] = 0.0
    found = translation.estimate(Steps(steps.ends, vec, steps.cov, steps.has_scale), exact_turns(mounts), TRIM)
    assert_allclose(found.t_base_sensor, positions(mounts), atol=2e-4)
    assert np.all(np.isfinite(found.cov))


def test_cameras_alone_have_no_positions():
    steps = exact((CAMERA, MOUNTS[4]), (0, 1))
    found = translation.estimate(steps, exact_turns((CAMERA, MOUNTS[4])), TRIM)
    assert_allclose(found.t_base_sensor[0], 0.0)
    assert np.all(np.isnan(found.t_base_sensor[1]))


def test_pairs_of_cameras_are_skipped_and_all_others_come_in_both_orders():
    motion = turn(exact(MOUNTS[:4], (2, 3)), exact_turns(MOUNTS[:4]))
    found = {(m.x, m.y, m.turned_by) for m in translation.likelihood_terms(positions(MOUNTS[:4]), motion)}
    pairs = [(0, 1), (0, 2), (0, 3), (1, 2), (1, 3)]
    assert found == {(x, y, k) for x, y in pairs for k in (x, y)}


def both_stages(steps, trim=0.25):
    turns = rotation.estimate(steps, RotationOptions(trim))
    return translation.estimate(steps, turns, TranslationOptions(trim))


def test_turning_a_sensors_axes_leaves_where_it_sits():
    steps = known_times(ROUGH, MOUNTS[:2], SIGMA, 1)
    a, b = both_stages(steps), both_stages(in_axes(steps, 1, pose(0, 0, 0, 180, 30, -70)[:3, :3]))
    assert_allclose(b.t_base_sensor, a.t_base_sensor, atol=2e-3)
    assert_allclose(b.cov, a.cov, rtol=0.05, atol=1e-5)


def test_turning_the_bases_axes_turns_positions_and_covariances():
    steps, Q = known_times(ROUGH, MOUNTS[:2], SIGMA, 1), pose(0, 0, 0, 10, -40, 130)[:3, :3]
    a, b = both_stages(steps, 0.0), both_stages(in_axes(steps, 0, Q), 0.0)
    assert_allclose(b.t_base_sensor, a.t_base_sensor @ Q.T, atol=2e-3)
    assert_allclose(b.cov[3:, 3:], Q @ a.cov[3:, 3:] @ Q.T, rtol=0.05, atol=2e-5)


def test_in_other_units_of_length_the_answer_is_in_those_units():
    steps = known_times(ROUGH, (LIDAR, INS, CAMERA), SIGMA, 2, (2,))
    k, scaled = 100.0, np.array([[100.0] * 3 + [1] * 3] * 2 + [[1.0] * 6])[:, None]
    cov = steps.cov * scaled[..., None] * scaled[..., None, :]
    a, b = both_stages(steps), both_stages(Steps(steps.ends, steps.vec * scaled, cov, steps.has_scale))
    assert_allclose(b.t_base_sensor, k * a.t_base_sensor, atol=k * 3e-3)
    assert_allclose(b.cov, k**2 * a.cov, rtol=0.1, atol=k**2 * 1e-6)


def test_a_fifth_of_wrong_readings_hardly_moves_the_answer():
    steps = known_times(ROUGH, MOUNTS[:3], SIGMA, 5)
    rng, vec = np.random.default_rng(5), steps.vec.copy()
    wrong = rng.random(len(steps)) < 0.2
    vec[1, wrong] += rng.uniform(0, 40, (wrong.sum(), 6)) * SIGMA
    vec[1, wrong, :3] += 0.5
    found = both_stages(Steps(steps.ends, vec, steps.cov, steps.has_scale))
    error = (found.t_base_sensor - positions(MOUNTS[:3]))[1:]
    assert np.all(np.abs(error) < 0.12)


def test_the_uncertainty_is_the_spread_of_the_answers():
    """30 drives of 40 s, two sensors, turns known and nothing trimmed: 0.9 measured against an ideal of one."""
    found = []
    for seed in range(30):
        steps = known_times(ROUGH, MOUNTS[:2], SIGMA, seed)
        estimate = translation.estimate(steps, exact_turns(MOUNTS[:2]), ALL)
        found.append(squared((estimate.t_base_sensor - positions(MOUNTS[:2]))[1], estimate.cov[3:, 3:]))
    assert 0.6 < np.mean(found) < 1.6


def test_a_turn_that_is_wrong_moves_the_answer_by_what_its_sigma_says():
    """A yaw wrong by 0.6 degrees is wrong at every step: its share of the uncertainty does not average out."""
    steps, sure = known_times(ROUGH, MOUNTS[:2], SIGMA, 3), exact_turns(MOUNTS[:2])
    off = np.array([0, 0, 0, 0, 0, 0.01])
    wrong = Rotations(se3.exp_so3(off.reshape(2, 3)) @ sure.R_base_sensor, np.diag(off**2))
    a, b = (translation.estimate(steps, turns, ALL) for turns in (sure, wrong))
    moved = np.linalg.norm((b.t_base_sensor - a.t_base_sensor)[1])
    added = np.sqrt(np.linalg.eigvalsh((b.cov - a.cov)[3:, 3:]).max())
    assert moved > 0.005
    assert 0.5 < moved / added < 1.5
