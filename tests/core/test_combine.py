"""Motion combined with estimates of pairs: exactness, the law that nothing gets worse, and who is believed."""

from dataclasses import replace

import numpy as np
import pytest
from builders import CAMERA, INS, LIDAR, in_base, pose
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from calib_toolkit import se3
from calib_toolkit.combine import combine, combine_paper, shared
from calib_toolkit.combine.evidence import evidence
from calib_toolkit.types import Calibration, PairEstimate, Transform, Undetermined

NAMES = ("velo", "ins", "cam0", "cam1")
TRUE = in_base((LIDAR, INS, CAMERA, pose(0.2, 0.8, 1.1, -90, 0, -60)))
BY_MOTION = np.array([0.1, 0.1, 0.3, 0.004, 0.004, 0.002, 0.001])
BY_LOOK = np.array([0.03, 0.01, 0.01, 0.002, 0.001, 0.001])
NEVER = chi2.isf(1e-7, 6)
"""Normalised square of a pose's error that is not reached by chance."""


def definite(rng, sigma):
    """A covariance with about these sigmas and random correlations."""
    root = rng.normal(size=(len(sigma), len(sigma))) / np.sqrt(len(sigma)) + 0.3 * np.eye(len(sigma))
    return np.outer(sigma, sigma) * (root @ root.T)


def off_by(T, error):
    """The estimate of which T is the truth: ``(dt, delta)`` = error."""
    return se3.rigid(se3.exp_so3(-error[..., 3:]) @ T[..., :3, :3], T[..., :3, 3] - error[..., :3])


def moved(T=TRUE, error=None, cov=None, dt=None, rng=None, **fields):
    """A motion result that is off by error (n, 7)."""
    n = len(T)
    error = np.zeros((n, 7)) if error is None else error
    if cov is None:
        cov = np.zeros((n, 7, n, 7))
        for i in range(1, n):
            cov[i, :, i] = np.diag(BY_MOTION**2)
    dt = np.zeros(n) if dt is None else dt
    known = {"has_scale": np.arange(n) < 2, "determined": np.ones((n, 7), dtype=bool)} | fields
    cov = cov.reshape(7 * n, 7 * n)
    return Calibration(NAMES[0], NAMES[:n], off_by(T, error[:, :6]), dt - error[:, 6], cov, **known)


def seen(a, b, metric="im", error=None, cov=None, by_clock=None, has_scale=True, T=TRUE):
    """An estimate of sensors a and b (by number) that is off by error (6,)."""
    T_a_b = se3.relative(T[a], T[b])
    if not has_scale:
        T_a_b[:3, 3] /= np.linalg.norm(T_a_b[:3, 3])
    T_a_b = off_by(T_a_b, np.zeros(6) if error is None else error)
    if not has_scale:
        T_a_b[:3, 3] /= np.linalg.norm(T_a_b[:3, 3])
    cov = np.diag(BY_LOOK**2) if cov is None else cov
    transform = Transform(NAMES[a], NAMES[b], T_a_b, cov, has_scale)
    return PairEstimate(metric, transform, np.zeros(6) if by_clock is None else by_clock)


def random_rig(rng):
    """Poses of sensors anywhere, any way round; one at exactly 180 degrees."""
    R = Rotation.random(4, rng=rng).as_matrix()
    R[0], R[1] = np.eye(3), np.diag([1.0, -1.0, -1.0])
    t = rng.uniform(-1.0, 1.0, (4, 3))
    t[0], t[3, 1] = 0.0, t[2, 1] + 2.0  # a direction is only one where two are well apart
    return se3.rigid(R, t)


