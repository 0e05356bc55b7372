"""Motions made ready: joined ones against composed transforms, their covariance against many draws."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from calib_toolkit import se3
from calib_toolkit.joint.readings import WIDENED, joined, ready
from calib_toolkit.types import Motions

COV = np.diag([1e-4, 4e-4, 9e-4, 1e-4, 2e-4, 3e-4]) + 2e-5


def motions(n, period=0.01, start=0.0, seed=0, has_scale=True):
    """Large ones, one after the other."""
    vec = np.random.default_rng(seed).normal(size=(n, 6)) * [1.0, 1.0, 1.0, 0.5, 0.5, 0.5]
    stamps = start + period * np.arange(n + 1)
    return Motions(stamps[:-1], stamps[1:], vec, np.tile(COV, (n, 1, 1)), has_scale)


def composed(vec):
    T = np.eye(4)
    for step in se3.matrix(vec):
        T = T @ step
    return T


@pytest.mark.parametrize("together", [1, 2, 5])
def test_joined_motions_are_composed_transforms_and_the_last_may_be_fewer(together):
    m = motions(23)
    found = joined(m, together)
    assert len(found) == -(-23 // together)
    for k, vec in enumerate(found.vec):
        part = slice(together * k, together * (k + 1))
        assert_allclose(se3.matrix(vec), composed(m.vec[part]), atol=1e-12)
        assert found.start[k] == m.start[part][0]
        assert found.end[k] == m.end[part][-1]


def test_nothing_is_joined_across_a_gap():
    m = Motions.concatenate([motions(7), motions(1, start=0.2, seed=1), motions(6, start=0.5, seed=2)])
    found = joined(m, 3)
    at = [(0, 3), (3, 6), (6, 7), (7, 8), (8, 11), (11, 14)]
    assert_allclose(found.start, [m.start[i] for i, _ in at])
    assert_allclose(found.end, [m.end[j - 1] for _, j in at])
    for vec, (i, j) in zip(found.vec, at, strict=True):
        assert_allclose(se3.matrix(vec), composed(m.vec[i:j]), atol=1e-12)


def test_motions_that_overlap_are_left_alone():
    m = motions(6)
    m = Motions(m.start, m.end + 0.005, m.vec, m.cov)
    assert_allclose(joined(m, 3).vec, m.vec)


def test_covariance_is_that_of_many_draws():
    m, n, rng = motions(4, seed=3), 20_000, np.random.default_rng(4)
    small = m.cov * 0.04
    found = joined(Motions(m.start, m.end, m.vec, small), 4)
    noisy = m.vec + rng.multivariate_normal(np.zeros(6), small[0], (n, 4))
    T = se3.matrix(noisy)
    draws = se3.vector(T[:, 0] @ T[:, 1] @ T[:, 2] @ T[:, 3])
    assert np.linalg.norm(found.vec[0, 3:]) < np.pi - 0.3  # away from where a draw's axis would flip
    whiten = np.linalg.inv(np.linalg.cholesky(found.cov[0]))
    assert_allclose(whiten @ np.cov((draws - found.vec[0]).T) @ whiten.T, np.eye(6), atol=0.05)


def test_parts_of_one_screw_join_to_the_whole_with_the_noise_of_all():
    """Straight on, five parts' variances add up; what a turn's error does to the travel after it adds to that."""
    vec = np.tile([1.0, 0, 0, 0, 0, 0], (5, 1))
    stamps, cov = 0.01 * np.arange(6), np.tile(np.diag([1.0, 1, 1, 1e-2, 1e-2, 1e-2]) * 1e-6, (5, 1, 1))
    found = joined(Motions(stamps[:-1], stamps[1:], vec, cov), 5)
    assert_allclose(found.vec[0], [5.0, 0, 0, 0, 0, 0], atol=1e-12)
    swung = 1e-2 * (16 + 9 + 4 + 1)
    assert_allclose(np.diag(found.cov[0]), 1e-6 * np.array([5, 5 + swung, 5 + swung, 0.05, 0.05, 0.05]), rtol=1e-9)


@pytest.mark.parametrize(("rate", "together"), [(10, 1), (20, 1), (50, 2), (100, 5), (200, 10)])
def test_what_is_read_often_is_joined_to_a_twentieth_second(rate, together):
    m = motions(40, 1 / rate)
    assert len(ready(m)) == 40 / together
    assert len(ready(motions(40, 1 / rate, has_scale=False))) == 40


def test_ready_motions_are_in_order_of_time():
    m = motions(40)
    shuffled = m[np.random.default_rng(0).permutation(40)]
    assert_allclose(ready(shuffled).vec, ready(m).vec)
    assert np.all(np.diff(ready(shuffled).start) > 0)


def test_ready_motions_of_like_noise_are_all_widened_alike_and_a_boast_does_not_count_much():
    m = motions(40, period=0.1)
    cov = np.tile(np.diag([4.0, 4, 4, 1, 1, 1]) * 1e-4, (40, 1, 1))
    cov[3] /= 1e4
    found = ready(Motions(m.start, m.end, m.vec, cov)).cov
    assert_allclose(found[0], WIDENED * cov[0])
    assert_allclose(found[3], cov[0], rtol=1e-3)
