"""What a drive can tell at most: the information in it about poses and clocks, from the true motion.

The rig's true motion in each step is unknown to any estimator, six numbers that are eliminated (Schur complement).
"""

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from calib_toolkit import Motions, se3
from calib_toolkit_datasets.simulated import SimulatedSensor
from calib_toolkit_datasets.simulation.vehicle import MARGIN, TruePath

Array = NDArray[np.float64]

RATE = 10.0
"""Hz: all sensors are read at the same instants."""
VAGUE = np.array([1.0, 1.0, 1.0, *np.radians([5.0, 5.0, 5.0]), 0.1])
"""Sigmas from which a number tells nothing: metres, radians, seconds."""
NOTHING = 1e3
"""A direction of a larger sigma, in multiples of ``VAGUE``, was not excited at all."""
STEP = 1e-5


def instants(true: TruePath) -> Array:
    """(m,) stamps at which all sensors are read."""
    return np.arange(true.stamps[0] + MARGIN, true.stamps[-1] - MARGIN, 1 / RATE)


def read_together(true: TruePath, sensors: Sequence[SimulatedSensor], seed: int) -> dict[str, Motions]:
    """What sensors measure that are all read at the same instants by the same clock, whatever their rate and dt."""
    rng, stamps, found = np.random.default_rng(seed), instants(true), {}
    for s in sensors:
        vec = _unscaled(s, _motion(true, s, stamps)) + rng.normal(size=(len(stamps) - 1, 6)) * s.sigma
        cov = np.broadcast_to(np.diag(np.square(s.sigma)), (len(vec), 6, 6))
        found[s.name] = Motions(stamps[:-1], stamps[1:], _unscaled(s, vec), cov, s.has_scale)
    return found


def information(true: TruePath, sensors: Sequence[SimulatedSensor]) -> Array:
    """(7n, 7n) Fisher information on the n sensors after the base, which has scale; order and units of ``AXES``.

    All sensors are read at the same instants; the latent motion is as good as unknown in each step on its own.
    """
    base, others = sensors[0], sensors[1:]
    stamps = instants(true)
    z = _motion(true, base, stamps)
    latent = np.diag(1 / np.square(base.sigma)) + np.zeros((len(z), 6, 6))
    own = np.zeros((7 * len(others), 7 * len(others)))
    cross = np.zeros((len(z), 7 * len(others), 6))
    for i, s in enumerate(others):
        J_x, J_z = _sensitivity(true, base, s, stamps, z)
        rows, weight = slice(7 * i, 7 * i + 7), 1 / np.square(s.sigma)
        own[rows, rows] = np.einsum("mkx,k,mky->xy", J_x, weight, J_x)
        cross[:, rows] = np.einsum("mkx,k,mkz->mxz", J_x, weight, J_z)
        latent += np.einsum("mky,k,mkz->myz", J_z, weight, J_z)
    told = np.einsum("mxz,mzy->xy", cross, np.linalg.solve(latent, np.swapaxes(cross, 1, 2)))
    return own - told


def sigma(info: Array) -> Array:
    """(n, 7) the Cramer-Rao bound of each parameter: metres, radians, seconds."""
    scale = np.tile(VAGUE, len(info) // 7)
    return (np.sqrt(np.diag(np.linalg.inv(info * np.outer(scale, scale)))) * scale).reshape(-1, 7)


def null_space(info: Array) -> tuple[Array, int]:
    """What a drive left open about one sensor, from its information (7, 7).

    Returns orthonormal directions (k, 7) in metres, radians and seconds along which nothing can be told, and the
    number of directions, these included, along which the bound is above half of ``VAGUE``.
    """
    values, vectors = np.linalg.eigh(info * np.outer(VAGUE, VAGUE))
    null = (vectors.T * VAGUE)[values < NOTHING**-2]
    return np.linalg.qr(null.T)[0].T, int((values < 4.0).sum())


def _motion(true: TruePath, sensor: SimulatedSensor, stamps: Array) -> Array:
    """(m, 6) the sensor's true motion from each stamp to the next."""
    poses = true.at(stamps) @ sensor.T_vehicle_sensor
    return se3.vector(se3.relative(poses[:-1], poses[1:]))


def _unscaled(sensor: SimulatedSensor, vec: Array) -> Array:
    """The motion as the sensor knows it: without scale the direction only."""
    if sensor.has_scale:
        return vec
    length = np.linalg.norm(vec[:, :3], axis=1, keepdims=True)
    return np.column_stack([vec[:, :3] / length.clip(1e-9), vec[:, 3:]])


def _sensitivity(
    true: TruePath, base: SimulatedSensor, sensor: SimulatedSensor, stamps: Array, z: Array
) -> tuple[Array, Array]:
    """How the sensor's motion (m, 6) changes with its own parameters (m, 6, 7), and with the base's (m, 6, 6)."""
    T = se3.relative(base.T_vehicle_sensor, sensor.T_vehicle_sensor)

    def predicted(motion: Array, x: Array) -> Array:
        X = se3.rigid(se3.exp_so3(x[3:]) @ T[:3, :3], T[:3, 3] + x[:3])
        return se3.vector(se3.invert(X) @ se3.matrix(motion) @ X)

    by_pose = _slopes(lambda d: predicted(z, d))
    by_base = _slopes(lambda d: predicted(z + d, np.zeros(6)))
    short = 0.2 / RATE
    by_clock = (_motion(true, sensor, stamps + short) - _motion(true, sensor, stamps - short)) / (2 * short)
    by_own = np.concatenate([by_pose, by_clock[..., None]], axis=2)
    if sensor.has_scale:
        return by_own, by_base
    # of a change of its translation, a camera sees what is across the direction of travel, as an angle
    p = _motion(true, sensor, stamps)[:, :3]
    length = np.linalg.norm(p, axis=1)[:, None, None].clip(1e-9)
    u = p[:, :, None] / length
    across = (np.eye(3) - u @ np.swapaxes(u, 1, 2)) / length
    seen = np.zeros((len(z), 6, 6))
    seen[:, :3, :3], seen[:, 3:, 3:] = across, np.eye(3)
    return seen @ by_own, seen @ by_base


def _slopes(f: Callable[[Array], Array]) -> Array:
    """Central differences of ``f`` (m, 6) by six numbers at zero: (m, 6, 6)."""
    return np.stack([(f(d) - f(-d)) / (2 * STEP) for d in np.eye(6) * STEP], axis=2)
