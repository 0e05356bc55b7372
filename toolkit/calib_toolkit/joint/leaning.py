"""Sensors whose travel is turned against their own turns, or late: which of the two to believe, and how far."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag, null_space

from calib_toolkit import se3
from calib_toolkit.joint import verdict
from calib_toolkit.joint.moving import Moving
from calib_toolkit.joint.turning import Turning
from calib_toolkit.types import Motions

Array = NDArray[np.float64]

SURE = 3.5
"""Sigma by which a sensor's turns and travel must disagree before they are not believed together."""
BIASED = 0.05
"""Radians by which travel may be turned about an axis about which they disagree."""
MOST = float(np.radians(1.5))
"""Travel is never turned further than this: then it is the turns that are wrong."""
TILT = float(np.radians(0.015))
"""By which turns are tilted across travel, at most, where a sensor's travel leans: corners in images follow a turn
a hundredth of a pixel wrong, all alike, and no number of them averages that away."""
USUAL = float(np.radians(0.5))
"""Sigma of what travel is turned by, as far as recordings show, where the turns are no help to tell."""


def stated(motions: Sequence[Motions], R: Array) -> Array:
    """(3(n-1), 3(n-1)) of what each travel is turned by against its turns and against the base's, base axes.

    By what the sensors state of it: the base's own fault is shared by all. R: (n, 3, 3) of the poses.
    """
    base, *others = (axes * m.lean**2 @ axes.T for m, axes in zip(motions, R, strict=True))
    return np.asarray(block_diag(*others) + np.tile(base, (len(others), len(others))))


def late(motions: Sequence[Motions], velocity: Array) -> Array:
    """(6(n-1), 6(n-1)) of poses: travel may be late by as much as turns are, but not by the same.

    In a bend it then points aside by what the vehicle turned meanwhile, just as if the sensor sat further back. The
    base's own fault is shared by all. velocity: (3,) of the base on average, metres a second, its axes.
    """
    along = np.zeros((6, 6))
    along[:3, :3] = np.outer(velocity, velocity)
    base, *others = (m.late**2 * along for m in motions)
    return np.asarray(block_diag(*others) + np.tile(base, (len(others), len(others))))


def tilted(motions: Sequence[Motions], R: Array, ahead: Array) -> Array:
    """(6(n-1), 6(n-1)) of poses: what leans travel tilts the turns, too: by as much about where the vehicle goes.

    There travel tells nothing. Across that it is told to lean already, and the turns are, by up to ``TILT``.
    Arguments as of :func:`stated`; ahead: (3,) where the base went.
    """
    about = ahead / max(float(np.linalg.norm(ahead)), 1e-9)
    along = np.outer(about, about)
    least = [replace(m, lean=np.minimum(m.lean, TILT)) for m in motions]
    return _of_poses(along, stated(motions, R)) + _of_poses(np.eye(3) - along, stated(least, R))


def _of_poses(part: Array, cov: Array) -> Array:
    """(6m, 6m) of poses from the part (3, 3) of each of m rotations whose covariance is (3m, 3m)."""
    only = np.kron(np.eye(len(cov) // 3), np.vstack([np.zeros((3, 3)), part]))
    return np.asarray(only @ cov @ only.T)


def axes(
    turned: Turning, lean: Array, open_: Sequence[Array], by_turns: Sequence[Array], found: Moving, ahead: Array
) -> list[Array]:
    """For each sensor but the base, axes (3, j) about which its turns alone say something else than its travel.

    lean: (3(n-1), 3(n-1)) as :func:`stated`. open_, by_turns: (6, k) directions of each pose that nothing tells, and
    that turns do not. ahead: (3,) where the base went: a travel that is turned about itself looks the same, so all
    axes lie across it.
    """
    axes = []
    for k, (directions, unturned) in enumerate(zip(open_, by_turns, strict=True)):
        R, own = (found.T_base_sensor[k + 1, :3, :3], turned.R_base_sensor[k + 1]), slice(3 * k, 3 * k + 3)
        apart = se3.log_so3(R[1] @ R[0].T) + found.bias[k + 1]
        # what nothing told, or turns do not, may lie anywhere
        anywhere = np.concatenate([verdict.turns(directions), verdict.turns(unturned)], axis=1)[3:]
        told = null_space(np.column_stack([anywhere, ahead]).T)
        if not told.size:
            axes.append(told)
            continue
        variance, vectors = np.linalg.eigh(told.T @ (turned.cov[own, own] + lean[own, own]) @ told)
        each = told @ vectors
        axes.append(each[:, (each.T @ apart) ** 2 > SURE**2 * variance])
    return axes


def between(found: Moving, axes: Sequence[Array]) -> tuple[Array, Array]:
    """T_base_sensor (n, 4, 4), and (p, p) what their errors are of those that were found, p = 9(n-1).

    The rotation that was found is that of the turns. Half-way to that of the travel no more than half the difference
    is wrong, whichever is at fault; where they are too far apart, it is the turns.
    """
    T, by_found = found.T_base_sensor.copy(), np.eye(len(found.free))
    n = len(T)
    for k, about in enumerate(axes):
        if about.size:
            bias = about @ about.T @ found.bias[k + 1]
            way = -bias if np.linalg.norm(bias) > MOST else -bias / 2
            turn, by = slice(6 * k + 3, 6 * k + 6), 6 * (n - 1) + 3 * k
            by_found[turn, turn] = se3.exp_so3(way)
            share = np.linalg.norm(way) / np.linalg.norm(bias)
            by_found[turn, by : by + 3] = -share * se3.left_jacobian(way) @ about @ about.T
            T[k + 1, :3, :3] = by_found[turn, turn] @ T[k + 1, :3, :3]
    return T, by_found


def doubt(turned: Turning, found: Moving, axes: Sequence[Array], ahead: Array) -> Array:
    """(p, p) what such contradictions leave open, p = 9(n-1). ahead: (3,) where the base went.

    About the other axis across travel it may well be turned as far, as long as turns would not show it. The base's
    fault is shared by all sensors, so theirs count as one: what they differ by between each other stays known.
    """
    own, other = np.zeros((len(found.free), 4)), np.zeros((len(found.free), 3))
    for k, about in enumerate(axes):
        if about.size:
            bias = about @ about.T @ found.bias[k + 1]
            turn, size = slice(6 * k + 3, 6 * k + 6), np.linalg.norm(bias)
            if size > MOST:
                own[turn, :3] = USUAL * about @ about.T
                continue
            across = null_space(np.array([bias, ahead]))
            variance = across.T @ turned.cov[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] @ across
            shown = SURE * np.sqrt(np.trace(variance))
            own[turn, 3] = bias / 2
            other[turn] = min(size, shown) * across @ across.T
    return np.asarray(own @ own.T + other @ other.T)
