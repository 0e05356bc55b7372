"""Looks at a given calibration and at poses beside it: what is told, what is not, and who decides."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from builders import bowl
from numpy.testing import assert_allclose

from calib_toolkit import (
    Calibration,
    Config,
    CostMetric,
    Log,
    Motions,
    PairEstimate,
    Stream,
    Transform,
    se3,
)
from calib_toolkit.appearance import checking
from calib_toolkit.appearance.checking import STEPS, Look, check, judge
from calib_toolkit.progress import Silent

READINGS = 301
SIGMA = np.array([0.1] * 3 + [0.01] * 3)
TRUE = se3.matrix([0.3, -0.2, 0.5, 0.1, 1.5, -0.4])
CONFIG = Config(moments=10, jobs=1)


class Bowl(CostMetric):
    """Costs like a bowl around a pose that is a little different at every moment."""

    def __init__(self, id="bowl", best=TRUE, shape=1 / SIGMA, kinds=("lidar", "camera")):
        self.id, self.best, self.shape, self.kinds, self.rows = id, best, shape, kinds, []

    def accepts(self, kind_a, kind_b):
        return (kind_a, kind_b) == self.kinds

    def prepare(self, pair, options):
        self.rows.append(int(pair.selected[0, 1]))
        return np.random.default_rng(self.rows[-1]).normal(size=6) * SIGMA / 10

    def cost(self, T_a_b, pair):
        return float(self.costs(T_a_b[None], pair)[0])

    def costs(self, T_a_b, moment):
        return bowl(T_a_b, self.best, moment, self.shape)


class Told:
    """A metric with a search of its own, which finds what it is told to."""

    id = "bowl"
    options = type("Nothing", (), {})

    def __init__(self, T, cov, has_scale=True):
        self.found = T, cov, has_scale

    def accepts(self, kind_a, kind_b):
        return (kind_a, kind_b) == ("lidar", "camera")

    def overlap(self, pair):
        return True

    def estimate(self, pair, options):
        T, cov, has_scale = self.found
        return PairEstimate("bowl", Transform(pair.a.name, pair.b.name, T, cov, has_scale), np.full(6, 2.0))


def off(error, T=TRUE):
    """A pose that much from another: metres, then radians in axes of a."""
    error = np.asarray(error, dtype=float)
    return se3.rigid(se3.exp_so3(error[3:]) @ T[:3, :3], T[:3, 3] + error[:3])


def checked(T, *metrics, config=CONFIG, readings=READINGS, sigma_dt=0.0, kinds=("lidar", "camera")):
    """The check of a rig of velo and cam0 (and more) at one pose, on a drive round a bend."""
    stamps = 0.1 * np.arange(readings)
    vec = np.zeros((readings - 1, 6))
    vec[:, 0], vec[:, 5] = 0.5, 0.01
    motion = Motions(stamps[:-1], stamps[1:], vec, np.tile(1e-8 * np.eye(6), (readings - 1, 1, 1)))
    names = ("velo", "cam0", "cam1")[: len(kinds)]
    streams = {n: Stream(n, kind, stamps, list(stamps)) for n, kind in zip(names, kinds, strict=True)}
    poses = np.array([np.eye(4), *[T] * (len(names) - 1)])
    cov = np.zeros((len(names), 7))
    cov[1:, 6] = sigma_dt**2
    known = np.ones((len(names), 7), dtype=bool)
    rig = Calibration("velo", names, poses, np.zeros(len(names)), np.diag(cov.ravel()), known[:, 0], known)
    plugins = SimpleNamespace(metrics={m.id: m for m in metrics})
    chosen = replace(config, appearance=tuple(m.id for m in metrics))
    return check(Log("drive", streams), dict.fromkeys(names, motion), rig, chosen, plugins, Silent())


def test_a_good_calibration_is_fine():
    found = checked(TRUE, Bowl())
    (pair,) = found.judgements
    assert found.fine
    assert (pair.a, pair.b) == ("velo", "cam0")
    assert pair.shown.all()
    assert not pair.better.any()
    assert np.all(np.abs(pair.lead.move) < 3 * pair.lead.sigma)
    assert np.all(pair.lead.gain < 0)


@pytest.mark.parametrize(
    ("axis", "by"), [(1, 0.05), (1, -0.05), (0, 0.08), (3, np.radians(0.5)), (5, -np.radians(0.5))]
)
def test_a_pose_that_is_off_is_told_with_axis_sign_and_length(axis, by):
    found = checked(off(by * np.eye(6)[axis]), Bowl())
    (pair,) = found.judgements
    assert not found.fine
    assert_allclose(pair.better, -np.sign(by) * np.eye(6)[axis])
    assert np.flatnonzero(pair.told).tolist() == [axis]
    assert_allclose(pair.lead.move[axis], -by, atol=0.01)
    assert pair.lead.favours[axis] * np.sign(by) < -3


def test_a_fault_smaller_than_what_metrics_are_off_on_any_drive_is_not_told():
    found = checked(off([0.015, 0, 0, 0, 0, 0]), Bowl())
    assert np.nanmax(found.judgements[0].looks[0].gain[2, 0]) > 3
    assert found.fine


def test_costs_are_those_of_the_steps():
    look = checked(off([0.1, 0, 0, 0, 0, 0]), Bowl()).judgements[0].looks[0]
    there = np.argmin(look.costs[:, 0])
    assert STEPS[there, 0] == -0.1
    assert look.costs[there, 0] < look.cost < look.costs[-1, 0]


def test_an_axis_that_does_not_show_is_not_called_good():
    shape = 1 / SIGMA
    shape[2] = 0.0
    found = checked(TRUE, Bowl(shape=shape))
    assert not found.judgements[0].shown[2]
    assert found.judgements[0].shown[[0, 1, 3, 4, 5]].all()
    assert found.open_ == ("cam0",)
    assert not found.fine


def test_moments_are_those_that_a_run_would_not_choose():
    metric = Bowl()
    look = checked(TRUE, metric).judgements[0].looks[0]
    stamps = 0.1 * np.arange(READINGS)
    stream = Stream("velo", "any", stamps, list(stamps))
    still = Motions(
        stamps[:-1], stamps[1:], np.tile([0.5, 0, 0, 0, 0, 0.01], (READINGS - 1, 1)), np.zeros((300, 6, 6))
    )
    run = checking.select(stream, stream, still, 0.0, CONFIG.moments, CONFIG.seed)
    assert len(run) == CONFIG.moments
    assert not set(metric.rows) & set(run[:, 1].tolist())
    assert look.held_out
    assert look.moments > 2 * CONFIG.moments


def test_a_drive_too_short_for_others_says_so():
    look = checked(TRUE, Bowl(), readings=20).judgements[0].looks[0]
    assert not look.held_out
    assert look.moments == 20


def test_a_drive_too_short_for_anything_is_not_fine():
    found = checked(TRUE, Bowl(), readings=6)
    assert found.judgements[0].lead is None
    assert "only 6 of 6 moments" in found.judgements[0].looks[0].note
    assert not found.fine


def test_sensors_that_nothing_compares_are_named():
    found = checked(TRUE, Bowl(), kinds=("lidar", "camera", "radar"))
    assert found.alone == ("cam1",)
    assert found.open_ == ("cam1",)
    assert not found.fine


def test_a_metric_with_its_own_search_is_asked_around_the_given_pose():
    cov = np.diag([0.01] * 3 + [0.001] * 3) ** 2
    (pair,) = checked(TRUE, Told(off([0, 0.05, 0, 0, 0, 0]), cov)).judgements
    assert_allclose(pair.lead.move, [0, 0.05, 0, 0, 0, 0], atol=1e-12)
    assert_allclose(pair.lead.favours, [0, 5, 0, 0, 0, 0], atol=1e-6)
    assert np.isnan(pair.lead.gain).all()
    (unsure,) = checked(TRUE, Told(off([0, 0.05, 0, 0, 0, 0]), cov), sigma_dt=0.01).judgements
    assert not unsure.better.any()


def test_a_direction_alone_tells_nothing_of_the_distance():
    T = TRUE.copy()
    T[:3, 3] /= np.linalg.norm(T[:3, 3])
    across = np.eye(3) - np.outer(T[:3, 3], T[:3, 3])
    cov = np.zeros((6, 6))
    cov[:3, :3], cov[3:, 3:] = 1e-4 * across, 1e-6 * np.eye(3)
    look = checked(TRUE, Told(T, cov, has_scale=False)).judgements[0].looks[0]
    assert_allclose(look.move, 0, atol=1e-12)
    assert look.shown.tolist() == [False, False, False, True, True, True]
    length = np.linalg.norm(TRUE[:3, 3])
    assert_allclose(np.trace(look.cov[:3, :3]), 1 + 2e-4 * length**2)


def look(metric, move, sigma=0.01):
    nothing = np.full(STEPS.shape, np.nan)
    cov = np.diag(np.broadcast_to(sigma, 6).astype(float) ** 2)
    way = np.full(checking.PARTS.shape, np.nan)
    move = np.asarray(move, dtype=float)
    return Look(metric, "velo", "cam0", 25, True, np.nan, nothing, nothing, way, move, cov, np.zeros(6))


def test_steps_no_longer_than_what_a_metric_is_off_by_do_not_count():
    clear = np.where(STEPS > 0, 10.0, np.nan)
    one = replace(look("a", np.zeros(6)), gain=clear)
    assert (one.favours > 0).all()
    leaning = replace(one, own=np.array([0, 0, 0.05, 0, 0, 0]))
    assert leaning.favours[2] == 0
    assert (np.delete(leaning.favours, 2) > 0).all()


def test_a_way_along_a_valley_is_told_where_no_axis_alone_is():
    one = look("a", [0, 0.028, 0, 0, 0, 0.001])
    assert not one.favours.any()
    better = replace(one, on_the_way=np.array([3.5, 3.1, 1.0]))
    assert_allclose(better.favours, [0, 3.5, 0, 0, 0, 0])
    assert not replace(better, move=0.8 * better.move).favours.any()


def test_most_metrics_decide():
    moved, still = 0.05 * np.eye(6)[1], np.zeros(6)
    fine, wide = look("b", still, 0.001), look("c", still, 1.0)
    assert judge((look("a", moved), look("b", moved), look("c", still))).better.tolist() == [0, 1, 0, 0, 0, 0]
    assert judge((look("a", moved), wide)).better[1] == 1  # who sees nothing has no vote
    outvoted = judge((look("a", moved, 0.004), look("b", still), look("c", still)))
    assert not outvoted.better.any()
    assert outvoted.disputed[1]
    assert not judge((look("a", moved), fine, look("c", still))).disputed.any()
    assert not judge((look("a", moved), look("b", -moved))).better.any()