def drawn(rng, common=0.3):
    """A rig, its motion result and estimates of pairs, errors drawn from the covariances."""
    T = random_rig(rng)
    cov = np.zeros((28, 28))
    cov[7:, 7:] = definite(rng, np.tile(BY_MOTION, 3) * rng.uniform(0.5, 2.0, 21))
    error = rng.multivariate_normal(np.zeros(28), cov, method="eigh").reshape(4, 7)
    motion = moved(T, error, cov, dt=rng.uniform(-0.05, 0.05, 4) * [0, 1, 1, 1])
    estimates = []
    for a, b, metric, has_scale in [
        (0, 2, "im", True),
        (0, 2, "gom", True),
        (3, 0, "im", True),
        (2, 3, "features", False),
        (1, 3, "map", True),
    ]:
        C = definite(rng, BY_LOOK * rng.uniform(0.5, 3.0, 6))
        by_clock = rng.normal(size=6) * [5, 5, 5, 0.1, 0.1, 0.1] * has_scale
        # the estimate was made with the clock offsets of motion, which are off
        late = -(error[b, 6] - error[a, 6])
        off = rng.multivariate_normal(np.zeros(6), C) - by_clock * late
        estimates.append(seen(a, b, metric, off, C, by_clock, has_scale, T))
    return T, motion, estimates


def difference_of(found, T):
    """(..., 6) truth less estimate, of poses (..., 4, 4)."""
    turn = se3.log_so3(T[..., :3, :3] @ np.swapaxes(found[..., :3, :3], -1, -2))
    return np.concatenate([T[..., :3, 3] - found[..., :3, 3], turn], axis=-1)


def difference(c, T):
    """(n, 6) truth less estimate."""
    return difference_of(c.T_base_sensor, T)


def at_most(A, B, slack=1e-7):
    """A <= B in the Loewner order, up to rounding."""
    unit = np.sqrt(np.diag(B))
    return np.linalg.eigvalsh((B - A) / np.outer(unit, unit)).min() > -slack


def own(e, c):
    """An estimate's covariance with the error that the clock adds to it, sigma of dt by motion."""
    i, j = c.index(e.transform.a), c.index(e.transform.b)
    C = c.covariance[np.ix_([7 * i + 6, 7 * j + 6], [7 * i + 6, 7 * j + 6])]
    return e.transform.cov + np.outer(e.by_clock, e.by_clock) * (C[0, 0] + C[1, 1] - 2 * C[0, 1])


