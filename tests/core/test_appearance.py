"""The search that appearance metrics share: what it finds, how sure it is, when it refuses; what it looks at."""

from dataclasses import replace

import numpy as np
import pytest
from builders import bowl
from numpy.testing import assert_allclose

from calib_toolkit import Config, CostMetric, Motions, Pair, Stream, Transform, poses_at, se3
from calib_toolkit.appearance import pairs, refinement, search
from calib_toolkit.appearance.evidence import evidence
from calib_toolkit.errors import ConfigError, DataError
from calib_toolkit.plugins import Registry

STEPS = 100
SIGMA = np.array([0.1, 0.1, 0.2, 0.01, 0.01, 0.01])
TRUE = se3.matrix([0.3, -0.2, 0.5, 0.1, 1.5, -0.4])


def driven(speed=5.0, turn=0.1, standing=()):
    """A sensor that drives round a bend at 10 Hz, and stands where it is told to."""
    stamps = 0.1 * np.arange(STEPS + 1)
    vec = np.zeros((STEPS, 6))
    vec[:, 0], vec[:, 5] = 0.1 * speed, 0.1 * turn
    vec[list(standing)] = 0.0
    return Motions(stamps[:-1], stamps[1:], vec, np.tile(1e-8 * np.eye(6), (STEPS, 1, 1)))


def pair_at(T, dt=0.0, sigma=SIGMA, motion=None):
    motion = motion or driven()
    stamps = 0.1 * np.arange(STEPS + 1)
    a, b = (Stream(name, "any", stamps, list(range(STEPS + 1))) for name in "ab")
    selected = pairs.select(a, b, motion, dt, 25, 0)
    return Pair(a, b, motion, motion, dt, selected, Transform("a", "b", T, np.diag(sigma**2)))


class Bowl(CostMetric):
    """Costs like a bowl around a pose that is a little different at every moment."""

    id = "bowl"

    def __init__(self, best=TRUE, noise=SIGMA / 20, shape=1 / SIGMA, seed=0):
        self.best, self.noise, self.shape, self.seed = best, noise, shape, seed

    def accepts(self, kind_a, kind_b):
        return True

    def prepare(self, pair, options):
        rng = np.random.default_rng([self.seed, int(pair.selected[0, 1])])
        return rng.normal(size=6) * self.noise

    def cost(self, T_a_b, pair):
        return float(self.costs(T_a_b[None], pair)[0])

    def costs(self, T_a_b, moment):
        return bowl(T_a_b, self.best, moment, self.shape)


def off(T, error):
    """A pose that much from another: metres, then radians in axes of a."""
    return se3.rigid(se3.exp_so3(error[3:]) @ T[:3, :3], T[:3, 3] + error[:3])


def error_of(estimate):
    T = estimate.transform.T_a_b
    return np.concatenate([T[:3, 3] - TRUE[:3, 3], se3.log_so3(T[:3, :3] @ TRUE[:3, :3].T)])


def test_poses_follow_a_bend():
    stamps = np.array([2.0, 2.03, 3.3])
    angle = 0.1 * (stamps - 2.0)
    radius = 5.0 / 0.1
    T = poses_at(driven(), stamps, 2.0)
    assert_allclose(T[:, 0, 3], radius * np.sin(angle), atol=5e-3)
    assert_allclose(se3.log_so3(T[:, :3, :3])[:, 2], angle, atol=1e-9)
    back = poses_at(driven(), [2.0], 3.3)[0]
    assert_allclose(back @ T[2], np.eye(4), atol=1e-9)


def test_poses_are_not_known_outside_the_motion_nor_across_a_gap():
    motion = driven()
    assert np.isnan(poses_at(motion, [11.0], 9.0)).all()
    gap = motion[np.r_[0:50, 60:STEPS]]
    T = poses_at(gap, [4.0, 7.0], 4.5)
    assert np.isfinite(T[0]).all()
    assert np.isnan(T[1]).all()


def test_readings_are_spread_over_the_drive_and_go_together():
    motion = driven(standing=range(40))
    pair = pair_at(TRUE, dt=0.31, motion=motion)
    assert len(pair) == 25
    apart = pair.a.stamps[pair.selected[:, 0]] - (pair.b.stamps[pair.selected[:, 1]] + 0.31)
    assert np.abs(apart).max() < 0.06
    assert np.diff(pair.b.stamps[pair.selected[:, 1]]).max() < 0.9
    assert_allclose(pair.selected, pair_at(TRUE, dt=0.31, motion=motion).selected)


