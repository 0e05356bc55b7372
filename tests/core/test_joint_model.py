"""What a sensor reads of the base's motion: laws of rigid motion, and derivatives against differences."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import RigidTransform, Rotation

from calib_toolkit import se3
from calib_toolkit.joint.model import linear, read

STATES = 1000
STEP = 1e-5


def unit(rng, n):
    v = rng.normal(size=(n, 3))
    return v / np.linalg.norm(v, axis=1, keepdims=True)


def twists(seed=0):
    """A thousand, with turns near zero, ordinary ones, and near a half turn."""
    rng = np.random.default_rng(seed)
    tiny, most = 10 ** rng.uniform(-9, -3, STATES // 4), np.pi - rng.uniform(0, 1e-3, STATES // 4)
    middling = np.concatenate([rng.uniform(0.005, 0.015, STATES // 4), rng.uniform(0.01, 3.1, STATES // 4)])
    angle = np.concatenate([[0.0], tiny[1:], middling, most])
    return np.column_stack([rng.normal(size=(STATES, 3)), angle[:, None] * unit(rng, STATES)])


def poses(seed, count=8):
    rng = np.random.default_rng([seed, 1])
    return [se3.rigid(Rotation.random(rng=rng).as_matrix(), rng.normal(size=3)) for _ in range(count)]


def states(seed=0):
    """Poses anywhere, biases none and small, with their share of the twists."""
    rng, T = np.random.default_rng([seed, 2]), poses(seed)
    shuffled = rng.permutation(twists(seed))
    biases = [np.zeros(3), *(0.1 * rng.normal(size=(len(T) - 1, 3)))]
    return list(zip(T, biases, np.split(shuffled, len(T)), strict=True))


def moved(T, bias, change):
    """The sensor's pose and bias by (9,)."""
    return se3.rigid(se3.exp_so3(change[3:6]) @ T[:3, :3], T[:3, 3] + change[:3]), bias + change[6:]


def slopes(f, size):
    """(n, d, size) central differences of f (n, d) at zero."""
    return np.stack([(f(h) - f(-h)) / (2 * STEP) for h in STEP * np.eye(size)], axis=2)


def exact(twist):
    """Transforms of twists ``[v w]``."""
    return RigidTransform.from_exp_coords(twist[:, [3, 4, 5, 0, 1, 2]]).as_matrix()


def test_a_sensor_at_the_base_reads_the_twists_own_transform():
    vec, _, _ = read(np.eye(4), np.zeros(3), twists())
    assert_allclose(se3.matrix(vec), exact(twists()), atol=1e-9)


def test_elsewhere_it_reads_the_motion_seen_through_its_pose():
    for T, _, twist in states():
        vec, _, _ = read(T, np.zeros(3), twist)
        assert_allclose(se3.matrix(vec), se3.invert(T) @ exact(twist) @ T, atol=1e-9)


def test_a_bias_turns_travel_in_base_axes_and_no_turn():
    for T, bias, twist in states():
        plain, biased = (read(T, b, twist)[0] for b in (np.zeros(3), bias))
        R = T[:3, :3]
        assert_allclose(biased[:, :3] @ R.T, plain[:, :3] @ R.T @ se3.exp_so3(bias).T, atol=1e-12)
        assert_allclose(biased[:, 3:], plain[:, 3:])


def test_derivatives_of_a_reading():
    for T, bias, twist in states():
        _, by_twist, by_sensor = read(T, bias, twist)
        assert_allclose(by_twist, slopes(lambda h, s=(T, bias, twist): read(s[0], s[1], s[2] + h)[0], 6), atol=1e-6)
        expected = slopes(lambda h, s=(T, bias, twist): read(*moved(s[0], s[1], h), s[2])[0], 9)
        assert_allclose(by_sensor, expected, atol=1e-6)


def measured(T, bias, twist, off, seed=0):
    """What a sensor without scale measures, by so many radians (one sigma) from what is predicted."""
    vec = read(T, bias, twist)[0]
    vec[:, :3] /= np.linalg.norm(vec[:, :3], axis=1, keepdims=True)
    vec = vec + off * np.random.default_rng(seed).normal(size=vec.shape)
    vec[:, :3] /= np.linalg.norm(vec[:, :3], axis=1, keepdims=True)
    return vec


