"""The least-squares problem of the combination: its derivatives where the change of the motion result is large."""

import numpy as np
from combined_rigs import BY_LOOK, NAMES, definite, moved, random_rig, seen
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy.linalg import cholesky, solve_triangular

from calib_toolkit import se3
from calib_toolkit.combine import shared
from calib_toolkit.combine.factors import factor
from calib_toolkit.combine.solution import Prior, Solution, solve

WIDE = np.array([0.5, 0.5, 0.5, 0.6, 0.6, 0.6, 0.01])
SEEDS = st.integers(0, 2**32 - 1)


def coarse(rng):
    """A rig, and a prior of sigmas of half a radian and so."""
    T, cov = random_rig(rng), np.zeros((28, 28))
    cov[7:, 7:] = definite(rng, np.tile(WIDE, 3))
    return T, Prior.of(moved(T, cov=cov), np.ones(4))


def poses_less(T, other):
    """(28,) ``(dt, delta)`` of poses against others, and zero for the clocks."""
    turn = se3.log_so3(T[:, :3, :3] @ np.swapaxes(other[:, :3, :3], -1, -2))
    return np.column_stack([T[:, :3, 3] - other[:, :3, 3], turn, np.zeros(4)]).ravel()


@settings(max_examples=20, deadline=None)
@given(SEEDS)
def test_the_covariance_is_of_the_poses_that_the_change_leads_to(seed):
    """Of ``delta`` in ``R_true = Exp(delta) R_found``, not of the change, which is a rotation vector of the start."""
    rng, h = np.random.default_rng(seed), 1e-6
    _, prior = coarse(rng)
    change = prior.root @ rng.normal(size=28)
    ends = [[prior.moved(change + s * column) for s in (h, -h)] for column in prior.root.T]
    by_z = np.column_stack([poses_less(*both) for both in ends]) / (2 * h)
    by_z[6::7] = prior.root[6::7]
    found = Solution(prior, change, (), np.zeros((0, 28)))
    assert_allclose(found.stated, by_z @ by_z.T, atol=1e-7)


@settings(max_examples=10, deadline=None)
@given(SEEDS)
def test_the_solution_is_where_the_sum_of_squares_is_least(seed):
    """Also where estimates pull poses by several tenths of a radian."""
    rng, h = np.random.default_rng(seed), 1e-5
    T, prior = coarse(rng)
    off = 0.2 * rng.normal(size=(3, 6))
    coarse_look = np.diag((30 * BY_LOOK) ** 2)
    looks = zip([(0, 1), (2, 0), (1, 2)], off, strict=True)
    estimates = [seen(a, b, error=error, cov=coarse_look, T=T) for (a, b), error in looks]
    factors = [factor(e, NAMES) for e in estimates]
    found = solve(prior, factors)
    L = cholesky(shared.covariance(factors, prior.T), lower=True)
    z = np.linalg.lstsq(prior.root, found.change, rcond=None)[0]

    def squares(z):
        change = prior.root @ z
        residuals = np.concatenate([f.residual(prior.moved(change), change[6::7]) for f in factors])
        return z @ z + np.sum(solve_triangular(L, residuals, lower=True) ** 2)

    slope = [(squares(z + h * axis) - squares(z - h * axis)) / (2 * h) for axis in np.eye(28)]
    assert_allclose(slope, 0, atol=1e-3)
