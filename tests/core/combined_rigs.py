"""A rig of four sensors, what motion says of it, and estimates of its pairs; errors are known or drawn."""

import numpy as np
from builders import CAMERA, INS, LIDAR, in_base, pose
from scipy.spatial.transform import Rotation

from calib_toolkit import se3
from calib_toolkit.types import Calibration, PairEstimate, Transform

NAMES = ("velo", "ins", "cam0", "cam1")
TRUE = in_base((LIDAR, INS, CAMERA, pose(0.2, 0.8, 1.1, -90, 0, -60)))
BY_MOTION = np.array([0.1, 0.1, 0.3, 0.004, 0.004, 0.002, 0.001])
BY_LOOK = np.array([0.03, 0.01, 0.01, 0.002, 0.001, 0.001])


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


def drawn(rng):
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
