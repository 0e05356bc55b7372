"""Odometry: poses or motions that something else estimated (visual or lidar odometry, SLAM, another INS)."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib_toolkit import DataError, Sensor, hookimpl
from calib_toolkit.types import MotionReading, Motions, PoseReading, Stream, Trajectory

Array = NDArray[np.float64]

NOISE_FLOOR = np.array([1e-4, 1e-4, 1e-4, 1e-5, 1e-5, 1e-5])
"""No estimated noise of a step is believed to be below this (metres, radians)."""


@dataclass(frozen=True)
class OdometryOptions:
    """How far readings are believed.

    motion_sigma: one sigma of a step, ``[x y z rx ry rz]``, metres and radians, for readings that state no
    covariance; None to estimate it from the motion. has_scale: None to take the stream's word for it.
    """

    motion_sigma: tuple[float, ...] | None = None
    has_scale: bool | None = None


def estimate(stream: Stream, options: OdometryOptions) -> Motions | Trajectory:
    """Motion between successive readings, each a ``MotionReading`` or a ``PoseReading``.

    Poses that all state a covariance stay a Trajectory; everything else becomes Motions, failed readings left
    out. Without scale, translations are brought to unit length. Raises DataError.
    """
    readings = [stream.readings[i] for i in range(len(stream))]
    if len(readings) < 2:
        raise DataError(f"sensor {stream.name}: a motion takes two readings, and there are {len(readings)}")
    has_scale = stream.has_scale if options.has_scale is None else options.has_scale
    if isinstance(readings[0], MotionReading):
        motions = _motions(stream, readings, options.motion_sigma)
    else:
        trajectory = _trajectory(stream, readings)
        if has_scale and all(r.cov is not None for r in readings):
            return trajectory
        silent = np.array([a.cov is None or b.cov is None for a, b in pairwise(readings)])
        motions = _with_sigma(stream.name, trajectory.motions(), silent, options.motion_sigma)
    return motions if has_scale else unit_translations(motions)


def noise_of_steps(name: str, motions: Motions) -> Array:
    """One sigma of a step, (6,) metres and radians, told from the motion alone.

    A vehicle's speed and turn rate hardly bend within three steps, so the second difference of the rates is
    noise, sqrt(6) times one rate's. Its median absolute value over the steps made while moving bounds the noise
    from above, whatever the outliers. Raises DataError with fewer than eight such differences.
    """
    rate = motions.vec / (motions.end - motions.start)[:, None]
    length = np.linalg.norm(motions.vec[:, :3], axis=1)
    joined = np.abs(motions.start[1:] - motions.end[:-1]) < 1e-6
    moving = length >= 0.1 * np.quantile(length, 0.95) if len(length) else np.zeros(0, dtype=bool)
    bend = np.diff(rate, 2, axis=0)[joined[1:] & joined[:-1] & moving[1:-1]]
    if len(bend) < 8:
        raise DataError(
            f"sensor {name}: its {len(length)} steps are too few to tell their noise; state motion_sigma (six "
            "numbers, metres and radians per step)"
        )
    period = float(np.median(motions.end - motions.start))
    sigma = 1.4826 * period / np.sqrt(6) * np.median(np.abs(bend), axis=0)
    return np.asarray(np.maximum(sigma, NOISE_FLOOR))


def unit_translations(motions: Motions) -> Motions:
    """The same motions with translations of length one, and the covariance of their direction.

    ``u = t / |t|`` has the Jacobian ``(I - u u^T) / |t|``. A direction known to no better than a radian, and
    that of no translation at all, gets variance one.
    """
    t = motions.vec[:, :3]
    length = np.linalg.norm(t, axis=1)
    zero = length == 0.0
    length = np.where(zero, 1.0, length)
    u = np.where(zero[:, None], [1.0, 0.0, 0.0], t / length[:, None])
    tangent = np.eye(3) - u[:, :, None] * u[:, None, :]
    J = np.zeros((len(u), 6, 6))
    J[:, :3, :3] = tangent / length[:, None, None]
    J[:, 3:, 3:] = np.eye(3)
    cov = J @ motions.cov @ np.swapaxes(J, 1, 2)
    vague = zero | (np.linalg.eigvalsh(cov[:, :3, :3])[:, -1] > 1.0)
    cov[vague, :3, :] = cov[vague, :, :3] = 0.0
    cov[vague, :3, :3] = tangent[vague]
    cov[zero, :3, :3] = np.eye(3)
    return replace(motions, vec=np.hstack([u, motions.vec[:, 3:]]), cov=cov, has_scale=False)


def six_sigmas(values: Any, where: str) -> Array:
    """(6,) stated sigmas of a step, metres and radians. Raises DataError; ``where`` begins the sentence."""
    try:
        sigma = np.asarray(values, dtype=float)
    except (TypeError, ValueError):
        sigma = np.zeros(0)
    if sigma.shape != (6,) or not np.all(np.isfinite(sigma) & (sigma > 0.0)):
        raise DataError(f"{where} must be six positive numbers [x, y, z, rx, ry, rz], metres and radians per step")
    return sigma


def _with_sigma(name: str, motions: Motions, silent: NDArray[np.bool_], stated: Any) -> Motions:
    """The motions, those that state none given that of the stated or estimated sigma."""
    if not silent.any():
        return motions
    sigma = noise_of_steps(name, motions) if stated is None else six_sigmas(stated, f"sensor {name}: motion_sigma")
    return replace(motions, cov=np.where(silent[:, None, None], np.diag(sigma**2), motions.cov))


def _motions(stream: Stream, readings: Sequence[MotionReading], stated: Any) -> Motions:
    made = np.array([k for k in range(1, len(readings)) if readings[k].vec is not None], dtype=int)
    if not len(made):
        raise DataError(f"sensor {stream.name}: none of its {len(readings)} readings holds a motion; leave it out")
    vec = np.array([readings[k].vec for k in made], dtype=float)
    silent = np.array([readings[k].cov is None for k in made])
    cov = np.array([np.zeros((6, 6)) if readings[k].cov is None else readings[k].cov for k in made], dtype=float)
    _refuse(stream, made, np.isfinite(vec).all(axis=1) & np.isfinite(cov).all(axis=(1, 2)), "motion")
    return _with_sigma(stream.name, Motions(stream.stamps[made - 1], stream.stamps[made], vec, cov), silent, stated)


def _trajectory(stream: Stream, readings: Sequence[PoseReading]) -> Trajectory:
    T = np.array([r.T_world_sensor for r in readings], dtype=float)
    cov = np.array([np.zeros((6, 6)) if r.cov is None else r.cov for r in readings], dtype=float)
    good = np.isfinite(T).all(axis=(1, 2)) & np.isfinite(cov).all(axis=(1, 2))
    _refuse(stream, np.arange(len(T)), good, "pose")
    return Trajectory(stream.stamps, T, cov, np.zeros_like(cov))


def _refuse(stream: Stream, frames: NDArray[np.int64], good: NDArray[np.bool_], what: str) -> None:
    if not good.all():
        stamp = stream.stamps[frames[int(np.argmin(good))]]
        raise DataError(f"sensor {stream.name}: its {what} at {stamp:.3f} s holds nan or inf; drop that reading")


@hookimpl
def calib_register_sensors() -> list[Sensor]:
    """Odometry; one slice holds a whole drive, since its noise is told from all of it."""
    from calib_toolkit_plugins.odometry_tables import open_table  # which needs this module

    return [Sensor("odometry", estimate, OdometryOptions, open_table, chunk=1_000_000)]