def test_readings_without_a_partner_are_not_compared():
    motion, stamps = driven(), 0.1 * np.arange(STEPS + 1)
    a, b = Stream("a", "any", stamps, list(stamps)), Stream("b", "any", stamps + 100.0, list(stamps))
    assert len(pairs.select(a, b, motion, 0.0, 25, 0)) == 0


@pytest.mark.parametrize("seed", range(3))
def test_the_search_finds_the_pose(seed):
    prior = off(TRUE, SIGMA * np.random.default_rng(seed).normal(size=6))
    found = search.estimate(Bowl(seed=seed), pair_at(prior), None, seed)
    assert found.converged
    assert np.all(np.abs(error_of(found)) < SIGMA / 20)


def test_the_same_seed_gives_the_same_answer():
    first, second = (search.estimate(Bowl(), pair_at(off(TRUE, SIGMA)), None, 4) for _ in range(2))
    assert np.array_equal(first.transform.T_a_b, second.transform.T_a_b)


def test_what_is_found_does_not_lean_on_the_motion():
    """The prior steers the search and is in neither estimate nor covariance."""
    priors = [off(TRUE, k * SIGMA) for k in (-0.7, 0.7)]
    a, b = (search.estimate(Bowl(), pair_at(p), None).transform for p in priors)
    assert_allclose(a.T_a_b[:3, 3], b.T_a_b[:3, 3], atol=1e-3)
    assert_allclose(np.diag(a.cov), np.diag(b.cov), rtol=0.3)


def test_what_a_metric_is_off_by_on_any_drive_is_in_its_sigma():
    class Leaning(Bowl):
        own = (0.0, 0.0, 0.3, 0.0, 0.1, 0.0)

    usual, leaning = (search.estimate(m, pair_at(TRUE), None).transform.cov for m in (Bowl(), Leaning()))
    assert_allclose(leaning - usual, np.diag(np.square(Leaning.own) - np.square(Bowl.own)), atol=1e-12)


@pytest.mark.long
def test_sigmas_hold():
    """Errors squared over what is stated, of poses whose moments differ as much as real ones."""
    own = np.diag(np.square(Bowl.own))
    noise = 5 * SIGMA
    values = []
    for seed in range(40):
        found = search.estimate(Bowl(noise=noise, seed=seed), pair_at(TRUE, sigma=4 * SIGMA), None, seed)
        cov = found.transform.cov - own
        values.append(error_of(found) @ np.linalg.solve(cov, error_of(found)))
    # Hotelling's: 25 moments know their own spread badly
    assert 4.0 < np.mean(values) < 9.0, np.mean(values)


def test_a_direction_without_curvature_is_said_to_be_unknown():
    shape = 1 / SIGMA
    shape[2] = 0.0
    found = search.estimate(Bowl(shape=shape), pair_at(TRUE), None)
    sigma = np.sqrt(np.diag(found.transform.cov))
    assert sigma[2] > 1.0
    assert np.all(sigma[[0, 1]] < 0.03)


@pytest.mark.parametrize("seen", [True, False])
def test_what_the_motion_leaves_open_appearance_must_tell(seen):
    """Or else the answer is wherever the search was."""
    shape, wide = 1 / SIGMA, np.where(np.arange(6) == 2, 10.0, SIGMA)
    shape[2] *= seen
    found = search.estimate(Bowl(shape=shape), pair_at(TRUE, sigma=wide), None)
    assert found.converged == seen
    assert ("leaves the pose open" in found.note) != seen


class Two(Bowl):
    """Fits as well a metre and a half aside."""

    def prepare(self, pair, options):
        draws = np.random.default_rng([self.seed, int(pair.selected[0, 1])]).normal(size=(2, 6))
        return draws * self.noise

    def costs(self, T_a_b, moment):
        aside = off(self.best, np.array([0, 0, 1.5, 0, 0, 0]))
        fits = [bowl(T_a_b, best, m, self.shape) for best, m in zip((self.best, aside), moment, strict=True)]
        return np.minimum(*fits)


@pytest.mark.parametrize("seed", range(3))
def test_where_the_motion_leaves_it_open_a_second_answer_is_looked_for(seed):
    wide = np.where(np.arange(6) == 2, 10.0, SIGMA)
    assert search.estimate(Two(), pair_at(TRUE), None, seed).converged
    found = search.estimate(Two(), pair_at(TRUE, sigma=wide), None, seed)
    assert not found.converged
    assert "leaves the pose open" in found.note


