"""Small rigs and drives for the estimator's tests; truth is exact, noise is seeded."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from calib_toolkit import se3
from calib_toolkit.rotation import Rotations
from calib_toolkit.sync import Steps
from calib_toolkit.types import Motions
from calib_toolkit_datasets.simulated import SimulatedSensor, TruePath, measure

Array = NDArray[np.float64]

QUIET = (1e-8,) * 6
"""As good as no noise, but for the logarithm of its variance."""


def pose(x: float, y: float, z: float, roll: float = 0.0, pitch: float = 0.0, yaw: float = 0.0) -> Array:
    """(4, 4); metres and degrees, ``Rz(yaw) Ry(pitch) Rx(roll)``."""
    R = Rotation.from_euler("ZYX", [yaw, pitch, roll], degrees=True).as_matrix()
    return np.asarray(se3.rigid(R, np.array([x, y, z])))


LIDAR, INS, CAMERA = pose(0, 0, 1.7), pose(-0.8, 0.3, 0.9, 1, 2, 3), pose(0.3, 0.1, 1.6, -90, 0, -90)
MOUNTS = (LIDAR, INS, CAMERA, pose(1.2, -0.6, 0.5, 5, -4, 120), pose(0.2, 0.8, 1.1, -90, 0, 90), pose(-1, 0, 2))


def motions_of(true: TruePath, sensor: SimulatedSensor, seed: int) -> Motions:
    """What the sensor measures of the drive, on its own stamps."""
    stream = measure(true, sensor, seed)
    readings = list(stream.readings)[1:]
    vec, cov = np.array([r.vec for r in readings]), np.array([r.cov for r in readings])
    return Motions(stream.stamps[:-1], stream.stamps[1:], vec, cov, stream.has_scale)


def drive(true: TruePath, sensors: Sequence[SimulatedSensor], seed: int) -> dict[str, Motions]:
    """Every sensor's motions, by name."""
    return {s.name: motions_of(true, s, seed) for s in sensors}


def known_times(
    true: TruePath, mounts: Sequence[Array], sigma: Array, seed: int, cameras: Sequence[int] = ()
) -> Steps:
    """All sensors read at the same ten instants a second. mounts: (n, 4, 4) in the vehicle; sigma: (6,)."""
    rng = np.random.default_rng(seed)
    stamps = np.arange(true.stamps[0] + 2, true.stamps[-1] - 2, 0.1)
    poses = true.at(stamps)
    vec = np.array([se3.vector(se3.relative(*_ends(poses @ T))) for T in mounts])
    has_scale = np.array([i not in cameras for i in range(len(mounts))])
    vec[~has_scale, :, :3] /= np.linalg.norm(vec[~has_scale, :, :3], axis=2, keepdims=True).clip(1e-9)
    vec = vec + rng.normal(size=vec.shape) * sigma
    vec[~has_scale, :, :3] /= np.linalg.norm(vec[~has_scale, :, :3], axis=2, keepdims=True)
    cov = np.broadcast_to(np.diag(np.square(sigma)), (*vec.shape, 6)).copy()
    return Steps(np.stack([stamps[:-1], stamps[1:]], axis=1), vec, cov, has_scale)


def in_axes(steps: Steps, i: int, R: Array) -> Steps:
    """The same steps with sensor i's axes turned: what it calls v it now calls R v."""
    both = np.kron(np.eye(2), R)
    vec, cov = steps.vec.copy(), steps.cov.copy()
    vec[i], cov[i] = vec[i] @ both.T, both @ cov[i] @ both.T
    return Steps(steps.ends, vec, cov, steps.has_scale)


def in_base(mounts: Sequence[Array]) -> Array:
    """(n, 4, 4) true ``T_base_sensor``; the first is the base."""
    return se3.relative(np.broadcast_to(mounts[0], (len(mounts), 4, 4)), np.array(mounts))


def exact_turns(mounts: Sequence[Array]) -> Rotations:
    """The true rotations, as if known without error."""
    return Rotations(in_base(mounts)[:, :3, :3], np.zeros((3 * len(mounts), 3 * len(mounts))))


def turn_error(R: Array, R_true: Array) -> Array:
    """(n, 3) ``delta`` in ``R_true = Exp(delta) R``, base axes."""
    return se3.log_so3(R_true @ np.swapaxes(R, -1, -2))


def squared(error: Array, cov: Array) -> float:
    """Normalised estimation error squared per degree of freedom: one on average where cov is honest."""
    return float(error @ np.linalg.solve(cov, error)) / error.size


def _ends(poses: Array) -> tuple[Array, Array]:
    return poses[:-1], poses[1:]


def bowl(T, best, off, shape):
    """(k,) costs of poses (k, 4, 4) around one that is ``off`` (6,) from the best; ``shape`` (6,): how steep."""
    turn = se3.log_so3(T[:, :3, :3] @ best[:3, :3].T)
    error = np.column_stack([T[:, :3, 3] - best[:3, 3], turn])
    return np.sum(((error - off) * shape) ** 2, axis=1)
