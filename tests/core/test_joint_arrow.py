"""The arrow-shaped equations against the same equations written out in full."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from calib_toolkit.joint.arrow import Arrow
from calib_toolkit.joint.windows import Windows

SHAPES = [
    # size, width, reach, parameters, readings
    (1, 1, 1, 0, 3),
    (2, 3, 2, 1, 9),
    (5, 1, 3, 2, 11),
    (7, 2, 4, 0, 20),
    (11, 6, 4, 5, 40),
    (23, 3, 6, 7, 90),
    (24, 2, 5, 3, 600),
]
STENCIL = np.array([1.0, -2.0, 1.0])


class Problem:
    """Random readings, and the whole least squares (latents first, then parameters) that they are."""

    def __init__(self, size, width, reach, parameters, readings, seed=0):
        rng = np.random.default_rng(seed)
        self.size, self.width, self.reach, self.parameters = size, width, reach, parameters
        self.arrow = Arrow(size, width, reach, parameters)
        unknown = size * width
        self.H, self.g = np.zeros((unknown + parameters,) * 2), np.zeros(unknown + parameters)
        for m in {min(reach, size), 1}:  # two sensors, of long and of short windows
            first = np.sort(rng.integers(0, size - m + 1, readings))
            windows = Windows(first, rng.normal(size=(readings, m)), np.zeros((readings, m)))
            d = int(rng.integers(1, 4))
            by_latent, residual = rng.normal(size=(readings, d, width)), rng.normal(size=(readings, d))
            root = rng.normal(size=(readings, d, d))
            weight = root @ np.swapaxes(root, 1, 2)
            columns = rng.permutation(parameters)[: (parameters + 1) // 2]
            by_parameter = rng.normal(size=(readings, d, len(columns)))
            self.arrow.add(windows, by_latent, weight, residual)
            self.arrow.add_parameters(columns, by_parameter, windows, by_latent, weight, residual)
            J = np.zeros((readings, d, unknown + parameters))
            for k in range(m):
                for n in range(readings):
                    at = width * (first[n] + k)
                    J[n, :, at : at + width] += windows.weights[n, k] * by_latent[n]
            J[:, :, unknown + columns] = by_parameter
            self.H += np.einsum("nda,nde,neb->ab", J, weight, J)
            self.g += np.einsum("nda,nde,ne->a", J, weight, residual)
        for k in range(size):
            self.hold(k, 0.5)
        own = rng.normal(size=(parameters, parameters))
        self.arrow.information += own @ own.T
        self.H[unknown:, unknown:] += own @ own.T
        self.windows, self.rng = windows, rng

    def hold(self, knot, precision):
        self.arrow.hold(knot, precision)
        at = slice(knot * self.width, (knot + 1) * self.width)
        self.H[at, at] += precision * np.eye(self.width)

    @property
    def parts(self):
        """Blocks of the latents, of both, and of the parameters."""
        k = self.size * self.width
        return self.H[:k, :k], self.H[:k, k:], self.H[k:, k:]


@pytest.fixture(params=SHAPES, ids=str)
def problem(request):
    return Problem(*request.param)


def test_information_gradient_and_response_are_those_of_a_dense_solve(problem):
    solved, (A, B, C) = problem.arrow.solved(), problem.parts
    k = len(A)
    assert_allclose(solved.information, C - B.T @ np.linalg.solve(A, B), atol=1e-8 * np.abs(C).max(initial=1.0))
    scale = np.abs(problem.g).max()
    assert_allclose(solved.gradient, problem.g[k:] - B.T @ np.linalg.solve(A, problem.g[:k]), atol=1e-8 * scale)
    response = np.linalg.solve(A, B).reshape(problem.size, problem.width, problem.parameters)
    assert_allclose(solved.response, response, atol=1e-9 * np.abs(response).max(initial=1.0))


def test_parameters_and_latents_together_solve_the_whole(problem):
    solved = problem.arrow.solved()
    parameters = np.linalg.solve(solved.information, solved.gradient)
    found = np.concatenate([solved.latents(parameters).ravel(), parameters])
    assert_allclose(problem.H @ found, problem.g, atol=1e-8 * np.abs(problem.g).max())


def test_covariance_of_windows_is_that_of_the_dense_inverse(problem):
    rng, d = problem.rng, problem.width
    cov = np.linalg.inv(problem.parts[0]).reshape(problem.size, d, problem.size, d)
    solved = problem.arrow.solved()
    for m in {min(problem.reach, problem.size), 1}:
        first = np.sort(rng.integers(0, problem.size - m + 1, 30))
        right, left = rng.normal(size=(2, 30, m))
        windows, at = Windows(first, right, left), first[:, None] + np.arange(m)
        blocks = cov[at[:, :, None], :, at[:, None, :], :]
        for other in (None, left):
            by = right if other is None else other
            expected = np.einsum("nj,njkab,nk->nab", by, blocks, right)
            assert_allclose(solved.covariance(windows, other), expected, atol=1e-9 * np.abs(cov).max())


def test_another_arrow_is_reduced_by_this_ones_band(problem):
    solved, p = problem.arrow.solved(), problem.parameters
    rng, w = problem.rng, problem.windows
    other = Arrow(problem.size, problem.width, problem.reach, p)
    n, m = w.weights.shape
    by_latent, by_parameter = rng.normal(size=(n, 2, problem.width)), rng.normal(size=(n, 2, p))
    eye, residual = np.broadcast_to(np.eye(2), (n, 2, 2)), np.zeros((n, 2))
    other.add_parameters(np.arange(p), by_parameter, w, by_latent, eye, residual)
    cross = np.zeros((problem.size, problem.width, p))
    for k in range(m):
        np.add.at(cross, w.first + k, w.weights[:, k, None, None] * (np.swapaxes(by_latent, 1, 2) @ by_parameter))
    B = cross.reshape(problem.size * problem.width, p)
    expected = np.einsum("ndp,ndq->pq", by_parameter, by_parameter) - B.T @ np.linalg.solve(problem.parts[0], B)
    assert_allclose(solved.schur(other), expected, atol=1e-8 * np.abs(expected).max(initial=1.0))


@pytest.mark.parametrize("stencil", [STENCIL, np.array([-1.0, 3.0, -3.0, 1.0])])
def test_a_prior_of_full_precision_pulls_differences_to_zero(stencil):
    problem = Problem(11, 3, 4, 2, 40)
    root, latents = problem.rng.normal(size=(3, 3)), problem.rng.normal(size=(11, 3))
    precision = root @ root.T
    problem.arrow.add_prior(stencil, latents, precision)
    n = 11 - len(stencil) + 1
    D = np.zeros((n, 11))
    for k in range(n):
        D[k, k : k + len(stencil)] = stencil
    D = np.kron(D, np.eye(3))
    problem.H[:33, :33] += D.T @ np.kron(np.eye(n), precision) @ D
    problem.g[:33] -= D.T @ np.kron(np.eye(n), precision) @ D @ latents.ravel()
    test_information_gradient_and_response_are_those_of_a_dense_solve(problem)
    test_parameters_and_latents_together_solve_the_whole(problem)


def test_what_is_held_stays():
    problem = Problem(9, 2, 3, 0, 30)
    free = problem.arrow.solved().latents(np.zeros(0))
    problem.hold(4, 1e9)
    held = problem.arrow.solved().latents(np.zeros(0))
    assert np.abs(free[4]).max() > 0.01
    assert np.abs(held[4]).max() < 1e-5
    test_parameters_and_latents_together_solve_the_whole(problem)


@pytest.mark.parametrize(("size", "reach"), [(4, 2), (5, 4)])
def test_draws_have_the_latents_covariance(size, reach):
    problem = Problem(size, 2, reach, 1, 30)
    solved, rng = problem.arrow.solved(), np.random.default_rng(1)
    draws = np.array([solved.sample(rng).ravel() for _ in range(6000)])
    whiten = np.linalg.cholesky(problem.parts[0]).T
    assert_allclose(np.cov(whiten @ draws.T), np.eye(2 * size), atol=0.08)
    assert np.abs((whiten @ draws.T).mean(axis=1)).max() < 5 / np.sqrt(6000)


def test_no_readings_leave_what_was_there():
    problem = Problem(6, 2, 3, 2, 20)
    before = problem.arrow.solved()
    none = Windows(np.zeros(0, dtype=np.int64), np.zeros((0, 2)), np.zeros((0, 2)))
    empty = np.zeros((0, 3, 3))
    problem.arrow.add(none, np.zeros((0, 3, 2)), empty, np.zeros((0, 3)))
    problem.arrow.add_parameters(
        np.array([1]), np.zeros((0, 3, 1)), none, np.zeros((0, 3, 2)), empty, np.zeros((0, 3))
    )
    after = problem.arrow.solved()
    assert_allclose(after.information, before.information)
    assert_allclose(after.gradient, before.gradient)