def test_a_pose_far_from_the_motion_is_refused():
    found = search.estimate(Bowl(), pair_at(off(TRUE, np.array([1.5, 0, 0, 0, 0.3, 0.3]))), None)
    assert not found.converged
    assert "the best pose lies further" in found.note


class Flat(Bowl):
    """Noise that does not care for the pose."""

    def costs(self, T_a_b, moment):
        return np.array([np.random.default_rng(np.abs(T[:3].view(np.int64)).ravel()).normal() for T in T_a_b])


def test_a_metric_that_sees_nothing_is_refused():
    found = search.estimate(Flat(), pair_at(TRUE), None)
    assert not found.converged


class Blind(Bowl):
    """Nothing to compare at most moments."""

    def prepare(self, pair, options):
        return super().prepare(pair, options) if pair.selected[0, 1] < 20 else None


def test_too_few_moments_are_refused():
    found = search.estimate(Blind(), pair_at(TRUE), None)
    assert not found.converged
    assert "of 25 moments have something to compare" in found.note


def test_a_later_clock_moves_the_estimate_against_the_motion():
    """Points seen a little later lie a little further back."""
    found = search.estimate(Bowl(), pair_at(TRUE), None)
    assert_allclose(found.by_clock[0], -5.0 + 0.1 * TRUE[1, 3], atol=0.02)
    assert_allclose(found.by_clock[5], -0.1, atol=1e-6)


def test_the_answer_of_a_parabola_is_exact():
    """One Gaussian moment each: the mean of their best poses, and its covariance."""
    rng = np.random.default_rng(1)
    centres = 0.3 * rng.normal(size=(200, 6))

    def cost(z):
        return np.sum((z[:, None] - centres) ** 2, axis=2)

    found = evidence(cost, np.zeros(6), 1e-4 * np.eye(6), 0)
    assert_allclose(found.z, centres.mean(axis=0), atol=1e-3)
    assert_allclose(found.cov, np.cov(centres.T) / len(centres), rtol=0.15, atol=2e-5)


def test_unknown_metrics_are_refused():
    with pytest.raises(ConfigError, match=r"there is no metric 'sift'; there are: .*none"):
        refinement.chosen(replace(Config(), appearance=("sift",)), Registry([]))
    assert refinement.chosen(replace(Config(), appearance=("none",)), Registry([])) == {}
    assert refinement.chosen(Config(), Registry([])) == {}


class Counted(Bowl):
    """Says how often it was asked for a moment."""

    asked = 0

    def prepare(self, pair, options):
        Counted.asked += 1
        return super().prepare(pair, options)


def test_what_was_found_for_a_pair_is_kept(tmp_path):
    """A killed run goes on where it stopped; another prior, seed or version is other work."""

    def look(pair, seed=0, version="1"):
        metric, Counted.asked = Counted(), 0
        metric.version = version
        found = refinement._estimate(pairs.Comparison(metric, pair), metric.options(), seed, tmp_path)
        return found, Counted.asked

    pair = pair_at(off(TRUE, SIGMA / 2))
    first, asked = look(pair)
    assert asked
    again, asked = look(pair)
    assert not asked
    assert again.transform.has_scale is True
    for a, b in ((first, again), (first.transform, again.transform)):
        for name, value in vars(a).items():
            if name != "transform":
                assert np.array_equal(value, vars(b)[name]), name
    (file,) = tmp_path.rglob("*.json")
    file.write_text(file.read_text()[:100])
    assert look(pair)[1]
    assert look(pair, seed=1)[1]
    assert look(pair, version="2")[1]
    assert look(replace(pair, dt_a_b=0.01))[1]


def test_a_pair_that_can_not_be_read_is_tried_again(tmp_path):
    class Broken(Counted):
        def prepare(self, pair, options):
            super().prepare(pair, options)
            raise DataError("a.png is cut off")

    comparison = pairs.Comparison(Broken(), pair_at(TRUE))
    for _ in range(2):
        Counted.asked = 0
        found = refinement._estimate(comparison, comparison.metric.options(), 0, tmp_path)
        assert not found.converged
        assert "cut off" in found.note
        assert Counted.asked
    assert not [*tmp_path.rglob("*.json")]