@settings(max_examples=8, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_no_pair_comes_out_worse_than_its_own_covariance_allows(seed):
    T, motion, estimates = drawn(np.random.default_rng(seed))
    found = combine(motion, estimates)
    for i, a in enumerate(NAMES):
        for b in NAMES[:i]:
            # both at the same poses, or the lever arms differ
            by_motion = replace(found.calibration, covariance=motion.covariance).between(a, b).cov
            if not any("by motion contradicts" in n for n in found.notes):
                assert at_most(found.calibration.between(a, b).cov, by_motion, 1e-2)
    for e, used in zip(estimates, found.used, strict=True):
        if used and e.transform.has_scale:
            pair = found.calibration.between(e.transform.a, e.transform.b)
            assert at_most(pair.cov, own(e, motion), 1e-2)
            # nor is the rig further from the truth than the estimate's own sigma makes likely
            a, b = motion.index(e.transform.a), motion.index(e.transform.b)
            error = difference_of(pair.T_a_b, se3.relative(T[a], T[b]))
            assert error @ np.linalg.solve(own(e, motion), error) < NEVER


def test_the_law_holds_to_rounding_where_nothing_is_off():
    for seed in range(10):
        T, motion, estimates = drawn(np.random.default_rng(seed))
        motion = replace(motion, T_base_sensor=T)
        right = []
        for e in estimates:
            a, b = NAMES.index(e.transform.a), NAMES.index(e.transform.b)
            right.append(seen(a, b, e.metric, None, e.transform.cov, e.by_clock, e.transform.has_scale, T))
        found = combine(motion, right)
        assert all(found.used)
        assert at_most(found.calibration.covariance[7:, 7:], motion.covariance[7:, 7:])
        for e in right:
            pair = found.calibration.between(e.transform.a, e.transform.b)
            if e.transform.has_scale:
                assert at_most(pair.cov, own(e, motion))
            else:
                distance = np.linalg.norm(pair.T_a_b[:3, 3])
                across = evidence(e, NAMES).across
                told = np.block([[across.T / distance, np.zeros((2, 3))], [np.zeros((3, 3)), np.eye(3)]])
                assert at_most(told @ pair.cov @ told.T, evidence(e, NAMES).cov)


def test_errors_are_what_the_covariance_says_and_less_than_before():
    squares, better = [], []
    for seed in range(12):
        T, motion, estimates = drawn(np.random.default_rng(seed))
        # one metric a pair: then what is drawn is what is assumed, but for what pairs of a sensor share
        estimates = [e for e in estimates if e.metric != "gom"]
        c = combine(motion, estimates).calibration
        error = difference(c, T)[1:]
        rows = [7 * i + k for i in (1, 2, 3) for k in range(6)]
        squares.append(error.ravel() @ np.linalg.solve(c.covariance[np.ix_(rows, rows)], error.ravel()) / 18)
        better.append([error**2, difference(motion, T)[1:] ** 2])
    assert 0.7 < np.mean(squares) < 1.35
    after, before = np.sum(better, axis=(0, 2))
    assert after[:3].sum() < 0.1 * before[:3].sum()
    assert after[3:].sum() < 0.5 * before[3:].sum()


def test_exact_estimates_give_the_truth():
    rng = np.random.default_rng(3)
    T = random_rig(rng)
    pairs = [seen(0, 1, T=T), seen(2, 0, T=T), seen(1, 3, T=T), seen(2, 3, has_scale=False, T=T)]
    found = combine(moved(T), pairs)
    assert all(found.used)
    assert_allclose(found.calibration.T_base_sensor, T, atol=1e-9)
    assert found.notes == ()


def test_estimates_that_are_sure_win_over_a_motion_result_that_is_not():
    T = random_rig(np.random.default_rng(4))
    error = np.random.default_rng(5).normal(size=(4, 7)) * BY_MOTION * (np.arange(4) > 0)[:, None]
    sure = np.diag(np.full(6, 1e-12))
    pairs = [seen(0, 1, cov=sure, T=T), seen(2, 0, cov=sure, T=T), seen(1, 3, cov=sure, T=T)]
    found = combine(moved(T, error), pairs)
    assert_allclose(found.calibration.T_base_sensor, T, atol=1e-8)


def test_without_estimates_motion_stays_as_it_is():
    motion = moved(error=np.random.default_rng(0).normal(size=(4, 7)) * 0.01)
    for method in (combine, combine_paper):
        c = method(motion, []).calibration
        assert_allclose(c.T_base_sensor, motion.T_base_sensor, atol=1e-9)
    assert_allclose(combine(motion, []).calibration.covariance, motion.covariance, atol=1e-15)


def test_a_pair_in_either_order_says_the_same():
    error = np.array([0.02, 0.01, -0.01, 0.001, 0.002, -0.001])
    one = seen(0, 2, error=error, by_clock=np.array([8.0, 1, 0, 0, 0, 0.1]))
    T, cov = one.transform.T_a_b, one.transform.cov
    J = se3.relative_jacobians(T, np.eye(4))[0]
    other = PairEstimate("im", Transform("cam0", "velo", se3.invert(T), J @ cov @ J.T), by_clock=-J @ one.by_clock)
    a, b = (combine(moved(), [e]).calibration for e in (one, other))
    # a large turn's Jacobians differ by the second order of the error
    assert_allclose(a.T_base_sensor, b.T_base_sensor, atol=2e-5)
    assert_allclose(a.covariance, b.covariance, atol=1e-6)


def test_a_direction_tells_where_but_not_how_far():
    t = np.array([2.0, 0.5, -0.5])
    true = np.array([np.eye(4), se3.rigid(TRUE[2, :3, :3], t)])
    cov = np.zeros((2, 7, 2, 7))
    cov[1, :, 1] = np.diag(BY_MOTION**2)
    motion = moved(true, np.array([[0] * 7, [0.1, 0.1, 0.2, 0, 0, 0, 0]]), cov)
    sure = seen(0, 1, cov=np.diag([1e-10] * 6), has_scale=False, T=true)
    c = combine(motion, [sure]).calibration
    found = c.T_base_sensor[1, :3, 3]
    assert_allclose(found / np.linalg.norm(found), t / np.linalg.norm(t), atol=1e-4)
    along = t / np.linalg.norm(t)
    sigma = np.sqrt(along @ c.covariance[7:10, 7:10] @ along)
    assert 0.1 < sigma < 0.3
    across = np.cross(along, [0, 0, 1.0]) / np.linalg.norm(np.cross(along, [0, 0, 1.0]))
    assert np.sqrt(across @ c.covariance[7:10, 7:10] @ across) < 1e-3


def test_a_direction_says_nothing_where_the_distance_may_be_none():
    wide = moved().covariance.copy()
    wide[[14, 15, 16, 21, 22, 23], [14, 15, 16, 21, 22, 23]] = 1.0
    motion = replace(moved(), covariance=wide)
    found = combine(motion, [seen(2, 3, has_scale=False)])
    assert found.used == (True,)
    assert_allclose(found.calibration.covariance[14:17, 14:17], wide[14:17, 14:17], rtol=1e-3)
    turned = found.calibration.between("cam0", "cam1").cov[3:, 3:]
    assert at_most(turned, np.diag(BY_LOOK[3:] ** 2))


def test_cameras_in_one_place_are_turned_alone():
    T = TRUE.copy()
    T[:, :3, 3] = 0
    motion = replace(moved(T), determined=np.repeat([[False] * 3 + [True] * 4], 4, axis=0))
    found = combine(motion, [seen(2, 3, has_scale=False, error=np.array([0, 0, 0, 1e-3, 0, 0]))])
    assert np.all(np.isfinite(found.calibration.T_base_sensor))
    assert not found.calibration.determined[1:, :3].any()


def test_the_clock_moves_its_pairs_together():
    # the clock of the cameras is 4 ms off; both estimates went 8 m/s wrong with it, and motion knows the poses well
    cov = moved().covariance.copy().reshape(4, 7, 4, 7)
    for i in range(1, 4):
        cov[i, :6, i, :6] = np.diag([1e-8] * 6)
    for i in (2, 3):
        for j in (2, 3):
            cov[i, 6, j, 6] = 0.003**2  # one clock
    error = np.zeros((4, 7))
    error[2:, 6] = 0.004
    by_clock = np.array([8.0, 0, 0, 0, 0, 0])
    motion = moved(error=error, cov=cov)
    off = by_clock * 0.004
    tight = np.diag([0.001**2] * 3 + [1e-6] * 3)
    pairs = [seen(0, k, error=off, cov=tight, by_clock=by_clock) for k in (2, 3)]
    found = combine(motion, pairs)
    assert all(found.used)
    c = found.calibration
    assert_allclose(c.dt_base_sensor, 0, atol=2e-4)
    assert_allclose(c.dt_base_sensor[2], c.dt_base_sensor[3], atol=1e-9)
    assert c.sigma[2, 6] < 2e-4
    # without it the clock's error is the pairs' own
    assert not all(combine(motion, [replace(p, by_clock=np.zeros(6)) for p in pairs]).used)


def test_the_clock_is_an_error_of_the_pair_where_nothing_else_tells_it():
    by_clock = np.array([8.0, 0, 0, 0, 0, 0])
    tight = np.diag([1e-3**2] * 3 + [1e-6] * 3)
    c = combine(moved(), [seen(0, 2, cov=tight, by_clock=by_clock)]).calibration
    expected = 1 / np.sqrt(1 / (1e-6 + (8 * BY_MOTION[6]) ** 2) + 1 / BY_MOTION[0] ** 2)
    assert_allclose(c.sigma[2, 0], expected, rtol=1e-2)


def test_a_failed_pair_is_left_out_and_said():
    good = [seen(0, 2), seen(0, 3), seen(2, 3, has_scale=False, cov=np.diag([1e-4] * 6))]
    bad = seen(0, 2, "nmi", error=np.array([0.8, 0.0, 0.3, 0.0, 0.05, 0.0]))
    found = combine(moved(), [good[0], bad, *good[1:]])
    assert found.used == (True, False, True, True)
    (note,) = found.notes
    assert note.startswith("nmi of velo and cam0 was left out: ")
    assert_allclose(found.calibration.T_base_sensor, TRUE, atol=1e-9)


def test_a_single_estimate_does_not_overrule_motion():
    bad = seen(0, 2, error=np.array([0.8, 0, 0, 0, 0.05, 0]))
    found = combine(moved(), [bad])
    assert found.used == (False,)
    assert_allclose(found.calibration.T_base_sensor, TRUE, atol=1e-9)


@pytest.mark.parametrize("witnesses", [((0, 2, "im"), (0, 2, "nmi")), ((0, 2, "im"), (2, 3, "x"), (0, 3, "im"))])
def test_motion_gives_way_to_estimates_that_agree(witnesses):
    error = np.zeros((4, 7))
    error[2, :6] = [0.5, -0.5, 1.5, 0.02, 0.02, 0.01]  # 5 sigma
    found = combine(moved(error=error), [seen(*w) for w in witnesses])
    assert all(found.used)
    (note,) = found.notes
    assert note.startswith("the pose of cam0 by motion contradicts")
    assert np.abs(difference(found.calibration, TRUE)).max() < 0.01
    assert found.calibration.sigma[2, 1] < 0.011


def test_motion_of_two_sensors_that_are_a_pair_gives_way():
    error = np.zeros((4, 7))
    error[2:, :6] = np.array([[0.5, -0.5, 1.5, 0.02, 0.02, 0.01], [-0.5, 0.5, 1.5, 0.02, -0.02, -0.01]])
    cameras = [seen(0, k, metric) for k in (2, 3) for metric in ("im", "gom")]
    found = combine(moved(error=error), [*cameras, seen(2, 3, "features", has_scale=False, cov=np.eye(6) * 1e-5)])
    assert all(found.used)
    assert len(found.notes) == 2
    assert np.abs(difference(found.calibration, TRUE)).max() < 0.01


def test_what_can_not_be_used_is_said():
    diverged = replace(seen(0, 2), converged=False, note="the two see different places")
    broken = replace(seen(0, 3), by_clock=np.full(6, np.nan))
    negative = seen(0, 3, "gom", cov=np.diag([1, 1, 1, 1, 1, -1.0]))
    stranger = replace(seen(0, 2), transform=replace(seen(0, 2).transform, b="radar"))
    for method in (combine, combine_paper):
        found = method(moved(), [diverged, broken, negative, stranger])
        assert not any(found.used)
        assert found.notes == (
            "im of velo and cam0 was left out: the two see different places",
            "im of velo and cam1 was left out: it holds numbers that are not finite",
            "gom of velo and cam1 was left out: its covariance is not positive",
            "im of velo and radar was left out: these are not two sensors of the rig",
        )


def test_half_a_turn_off_is_no_obstacle():
    T = TRUE.copy()
    T[1, :3, :3] = np.diag([-1.0, -1.0, 1.0])
    error = np.zeros((4, 7))
    error[1, :6] = [0.05, -0.05, 0.1, 0.003, -0.003, 0.002]
    found = combine(moved(T, error), [seen(0, 1, cov=np.diag([1e-12] * 6), T=T)])
    assert_allclose(found.calibration.T_base_sensor[1], T[1], atol=1e-8)


def unknown_height(error=3.0):
    """A motion result of which the height of two sensors is open."""
    open_ = tuple(Undetermined({f"{n}.z": 1.0}, f"the height of {n} is open") for n in ("ins", "cam0"))
    determined = np.ones((4, 7), dtype=bool)
    determined[[1, 2], 2] = False
    cov = moved().covariance.copy()
    off = np.zeros((4, 7))
    for i in (1, 2):
        cov[7 * i + 2, 7 * i + 2] += 2.0**2
        off[i, 2] = error
    return moved(error=off, cov=cov, undetermined=open_, determined=determined)


def test_an_undetermined_height_becomes_determined():
    found = combine(unknown_height(), [seen(0, 2)])
    c = found.calibration
    assert found.used == (True,)
    # what was put in for the unknown height holds no information: not even a thousandth of a sigma
    assert_allclose(c.T_base_sensor[2, 2, 3], TRUE[2, 2, 3], atol=1e-5)
    assert c.determined[2].all()
    assert not c.determined[1, 2]
    assert [u.sentence for u in c.undetermined] == ["the height of ins is open"]
    assert c.sigma[2, 2] < 0.0101


def test_a_pair_of_two_sensors_without_height_leaves_both_open():
    found = combine(unknown_height(1.0), [seen(1, 2)])
    c = found.calibration
    assert not c.determined[[1, 2], 2].any()
    assert len(c.undetermined) == 2
    assert c.between("ins", "cam0").cov[2, 2] < 0.02**2
    assert np.sqrt(c.covariance[9, 9]) < 2.1


def test_what_was_not_stated_holds_no_information():
    motion = unknown_height()
    lost = np.zeros((28, 28))
    lost[7:, 7:] = motion.covariance[7:, 7:]
    lost[[9, 16]] = lost[:, [9, 16]] = 0.0
    motion = replace(motion, covariance=lost, undetermined=())
    c = combine(motion, [seen(0, 2)]).calibration
    assert_allclose(c.T_base_sensor[2, 2, 3], TRUE[2, 2, 3], atol=1e-5)
    assert c.determined[2, 2]
    assert not c.determined[1, 2]
    assert_allclose(c.sigma[2, 2], 0.01, rtol=1e-3)


def test_metrics_of_a_pair_count_as_little_more_than_one():
    one, two = (combine(moved(), [seen(0, 2, m) for m in metrics]) for metrics in (["im"], ["im", "gom"]))
    ratio = two.calibration.sigma[2, 1] / one.calibration.sigma[2, 1]
    assert 0.93 < ratio < 0.97
    coarse = seen(0, 2, "nmi", cov=np.diag((10 * BY_LOOK) ** 2))
    both = combine(moved(), [seen(0, 2), coarse])
    assert 0.99 < both.calibration.sigma[2, 1] / one.calibration.sigma[2, 1] <= 1


def test_pairs_of_one_sensor_go_together():
    everything = [evidence(e, NAMES) for e in drawn(np.random.default_rng(1))[2]]
    T = drawn(np.random.default_rng(1))[0]
    cov = shared.covariance(everything, T)
    unit = np.sqrt(np.diag(cov))
    assert np.linalg.eigvalsh(cov / np.outer(unit, unit)).min() > 0
    assert_allclose(cov[:6, :6], everything[0].cov, rtol=1e-9)
    assert np.abs(cov[:6, 12:18]).max() > 0  # both see through the lidar


def test_the_larger_of_two_informations_is_above_both_and_touches_them():
    rng = np.random.default_rng(0)
    A, B = definite(rng, np.ones(4)), definite(rng, np.ones(4))
    C = shared.larger(A, B)
    for D in (A, B):
        assert np.linalg.eigvalsh(C - D).min() > -1e-9
        assert_allclose(np.linalg.det(C - D), 0, atol=1e-9)
    assert_allclose(shared.larger(A, 4 * A), 4 * A, rtol=1e-9)
    along = np.diag([1e6, 0.0])
    assert_allclose(shared.larger(along, np.diag([0.0, 1e-2])), np.diag([1e6, 1e-2]), rtol=1e-3)


def test_the_papers_form_finds_about_the_same():
    T, motion, estimates = drawn(np.random.default_rng(8))
    ours, papers = combine(motion, estimates), combine_paper(motion, estimates)
    assert all(papers.used)
    c = papers.calibration
    assert np.all(np.abs(difference(c, T)[2:]) < 5 * ours.calibration.sigma[2:, :6] + 0.03)
    assert_allclose(c.dt_base_sensor, motion.dt_base_sensor)


def test_the_papers_form_counts_motion_once_for_each_pair():
    c = combine_paper(moved(), []).calibration
    assert np.all(c.sigma[1:, :6] < 0.9 * BY_MOTION[:6])


def test_the_papers_form_with_exact_transforms_stays_at_the_truth():
    found = combine_paper(moved(), [seen(0, 2), seen(3, 0), seen(2, 3, has_scale=False)])
    assert_allclose(found.calibration.T_base_sensor, TRUE, atol=1e-6)


def test_inputs_are_left_alone_and_answers_repeat():
    _, motion, estimates = drawn(np.random.default_rng(2))
    before = motion.covariance.copy(), motion.T_base_sensor.copy()
    first, again = (combine(motion, estimates).calibration for _ in range(2))
    assert_allclose(first.covariance, again.covariance, rtol=0, atol=0)
    assert_allclose(motion.covariance, before[0], rtol=0, atol=0)
    assert_allclose(motion.T_base_sensor, before[1], rtol=0, atol=0)
