"""The search that appearance metrics share: what it finds, how sure it is, when it refuses."""

import numpy as np
import pytest
from builders import bowl
from numpy.testing import assert_allclose
from searched_pairs import SIGMA, TRUE, Bowl, error_of, off, pair_at

from calib_toolkit import se3
from calib_toolkit.appearance import search
from calib_toolkit.appearance.evidence import evidence


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


class Valley(Bowl):
    """Long, narrow and bent where a shift along x goes with a turn about it, as along a straight road."""

    def costs(self, T_a_b, moment):
        turn = se3.log_so3(T_a_b[:, :3, :3] @ self.best[:3, :3].T)
        e = (np.column_stack([T_a_b[:, :3, 3] - self.best[:3, 3], turn]) - moment) / SIGMA
        along, across = (e[:, 0] + e[:, 3]) / np.sqrt(2), (e[:, 0] - e[:, 3]) / np.sqrt(2)
        bottom = 0.2 * along**2
        return 0.3 * np.sqrt(0.01 + along**2) + 15 * (across - bottom) ** 2 + np.sum(e[:, [1, 2, 4, 5]] ** 2, axis=1)


@pytest.mark.parametrize("seed", range(3))
def test_what_is_told_is_looked_at_anew_until_it_leads_no_further(seed):
    """From three sigmas up a valley; one look comes back by a tenth of the way."""
    valley, pair = Valley(noise=SIGMA / 50, seed=seed), pair_at(TRUE)
    frame, moments = search.whitened(pair.prior), search.prepared(valley, pair, None)
    up = SIGMA * np.array([3, 0, 0, 3, 0, 0]) / np.sqrt(2)
    found = search._told(valley, moments, frame, np.linalg.solve(frame.L, up), seed)
    assert np.linalg.norm(frame.L @ found.posterior / SIGMA) < 0.15


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