def check_linear(T, bias, twist, vec, has_scale, held=False):
    """held: at the length of travel that was predicted, which a residual's derivative leaves as it is."""
    cov = np.broadcast_to(np.eye(6), (len(vec), 6, 6))
    length = np.linalg.norm(read(T, bias, twist)[0][:, :3], axis=1)

    def predicted(pose, b, z):
        residual = linear(pose, b, z, vec, cov, has_scale).residual.copy()
        if held:
            residual[:, :2] *= (np.linalg.norm(read(pose, b, z)[0][:, :3], axis=1) / length)[:, None]
        return -residual

    found = linear(T, bias, twist, vec, cov, has_scale)
    size = np.maximum(1.0, 1 / length)[:, None, None]  # a short travel's direction turns fast
    assert_allclose(found.by_twist / size, slopes(lambda h: predicted(T, bias, twist + h), 6) / size, atol=1e-6)
    expected = slopes(lambda h: predicted(*moved(T, bias, h), twist), 9)
    assert_allclose(found.by_sensor / size, expected / size, atol=1e-6)
    _, by_twist, by_sensor = read(T, bias, twist)
    assert_allclose(found.shown @ by_twist, found.by_twist)
    assert_allclose(found.shown @ by_sensor, found.by_sensor)


def test_derivatives_of_residuals_with_scale():
    rng = np.random.default_rng(3)
    for T, bias, twist in states():
        vec = read(T, bias, twist)[0] + 0.1 * rng.normal(size=twist.shape)
        check_linear(T, bias, twist, vec, True)
        found = linear(T, bias, twist, vec, np.tile(np.eye(6), (len(vec), 1, 1)), True)
        assert_allclose(found.residual, vec - read(T, bias, twist)[0])
        assert found.usable.all()


@pytest.mark.parametrize("off", [0.0, 0.05])
def test_derivatives_of_residuals_without_scale(off):
    for T, bias, twist in states():
        check_linear(T, bias, twist, measured(T, bias, twist, off), False, held=off > 0)


def test_without_scale_only_the_direction_of_travel_counts():
    for T, bias, twist in states():
        vec, cov = measured(T, bias, twist, 0.0), np.tile(np.eye(6), (len(twist), 1, 1))
        found = linear(T, bias, twist, vec, cov, False)
        assert_allclose(found.residual, 0.0, atol=1e-9)
        assert found.usable.all()
        backwards = np.column_stack([-vec[:, :3], vec[:, 3:]])
        assert not linear(T, bias, twist, backwards, cov, False).usable.any()


def test_a_residual_without_scale_is_two_angles_and_a_turn():
    """Travel that passes by what was measured at a small angle: that angle, however far it went."""
    rng, T, bias, twist = np.random.default_rng(4), *states()[1]
    vec, angle = measured(T, bias, twist, 0.0), 1e-3
    side = np.cross(vec[:, :3], unit(rng, len(vec)))
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    aside = np.column_stack([np.cos(angle) * vec[:, :3] + np.sin(angle) * side, vec[:, 3:] + 0.01])
    found = linear(T, bias, twist, aside, np.tile(np.eye(6), (len(vec), 1, 1)), False).residual
    assert_allclose(np.linalg.norm(found[:, :2], axis=1), np.sin(angle), rtol=1e-6)
    assert_allclose(found[:, 2:], 0.01, atol=1e-9)


def test_a_residuals_covariance_is_that_of_its_noise():
    rng, T = np.random.default_rng(5), poses(0)[0]
    n, twist = 40_000, np.array([4.0, 1.0, -2.0, 0.1, 0.2, -0.3])
    root = 0.002 * rng.normal(size=(6, 6))
    cov = root @ root.T
    cov[:3, 3:] = cov[3:, :3] = 0.3 * root[:3, :3] @ root[:3, :3].T
    cov += 1e-6 * np.eye(6)
    clean = measured(T, np.zeros(3), twist[None], 0.0)[0]
    for has_scale in (True, False):
        true = clean if not has_scale else read(T, np.zeros(3), twist[None])[0][0]
        vec = true + rng.multivariate_normal(np.zeros(6), cov, n)
        if not has_scale:
            vec[:, :3] /= np.linalg.norm(vec[:, :3], axis=1, keepdims=True)
        stated = np.broadcast_to(cov, (n, 6, 6))
        found = linear(T, np.zeros(3), np.tile(twist, (n, 1)), vec, stated, has_scale)
        whiten = np.linalg.inv(np.linalg.cholesky(found.cov))
        pulls = (whiten @ found.residual[..., None])[..., 0]
        assert_allclose(np.cov(pulls.T), np.eye(6 if has_scale else 5), atol=0.03)
