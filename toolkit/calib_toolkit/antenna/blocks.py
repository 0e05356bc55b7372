"""Stretches of a drive in which positions are laid over the base's own path: residuals, slopes and noise.

In each stretch where the world is, and how it is turned, are unknowns of their own, so neither a drift of the base
nor an error that wanders slowly with the receiver counts.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib_toolkit import se3, sync
from calib_toolkit.types import Motions, Trajectory

Array = NDArray[np.float64]
Index = NDArray[np.int64]

LENGTH = 10.0
"""Seconds, at least, of a stretch; there are at most ``MOST`` of them in a drive."""
MOST = 200
FEWEST = 6
"""Positions that make a stretch."""
OFTEN = 0.2
"""Seconds below which further positions tell nothing new: their errors are hardly independent."""
STEP = 0.1
"""Seconds before and after an instant over which a velocity is told."""
ASIDE = 3
"""Stretches on either side that help to tell how the world is turned."""
TURNED = 1.0
"""Radians: sigma of how well they do. Less would pass for knowing how a lever is turned in a steady bend."""


@dataclass(frozen=True)
class Base:
    """The base's path in a frame that drifts. knots: (m + 1,) seconds, T: (m + 1, 4, 4) there.

    variance: (m, 2) of one axis of each step's shift and turn. known: (m,) whether it was measured at all.
    """

    knots: Array
    T: Array
    variance: Array
    known: NDArray[np.bool_]
    chain: sync.Chain

    @staticmethod
    def of(motions: Motions) -> "Base":
        """Motions end to end."""
        c = sync.chain(motions)
        T = [np.eye(4)]
        for link in se3.matrix(c.vec):
            T.append(T[-1] @ link)
        variance = np.einsum("mii->mi", c.cov).reshape(-1, 2, 3).mean(axis=2)
        return Base(c.knots, np.array(T), variance, c.known, c)

    def at(self, stamps: Array) -> Array:
        """Poses (n, 4, 4), smooth between knots."""
        k = self.link(stamps)
        twist = self.chain.summed(np.clip(stamps, self.knots[0], self.knots[-1])) - self.chain.summed.c[3, k]
        shift = (se3.left_jacobian(twist[:, 3:]) @ twist[:, :3, None])[..., 0]
        return np.asarray(self.T[k] @ se3.rigid(se3.exp_so3(twist[:, 3:]), shift))

    def link(self, stamps: Array) -> Index:
        """(n,) the step in which each stamp lies."""
        return np.clip(np.searchsorted(self.knots, stamps, side="right") - 1, 0, len(self.knots) - 2)


@dataclass(frozen=True)
class Block:
    """One stretch against a pose of the antenna: k positions, in axes of the base at its beginning.

    residual: (k, 3). by_antenna: (k, 3, 4) its slope with ``(t, dt)``; by_own: (k, 3, 6) with where the world is and
    how it is turned. noise: (k, 3, 3) of each position as stated. grown: (2, 3k, 3k) what the shifts and the turns of
    the base's steps, as stated, add. T: (k, 4, 4) the base. shares: (3, k, j) how much of each of its j steps lies
    before each position, and before ``STEP`` earlier and later. sigma: (j, 2) of these steps.
    """

    residual: Array
    by_antenna: Array
    by_own: Array
    noise: Array
    grown: Array
    T: Array
    shares: Array
    sigma: Array


def cut(base: Base, positions: Trajectory, dt: float, often: float = OFTEN) -> list[Index]:
    """Rows of positions of each stretch, none across a gap of the base or a jump of positions. dt, often: seconds."""
    stamps = positions.stamps + dt
    inside = np.flatnonzero((stamps - STEP >= base.knots[0]) & (stamps + STEP <= base.knots[-1]))
    if not len(inside):
        return []
    tick = np.floor((stamps[inside] - stamps[inside[0]]) / often + 1e-6)
    inside = inside[np.concatenate([[True], np.diff(tick) > 0])]
    span = stamps[inside[-1]] - stamps[inside[0]]
    jumped = np.cumsum(np.trace(positions.drift, axis1=1, axis2=2) > 0)
    unbroken = np.concatenate([[0], np.cumsum(~base.known)])[base.link(stamps[inside])] + jumped[inside]
    length = max(LENGTH, span / MOST)
    place = ((stamps[inside] - stamps[inside[0]]) // length).astype(np.int64)
    edges = np.flatnonzero((np.diff(place) != 0) | (np.diff(unbroken) != 0)) + 1
    found = [rows for rows in np.split(inside, edges) if len(rows) >= FEWEST]
    return [rows for rows in found if base.known[base.link(stamps[rows])].all()]


def turned(
    base: Base, positions: Trajectory, rows: Sequence[Index], dt: float, t: Array
) -> tuple[Array, list[Array], list[Array]]:
    """(b, 3, 3) how the world is turned to the base's path in each stretch, by it and those around it laid over each
    other; and both paths (k, 3) in each, about their middles. t: (3,) of the antenna in the base.
    """
    T = base.at(positions.stamps + dt)
    at = T[:, :3, 3] + T[:, :3, :3] @ t
    p, q = ([x[r] - x[r].mean(axis=0) for r in rows] for x in (positions.T_world_sensor[:, :3, 3], at))
    products = np.array([a.T @ b for a, b in zip(p, q, strict=True)])
    around = [products[max(i - ASIDE, 0) : i + ASIDE + 1].sum(axis=0) for i in range(len(rows))]
    U, _, Vt = np.linalg.svd(np.array(around))
    right = np.ones((len(rows), 1, 3))
    right[:, 0, 2] = np.linalg.det(U @ Vt)
    return (U * right) @ Vt, p, q


def against(base: Base, positions: Trajectory, rows: Index, R: Array, dt: float, t: Array) -> Block:
    """One stretch. R: (3, 3) how the world is turned to the base's path. t: (3,) the antenna in the base."""
    stamps = positions.stamps[rows] + dt
    around = stamps + STEP * np.array([[0.0], [-1.0], [1.0]])
    T_path = base.at(around.ravel())
    first = se3.invert(T_path[0])
    T = (first @ T_path).reshape(3, len(rows), 4, 4)
    R = R @ T_path[0, :3, :3]
    at = T[..., :3, 3] + T[..., :3, :3] @ t
    p = positions.T_world_sensor[rows, :3, 3]
    measured = (p - p.mean(axis=0)) @ R
    residual = measured - (at[0] - at[0].mean(axis=0))
    velocity = (at[2] - at[1]) / (2 * STEP)
    by_antenna = np.concatenate([-T[0, :, :3, :3], -velocity[:, :, None]], axis=2)
    # about the base's own path: the noise of positions would pass for knowing how the world is turned
    swing = se3.skew(at[0] - at[0].mean(axis=0))
    by_own = np.concatenate([np.broadcast_to(np.eye(3), swing.shape), swing], axis=2)
    noise = np.swapaxes(R, 0, 1) @ positions.cov[rows, :3, :3] @ R
    j = np.arange(base.link(stamps[:1] - STEP)[0], base.link(stamps[-1:] + STEP)[0] + 1)
    shares = np.clip((around[..., None] - base.knots[j]) / (base.knots[j + 1] - base.knots[j]), 0.0, 1.0)
    start = (first @ base.T[j])[:, :3, 3]
    sigma = np.sqrt(base.variance[j])
    by_shift = np.einsum("kj,j,ab->kajb", shares[0], sigma[:, 0], np.eye(3)).reshape(3 * len(rows), -1)
    lever = se3.skew(at[0][:, None] - start[None])
    by_turn = np.einsum("kj,j,kjab->kajb", shares[0], sigma[:, 1], lever).reshape(3 * len(rows), -1)
    grown = np.array([by_shift @ by_shift.T, by_turn @ by_turn.T])
    return Block(residual, by_antenna, by_own, noise, grown, T[0], shares, sigma)


def errors(block: Block, t: Array, scale: Array, rng: np.random.Generator) -> Array:
    """(k, 3, 4) what one draw of the base's errors makes of the slope with ``(t, dt)``, if nothing else did."""
    drawn = rng.normal(size=(*block.sigma.shape, 3)) * (block.sigma * np.sqrt(scale))[..., None]
    shift, turn = np.einsum("skj,jd->skd", block.shares, drawn[:, 0]), block.shares[0] @ drawn[:, 1]
    R = block.T[:, :3, :3]
    wrong = se3.skew(turn) @ R
    late = (shift[2] - shift[1]) / (2 * STEP)
    ahead = np.gradient(block.T[:, :3, 3] + R @ t, axis=0) / OFTEN
    late = late + np.cross(turn, ahead)
    return np.concatenate([-wrong, -late[:, :, None]], axis=2)
