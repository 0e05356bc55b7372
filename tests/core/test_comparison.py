"""Comparing two calibrations: false alarms as rare as promised, one verdict from any base, no blind spots."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from calib_toolkit import se3
from calib_toolkit.comparison import CHANCE, compare, within
from calib_toolkit.errors import DataError
from calib_toolkit.types import Calibration

NAMES = ("velo", "ins", "cam0")
TRUE = se3.matrix([[0.0] * 6, [-0.8, 0.3, -0.8, 0.01, 0.02, 3.1], [0.3, 0.1, -0.1, -1.2, 1.2, -1.2]])
DT = np.array([0.0, -0.06, 0.03])


def random_cov(rng, scale=1e-3):
    """Full, of two sensors with poses and clocks."""
    A = rng.normal(size=(14, 14))
    return scale**2 * (A @ A.T / 14 + 0.1 * np.eye(14))


def rig(cov=None, error=None, names=NAMES, **changed):
    """The true rig with errors on its two other sensors, as the covariance tells them or exact."""
    e = np.zeros((3, 7)) if error is None else np.concatenate([np.zeros((1, 7)), np.reshape(error, (2, 7))])
    poses = se3.rigid(se3.exp_so3(e[:, 3:6]) @ TRUE[:, :3, :3], TRUE[:, :3, 3] + e[:, :3])
    C = np.zeros((21, 21))
    C[7:, 7:] = 0.0 if cov is None else cov
    known = np.ones((3, 7), dtype=bool)
    c = Calibration(names[0], names, poses, DT + e[:, 6], C, np.ones(3, dtype=bool), known)
    return replace(c, **changed)


def noisy(rng, cov, **changed):
    return rig(cov, rng.multivariate_normal(np.zeros(14), cov), **changed)


def seen_from(c, base):
    """The same calibration with another base, its covariance by central differences."""

    def carried(x):
        e = x.reshape(-1, 7)
        T = se3.rigid(se3.exp_so3(e[:, 3:6]) @ c.T_base_sensor[:, :3, :3], c.T_base_sensor[:, :3, 3] + e[:, :3])
        i = c.index(base)
        dt = c.dt_base_sensor + e[:, 6]
        return se3.relative(np.broadcast_to(T[i], T.shape), T), dt - dt[i]

    T, dt = carried(np.zeros(7 * len(c.names)))
    J = np.zeros((c.covariance.shape[0],) * 2)
    for k, h in enumerate(1e-6 * np.eye(len(J))):
        (T_p, dt_p), (T_m, dt_m) = carried(h), carried(-h)
        turn = se3.log_so3(T_p[:, :3, :3] @ np.swapaxes(T_m[:, :3, :3], 1, 2))
        J[:, k] = np.column_stack([T_p[:, :3, 3] - T_m[:, :3, 3], turn, dt_p - dt_m]).ravel() / 2e-6
    return replace(c, base=base, T_base_sensor=T, dt_base_sensor=dt, covariance=J @ c.covariance @ J.T)


def test_false_alarms_are_as_rare_as_promised_and_chi_square_is_one():
    rng, n = np.random.default_rng(1), 1500
    C_a, C_b = random_cov(rng), random_cov(rng)
    found = [compare(noisy(rng, C_a), seen_from(noisy(rng, C_b), "ins")) for _ in range(n // 10)]
    found += [compare(noisy(rng, C_a), noisy(rng, C_b)) for _ in range(n - len(found))]
    assert {f.overall.dof for f in found} == {14}
    chi2 = np.array([f.overall.chi2 for f in found])
    assert abs(chi2.mean() - 14) < 3 * np.sqrt(2 * 14 / n)
    band = 3 * np.sqrt(CHANCE * (1 - CHANCE) / n)
    assert abs(np.mean([f.overall.differs for f in found]) - CHANCE) < band
    for name in NAMES[1:]:
        alone = [f.sensors[name] for f in found]
        assert {t.dof for t in alone} == {7}
        assert abs(np.mean([t.chi2 for t in alone]) - 7) < 3 * np.sqrt(2 * 7 / n)
        assert abs(np.mean([t.differs for t in alone]) - CHANCE) < band
    p = np.sort([f.overall.p for f in found])
    assert np.abs(p - (np.arange(n) + 0.5) / n).max() < 1.63 / np.sqrt(n)  # Kolmogorov-Smirnov, 1 %


def test_what_moved_by_five_sigma_is_found_and_nothing_else():
    rng = np.random.default_rng(2)
    C = random_cov(rng)
    missed = blamed = 0
    for _ in range(200):
        a, b = noisy(rng, C), noisy(rng, C)
        b.T_base_sensor[2, :3, :3] = (
            se3.exp_so3([0, 0, 5 * np.sqrt(2 * C[12, 12])]) @ b.T_base_sensor[2, :3, :3]
        )  # cam0's yaw
        found = compare(a, b)
        missed += not found.sensors["cam0"].differs
        blamed += found.sensors["ins"].differs
    assert missed <= 10
    assert blamed <= 7


@pytest.fixture
def pair():
    rng = np.random.default_rng(3)
    C_a, C_b = random_cov(rng, 1e-4), random_cov(rng, 2e-4)
    return noisy(rng, C_a), noisy(rng, C_b)


def test_the_order_of_the_two_changes_signs_only(pair):
    a, b = pair
    there, back = compare(a, b), compare(b, a)
    assert_allclose(there.overall.chi2, back.overall.chi2, rtol=1e-9)
    assert_allclose(there.difference, -back.difference, atol=1e-15)


@pytest.mark.parametrize(
    "bases", [("ins", "ins"), ("cam0", "cam0"), ("velo", "cam0"), ("ins", "velo"), ("cam0", "ins")]
)
def test_the_verdict_does_not_depend_on_the_bases(pair, bases):
    a, b = (seen_from(c, base) for c, base in zip(pair, bases, strict=True))
    found = compare(a, b)
    assert found.a.base == found.b.base == bases[0]
    assert_allclose(found.overall.chi2, compare(*pair).overall.chi2, rtol=2e-3)


def test_sensors_come_in_any_order_and_those_of_one_alone_are_left_out(pair):
    a, b = pair
    order = [2, 0, 1]
    rows = np.arange(21).reshape(3, 7)[order].ravel()
    shuffled = replace(
        b,
        names=tuple(b.names[k] for k in order),
        T_base_sensor=b.T_base_sensor[order],
        dt_base_sensor=b.dt_base_sensor[order],
        covariance=b.covariance[np.ix_(rows, rows)],
    )
    assert_allclose(compare(a, shuffled).overall.chi2, compare(a, b).overall.chi2, rtol=1e-9)
    renamed = replace(b, names=("velo", "radar", "cam0"))
    found = compare(a, renamed)
    assert (found.a.names, found.overall.dof) == (("velo", "cam0"), 7)
    assert_allclose(found.overall.chi2, compare(a, b).sensors["cam0"].chi2, rtol=1e-9)


def test_a_base_that_the_other_does_not_have_gives_way(pair):
    a, b = pair
    found = compare(replace(a, base="lidar", names=("lidar", "ins", "cam0")), b)
    assert (found.a.base, found.a.names) == ("ins", ("ins", "cam0"))
    assert_allclose(found.overall.chi2, within(compare(a, b), ("ins", "cam0")).overall.chi2, rtol=2e-3)


@pytest.mark.parametrize(("names", "sentence"), [(("velo", "a", "b"), "they share only velo"), ("abc", "no sensor")])
def test_fewer_than_two_sensors_in_common_are_refused(pair, names, sentence):
    with pytest.raises(
        DataError, match=rf"{sentence}, and comparing takes at least two.*has velo, ins, cam0, the second"
    ):
        compare(pair[0], replace(pair[1], names=tuple(names), base=names[0]))


# --- what one of them does not determine


def without(c, *parameters):
    known = c.determined.copy()
    for i, k in parameters:
        known[i, k] = False
    return replace(c, determined=known)


def test_what_either_does_not_determine_is_not_compared(pair):
    a, b = pair
    a, b = without(a, (2, 2)), without(b, (1, 6), (2, 2))
    a.T_base_sensor[2, 2, 3], b.dt_base_sensor[1] = np.nan, 99.0
    found = compare(a, b)
    assert np.argwhere(np.isnan(found.difference)).tolist() == [[1, 6], [2, 2]]
    assert (found.overall.dof, found.overall.compared) == (12, 12)
    kept = np.setdiff1d(np.arange(7, 21), [13, 16])
    d, C = found.difference.ravel()[kept], (a.covariance + b.covariance)[np.ix_(kept, kept)]
    assert_allclose(found.overall.chi2, d @ np.linalg.solve(C, d), rtol=1e-9)


@pytest.mark.parametrize("angle", [0.5, -2.0, np.pi])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_rotation_that_was_not_determined_spoils_no_other_axis(axis, angle):
    """A straight drive leaves roll at any value; the two others still compare as if it were known."""
    cov = 1e-6 * np.eye(14)
    a, b = rig(cov), rig(cov, np.random.default_rng(4).normal(0, 1e-3, 14))
    plain = compare(a, b).difference
    a.T_base_sensor[2, :3, :3] = se3.exp_so3(angle * np.eye(3)[axis]) @ a.T_base_sensor[2, :3, :3]
    found = compare(without(a, (2, 3 + axis)), b)
    others = 3 + np.setdiff1d(range(3), axis)
    assert np.isnan(found.difference[2, 3 + axis])
    assert_allclose(found.difference[2, others], plain[2, others], atol=1e-5)


def test_with_no_axis_of_a_rotation_determined_position_and_clock_are_still_compared(pair):
    a, b = pair
    b.T_base_sensor[1, :3, :3] = np.diag([1.0, -1.0, -1.0])
    found = compare(a, without(b, (1, 3), (1, 4), (1, 5)))
    assert np.isnan(found.difference[1]).tolist() == [False] * 3 + [True] * 3 + [False]
    assert found.overall.dof == 11


def test_seen_from_another_base_a_pose_with_an_unknown_part_is_unknown(pair):
    a, b = pair
    b = without(b, (2, 2), (1, 6))
    b.T_base_sensor[2, 2, 3] = np.nan
    known = np.isfinite(compare(seen_from(a, "ins"), b).difference)
    assert known[1].tolist() == [True] * 6 + [False]  # velo, whose clock is known to ins no more than ins' to it
    assert known[2].tolist() == [False] * 3 + [True] * 3 + [False]


@pytest.mark.parametrize("k", range(7))
def test_what_is_unknown_of_the_new_base_is_unknown_of_all_sensors(pair, k):
    found = compare(seen_from(pair[0], "ins"), without(pair[1], (1, k)))
    position, rotation, time = k == 6, k not in (3, 4, 5), k != 6  # turning the new base swings all positions
    for row in np.isfinite(found.difference)[1:]:
        assert row.tolist() == [position] * 3 + [rotation] * 3 + [time]
    assert found.a.determined[0].all()


def test_nothing_determined_in_both_is_refused_and_one_sensor_without_is_no_verdict(pair):
    a, b = pair
    all_of = [(i, k) for i in (1, 2) for k in range(7)]
    with pytest.raises(DataError, match="no number of ins, cam0 in velo is determined in both"):
        compare(without(a, *all_of[::2]), without(b, *all_of[1::2]))
    found = compare(without(a, *all_of[:7]), b)
    assert found.sensors["ins"].compared == 0
    assert np.isnan(found.sensors["ins"].p)
    assert not found.sensors["ins"].differs
    assert found.overall.dof == 7


# --- what is known without error


def test_against_the_exact_truth_only_the_others_covariance_counts():
    rng = np.random.default_rng(5)
    C = random_cov(rng)
    e = rng.multivariate_normal(np.zeros(14), C)
    found = compare(rig(), rig(C, e))
    assert found.overall.dof == 14
    assert_allclose(found.overall.chi2, e @ np.linalg.solve(C, e), rtol=1e-9)


@pytest.mark.parametrize("k", range(7))
@pytest.mark.parametrize(("error", "differs"), [(0.9e-6, False), (-1.1e-6, True)])
def test_two_exact_ones_agree_within_a_millionth(k, error, differs):
    e = np.zeros((2, 7))
    e[1, k] = error
    found = compare(rig(), rig(error=e))
    assert (found.overall.differs, found.overall.dof, found.overall.compared) == (differs, 0, 14)
    assert found.overall.p == float(not differs)
    assert not found.sensors["ins"].differs
    assert compare(rig(), seen_from(rig(error=e), "cam0")).overall.differs or not differs


def test_two_sensors_on_one_clock_count_as_one_offset():
    C = 1e-6 * np.eye(14)
    C[6, 13] = C[13, 6] = 1e-6
    shifted = np.zeros((2, 7))
    shifted[:, 6] = 1e-3
    found = compare(rig(C), rig(C, shifted))
    assert found.overall.dof == 13
    assert_allclose(found.overall.chi2, 0.5, rtol=1e-6)
    shifted[1, 6] += 1e-5
    assert compare(rig(C), rig(C, shifted)).overall.p == 0.0


def test_drifting_clocks_are_compared_at_one_stamp():
    skew = np.array([0.0, 1e-5, 0.0])
    a = rig(1e-8 * np.eye(14), clock_skew=skew, t_ref=100.0)
    b = rig(1e-8 * np.eye(14), clock_skew=skew, t_ref=300.0, dt_base_sensor=DT + 200.0 * skew)
    found = compare(a, b)
    assert_allclose(found.difference[:, 6], 0.0, atol=1e-12)
    assert_allclose(found.a.dt_base_sensor[1], DT[1] + 100.0 * 1e-5)


def test_neither_calibration_is_changed(pair):
    before = [(c.T_base_sensor.copy(), c.covariance.copy(), c.determined.copy()) for c in pair]
    compare(*(without(c, (1, 3)) for c in pair))
    compare(*pair)
    for c, (T, C, known) in zip(pair, before, strict=True):
        assert np.array_equal(c.T_base_sensor, T)
        assert np.array_equal(c.covariance, C)
        assert np.array_equal(c.determined, known)
