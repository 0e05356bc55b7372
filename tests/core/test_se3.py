"""The laws of rigid motions, their derivatives against finite differences, and another library as the oracle."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from pytransform3d import rotations, transformations

from calib_toolkit import se3

laws = settings(derandomize=True, deadline=None, max_examples=100)
component = st.floats(-1.8, 1.8)  # so that no angle reaches pi
vectors = st.tuples(*[st.floats(-50, 50)] * 3, *[component] * 3).map(np.array)
poses = vectors.map(se3.matrix)


def some_poses(n=20, seed=0):
    rng = np.random.default_rng(seed)
    return se3.matrix(np.concatenate([rng.normal(0, 5, (n, 3)), rng.uniform(-1.8, 1.8, (n, 3))], axis=1))


def noise_of(T_true, T):
    """(dt, delta) in ``t_true = t + dt``, ``R_true = Exp(delta) R``: the noise that the covariances speak of."""
    R_true, R = T_true[..., :3, :3], T[..., :3, :3]
    dt = T_true[..., :3, 3] - T[..., :3, 3]
    return np.concatenate([dt, se3.log_so3(R_true @ np.swapaxes(R, -1, -2))], axis=-1)


def with_noise(T, noise):
    return se3.rigid(se3.exp_so3(noise[..., 3:]) @ T[..., :3, :3], T[..., :3, 3] + noise[..., :3])


def numeric_jacobian(f, x, h=1e-6):
    columns = [(f(x + h * e) - f(x - h * e)) / (2 * h) for e in np.eye(len(x))]
    return np.stack(columns, axis=-1)


@laws
@given(vectors)
def test_vector_and_matrix_are_inverse(vec):
    assert_allclose(se3.vector(se3.matrix(vec)), vec, atol=1e-9)


@laws
@given(poses)
def test_invert_is_the_inverse(T):
    assert_allclose(T @ se3.invert(T), np.eye(4), atol=1e-12)
    assert_allclose(se3.invert(se3.invert(T)), T, atol=1e-12)


@laws
@given(poses, poses)
def test_the_inverse_of_a_chain_is_the_chain_of_inverses_backwards(T_a_b, T_b_c):
    assert_allclose(se3.invert(T_a_b @ T_b_c), se3.invert(T_b_c) @ se3.invert(T_a_b), atol=1e-10)


@laws
@given(poses, poses, poses)
def test_relative_poses_do_not_depend_on_the_world(T_w_a, T_w_b, T_v_w):
    assert_allclose(se3.relative(T_v_w @ T_w_a, T_v_w @ T_w_b), se3.relative(T_w_a, T_w_b), atol=1e-9)


@laws
@given(poses, poses)
def test_relative_completes_the_chain(T_w_a, T_w_b):
    assert_allclose(T_w_a @ se3.relative(T_w_a, T_w_b), T_w_b, atol=1e-9)


@laws
@given(vectors)
def test_motion_between_sensors_keeps_the_angle(vec):
    T_a_b = some_poses(1)[0]
    moved = se3.invert(T_a_b) @ se3.matrix(vec) @ T_a_b
    assert_allclose(np.linalg.norm(se3.vector(moved)[3:]), np.linalg.norm(vec[3:]), atol=1e-7)


def test_transform_maps_points_of_b_to_a():
    """The worked point of docs/conventions: a lidar half a metre ahead of the base, turned left by 90 degrees."""
    T_base_lidar = se3.matrix([0.5, 0, 1.5, 0, 0, np.pi / 2])
    assert_allclose(T_base_lidar @ [10, 0, 0, 1], [0.5, 10, 1.5, 1], atol=1e-12)


@pytest.mark.parametrize("axis", [[1, 0, 0], [0, 1, 0], [0, 0, 1], [0.6, -0.8, 0], [1, 1, 1]])
@pytest.mark.parametrize("short_of_pi", [0.0, 1e-9, 1e-6, 1e-3])
def test_rotation_vectors_survive_near_pi(axis, short_of_pi):
    r = np.array(axis) / np.linalg.norm(axis) * (np.pi - short_of_pi)
    back = se3.log_so3(se3.exp_so3(r))
    assert_allclose(np.linalg.norm(back), np.pi - short_of_pi, atol=1e-7)
    assert_allclose(se3.exp_so3(back), se3.exp_so3(r), atol=1e-9)


def test_no_rotation_is_the_identity():
    assert_allclose(se3.matrix(np.zeros(6)), np.eye(4), atol=0)
    assert_allclose(se3.vector(np.eye(4)), np.zeros(6), atol=0)


@pytest.mark.parametrize("shape", [(), (4,), (2, 3), (0,)])
def test_every_function_is_batched(shape):
    vec = np.random.default_rng(1).uniform(-1, 1, (*shape, 6))
    T = se3.matrix(vec)
    assert T.shape == (*shape, 4, 4)
    assert se3.vector(T).shape == (*shape, 6)
    assert se3.invert(T).shape == (*shape, 4, 4)
    assert se3.skew(vec[..., :3]).shape == (*shape, 3, 3)
    assert se3.left_jacobian(vec[..., 3:]).shape == (*shape, 3, 3)
    assert se3.vec_jacobian(vec).shape == (*shape, 6, 6)
    assert [J.shape for J in se3.relative_jacobians(T, T)] == [(*shape, 6, 6)] * 2


def test_a_batch_is_its_elements_one_by_one():
    a, b = some_poses(seed=2), some_poses(seed=3)
    assert_allclose(se3.relative(a, b), [se3.relative(x, y) for x, y in zip(a, b, strict=True)])
    one_by_one = [se3.relative_jacobians(x, y) for x, y in zip(a, b, strict=True)]
    for batch, single in zip(se3.relative_jacobians(a, b), zip(*one_by_one, strict=True), strict=True):
        assert_allclose(batch, single)


def test_skew_is_the_cross_product():
    u, v = np.random.default_rng(4).normal(size=(2, 10, 3))
    assert_allclose((se3.skew(u) @ v[..., None])[..., 0], np.cross(u, v), atol=1e-14)


@pytest.mark.parametrize("angle", [0.0, 1e-8, 0.99e-4, 1.01e-4, 0.1, 1.0, 3.0])
def test_left_jacobian_against_finite_differences(angle):
    r = angle * np.array([0.6, -0.48, 0.64])
    back = se3.exp_so3(-r)
    J = numeric_jacobian(lambda x: se3.log_so3(se3.exp_so3(x) @ back), r)
    assert_allclose(se3.left_jacobian(r), J, atol=1e-8)


def test_vec_jacobian_against_finite_differences():
    for T in some_poses():
        vec = se3.vector(T)
        J = numeric_jacobian(lambda x, T=T: noise_of(se3.matrix(x), T), vec)
        assert_allclose(se3.vec_jacobian(vec), J, atol=1e-7)


def test_relative_jacobians_against_finite_differences():
    for T_w_a, T_w_b in zip(some_poses(seed=5), some_poses(seed=6), strict=True):
        T_a_b = se3.relative(T_w_a, T_w_b)
        by_a = numeric_jacobian(
            lambda x, a=T_w_a, b=T_w_b, T=T_a_b: noise_of(se3.relative(with_noise(a, x), b), T), np.zeros(6)
        )
        by_b = numeric_jacobian(
            lambda x, a=T_w_a, b=T_w_b, T=T_a_b: noise_of(se3.relative(a, with_noise(b, x)), T), np.zeros(6)
        )
        J_a, J_b = se3.relative_jacobians(T_w_a, T_w_b)
        assert_allclose(J_a, by_a, atol=1e-7)
        assert_allclose(J_b, by_b, atol=1e-7)


def test_rotate_cov_is_the_covariance_of_rotated_samples():
    rng = np.random.default_rng(7)
    samples = rng.normal(size=(50, 3)) * [1, 2, 3]
    R = some_poses(1)[0, :3, :3]
    assert_allclose(se3.rotate_cov(R, np.cov(samples.T)), np.cov((samples @ R.T).T), atol=1e-12)


def test_against_pytransform3d():
    for T_a_b, T_b_c in zip(some_poses(seed=8), some_poses(seed=9), strict=True):
        vec = se3.vector(T_a_b)
        R = rotations.matrix_from_compact_axis_angle(vec[3:])
        assert_allclose(T_a_b, transformations.transform_from(R, vec[:3]), atol=1e-12)
        assert_allclose(vec[3:], rotations.compact_axis_angle_from_matrix(T_a_b[:3, :3]), atol=1e-9)
        assert_allclose(se3.invert(T_a_b), transformations.invert_transform(T_a_b), atol=1e-12)
        # concat(first, second) goes from c to b to a: the order in which points travel
        assert_allclose(T_a_b @ T_b_c, transformations.concat(T_b_c, T_a_b), atol=1e-10)
        assert_allclose(se3.left_jacobian(vec[3:]), rotations.left_jacobian_SO3(vec[3:]), atol=1e-9)
