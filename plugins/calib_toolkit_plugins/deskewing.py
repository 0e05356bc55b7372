"""How a scanner moved within a sweep: foreseen from the steps between sweeps, then as the sweep itself shows it."""

from collections.abc import Sequence

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from calib_toolkit import se3
from calib_toolkit_plugins import registration
from calib_toolkit_plugins.registration import Surface

Array = NDArray[np.float64]

SHAKES = np.repeat([0.002, 0.0005], 3)
"""Metres and radians by which a vehicle shakes from the stamp to the far end of a sweep, beyond what the steps
foresee: sigma. Wider ones let sweeps of few beams bend as they like."""
OFF = 10 * SHAKES
"""Sigma of the pose of a sweep that was straightened by the steps alone."""
QUIET = 0.01
"""Radians a second: changes of the turn rate that noise may feign, from which no swing is told."""
UNEVEN = 0.2
"""Share by which a step may last longer or shorter than usual where second derivatives are taken."""


def deskew(points: Array, times: Array, velocity: Array, change: Array | None = None) -> Array:
    """Points, each as measured, moved to where the scanner was at the stamp (paper V-A).

    points: (n, 3) metres. times: (n,) seconds from the stamp. velocity: (6,) metres and radians a second at the
    stamp, axes of the scanner, which turn with it; change: (6,) by how much that changes per second, none by
    default. All to second order in the time since the stamp: under a millimetre at 50 m and 20 degrees/s.
    """
    turn, t = se3.skew(velocity[3:]), times[:, None]
    faster, bend = turn @ velocity[:3], turn @ turn
    if change is not None:
        faster, bend = faster + change[:3], bend + se3.skew(change[3:])
    return points + t * (points @ turn.T + velocity[:3] + (0.5 * t) * (points @ bend.T + faster))


def derivatives(stamps: Array, steps: Sequence[Array | None]) -> tuple[Array, Array]:
    """Velocity and its change, both (n, 6) as :func:`deskew` takes them, at each of n stamps, seconds.

    steps: ``T_prev_curr`` (4, 4) between them, None where unknown. Of the four steps around a stamp these are the
    derivatives of the quartic through their ends; where one is missing or of another length than usual, the mean of
    those beside the stamp and no change; nan where both of those are missing. How travel changes is not told by
    travel: along a bare street that would be noise, which the next pass would add to. It is what goes with changes of
    the turn rate all along the drive: a scanner swings on its mast when the vehicle rolls and pitches.
    """
    dt = np.diff(stamps)[:, None]
    vec = np.array([np.full(6, np.nan) if T is None else se3.vector(T) for T in steps])
    rate = vec / dt
    rate[:, :3] = np.linalg.solve(se3.left_jacobian(vec[:, 3:]), rate[:, :3, None])[:, :, 0]
    around = sliding_window_view(np.pad(rate, ((2, 2), (0, 0)), constant_values=np.nan), 4, axis=0)
    velocity, change = around @ [-1, 7, 7, -1] / 12, around @ [1, -15, 15, -1] / 12 / np.median(dt)
    before, after = around[:, :, 1], around[:, :, 2]
    either = (np.where(np.isnan(before), after, before) + np.where(np.isnan(after), before, after)) / 2
    even = np.abs(dt / np.median(dt) - 1) < UNEVEN
    whole = sliding_window_view(np.pad(even, ((2, 2), (0, 0))), 4, axis=0).all(axis=2)
    known = np.isfinite(change[:, :1]) & whole
    change[:, :3] = change[:, 3:] @ _swing(around[known[:, 0]] @ [-1, -1, 1, 1])
    return np.where(known, velocity, either), np.where(known, change, 0.0)


def _swing(changes: Array) -> Array:
    """(3, 3) by which changes of turns (n, 3) become changes of travel, of (n, 6) of both; less where few turn."""
    size = np.abs(changes)
    turning = np.any(size[:, 3:] > QUIET, axis=1)
    if not turning.any():
        return np.zeros((3, 3))
    usual = np.all(size <= 6 * np.median(size[turning], axis=0), axis=1)
    turns, travel = changes[usual, 3:], changes[usual, :3]
    return np.asarray(np.linalg.solve(turns.T @ turns + (len(turns) + 1) * QUIET**2 * np.eye(3), turns.T @ travel))


def settled(
    prev: Surface, points: Array, times: Array, T_prev_curr: Array, cell: float, gate: float
) -> tuple[Array, Array]:
    """``T_prev_curr`` (4, 4) of a sweep that may have shaken while it was measured, and points (m, 3) of it, metres,
    one a cell, as from where the scanner then was at the stamp.

    Least squares over point-to-plane distances below ``gate`` metres, Geman and McClure's weights, two rounds, in the
    pose and in what the motion lacks within the sweep, to second order in time. prev: what the sweep is laid on.
    points: (n, 3) metres, moved to the stamp as far as is known; times: (n,) seconds from it. T_prev_curr: a first
    guess. cell: metres.
    """
    taken, half = registration.picked(points, times, cell), float(np.quantile(np.abs(times), 0.98))
    p, order = points[taken], (times[taken, None] / max(half, 1e-9)) ** np.arange(3)
    stiff = np.concatenate([OFF, SHAKES, SHAKES]) ** -2
    x, R = np.zeros((3, 6)), T_prev_curr[:3, :3]
    for _ in range(2):
        there = registration.plane_residuals(prev, _moved(p, order @ x), T_prev_curr, gate)
        if len(there.errors) < stiff.size:
            break
        sigma = 1.4826 * np.median(np.abs(there.errors)) + 1e-6
        weight = (1 + (there.errors / (2 * sigma)) ** 2) ** -2 / sigma**2
        normals = there.normals @ R
        by_pose = np.hstack([normals, np.cross(there.points, normals)])
        J = (order[there.rows, :, None] * by_pose[:, None, :]).reshape(-1, stiff.size)
        gradient = J.T @ (there.errors * weight) + stiff * x.ravel()
        x -= np.linalg.solve(J.T @ (J * weight[:, None]) + np.diag(stiff), gradient).reshape(x.shape)
    T = se3.matrix(x[0])
    back = se3.invert(T)
    return T_prev_curr @ T, _moved(p, order @ x) @ back[:3, :3].T + back[:3, 3]


def _moved(points: Array, by: Array) -> Array:
    """Points moved by small motions, both (n, 3) and (n, 6)."""
    return points + by[:, :3] + np.cross(by[:, 3:], points)
