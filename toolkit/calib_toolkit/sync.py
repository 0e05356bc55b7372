"""Sensors that were read at different times, put on common steps (section VI-A1).

Between its stamps a sensor moves smoothly along the group: a cubic spline through its summed motions, since a
constant rate within each step would draw the stamps of two sensors together (tens of milliseconds at 10 Hz).
The noise of a motion gathers evenly over its duration: a part of a step carries that part of its covariance.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline, PPoly

from calib_toolkit import se3
from calib_toolkit.types import Motions

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

SAME_STAMP = 1e-6
"""Stamps closer than this (seconds) are one instant."""


@dataclass(frozen=True)
class Chain:
    """One sensor's motions end to end; where a motion is missing there is a link that is not known.

    knots: (m + 1,) seconds. vec: (m, 6) and cov: (m, 6, 6) of each link; known: (m,).
    summed: the links' twists ``[v w]`` added up, (6,) at any stamp, smooth within each unbroken run.
    """

    knots: Array
    vec: Array
    cov: Array
    known: Mask
    has_scale: bool
    summed: PPoly = field(repr=False)

    @property
    def period(self) -> float:
        """Median duration of the known links, seconds."""
        return float(np.median(np.diff(self.knots)[self.known]))

    @cached_property
    def turned(self) -> PPoly:
        """The rotation in ``summed`` alone, (3,) at any stamp."""
        return PPoly(self.summed.c[:, :, 3:], self.knots)

    @cached_property
    def gathered(self) -> Array:
        """(m + 1, 2) variance of the angle and time not known, added up to each knot."""
        return _added_up(np.column_stack([angle_variance(self.vec[:, 3:], self.cov[:, 3:, 3:]), _unknown(self)]))

    def shifted(self, dt: float) -> "Chain":
        """The same chain on a clock that reads ``dt`` seconds more."""
        moved = PPoly(self.summed.c, self.knots + dt)
        return replace(self, knots=self.knots + dt, summed=moved)


@dataclass(frozen=True)
class Steps:
    """All sensors' motions over common steps.

    ends: (m, 2) seconds in base time, start and end of each step. vec: (n, m, 6); cov: (n, m, 6, 6);
    has_scale: (n,); rejected: how many steps were dropped because the sensors' angles disagreed.
    """

    ends: Array
    vec: Array
    cov: Array
    has_scale: Mask
    rejected: int = 0

    def __len__(self) -> int:
        return len(self.ends)

    def __getitem__(self, keep: Mask) -> "Steps":
        rejected = self.rejected + int((~keep).sum())
        return Steps(self.ends[keep], self.vec[:, keep], self.cov[:, keep], self.has_scale, rejected)


def chain(motions: Motions) -> Chain:
    """The motions of one sensor, end to end, from its earliest; of overlapping ones the earlier stays."""
    order = np.argsort(motions.start, kind="stable")
    m = motions[order]
    if np.any(m.start[1:] < m.end[:-1] - SAME_STAMP):
        m = m[_without_overlap(m.start, m.end)]
    gap = np.flatnonzero(m.start[1:] > m.end[:-1] + SAME_STAMP) + 1
    knots = np.concatenate([m.start[:1], np.insert(m.end, gap, m.start[gap])])
    vec = np.insert(m.vec, gap, 0.0, axis=0)
    cov = np.insert(m.cov, gap, np.eye(6), axis=0)
    known = np.insert(np.ones(len(m), dtype=bool), gap, False)
    return Chain(knots, vec, cov, known, m.has_scale, _summed(knots, vec, known))


def common_span(chains: Sequence[Chain], dt: Array | None = None) -> tuple[float, float]:
    """First and last instant that every sensor covers, seconds; empty when the first is not before the last.

    dt: (n,) added to each sensor's stamps, zero if None.
    """
    later = np.zeros(len(chains)) if dt is None else dt
    first, last = (np.array([c.knots[end] for c in chains]) + later for end in (0, -1))
    return float(first.max()), float(last.min())


def angles(chains: Sequence[Chain], stamps: Array, window: float, dt: Array | None = None) -> tuple[Array, Array]:
    """Angle through which each sensor turns in the window that begins at each stamp, with its variance.

    stamps: (m,) and window: seconds of base time. dt: (n,) added to each sensor's stamps to get base time, zero if
    None. Returns (n, m) radians and (n, m) radians squared; nan where a sensor's motion is not known. Within so
    short a window rotations commute to second order, so they are summed.
    """
    found = [
        _angles_of(c, stamps - d, window)
        for c, d in zip(chains, np.zeros(len(chains)) if dt is None else dt, strict=True)
    ]
    return np.array([a for a, _ in found]), np.array([v for _, v in found])


def synchronise(chains: Sequence[Chain], gate: float = 10.0) -> Steps:
    """All sensors' motions between the stamps of the slowest, in base time (VI-A1).

    Steps that some sensor does not cover are left out, as are those where the angles of two sensors differ
    by more than ``gate`` standard deviations.
    """
    start, end = common_span(chains)
    knots = chains[slowest(chains)].knots
    knots = knots[(knots >= start - SAME_STAMP) & (knots <= end + SAME_STAMP)]
    ends = np.stack([knots[:-1], knots[1:]], axis=1)
    parts = [_between(c, ends) for c in chains]
    known = np.all([k for _, _, k in parts], axis=0)
    vec = np.array([v[known] for v, _, _ in parts])
    cov = np.array([c[known] for _, c, _ in parts])
    steps = Steps(ends[known], vec, cov, np.array([c.has_scale for c in chains]))
    return steps[agreeing(steps, gate)]


def slowest(chains: Sequence[Chain]) -> int:
    """The sensor with the longest period; among equals (5 %) one without scale, whose steps can not be joined."""
    periods = np.array([c.period for c in chains])
    equal = periods > 0.95 * periods.max()
    unscaled = equal & ~np.array([c.has_scale for c in chains])
    return int(np.flatnonzero(unscaled if unscaled.any() else equal)[0])


def agreeing(steps: Steps, gate: float) -> Mask:
    """(m,) whether all sensors turned through the same angle to within ``gate`` standard deviations."""
    rot, cov = steps.vec[..., 3:], steps.cov[..., 3:, 3:]
    angle, variance = np.linalg.norm(rot, axis=-1), angle_variance(rot, cov)
    keep = np.ones(len(steps), dtype=bool)
    for x in range(len(angle)):
        for y in range(x + 1, len(angle)):
            keep &= np.abs(angle[x] - angle[y]) <= gate * np.sqrt(variance[x] + variance[y])
    return keep


def angle_variance(rotvec: Array, cov: Array) -> Array:
    """Variance of the length of a rotation vector: (..., 3), (..., 3, 3) -> (...). At rest, that of any axis."""
    angle = np.linalg.norm(rotvec, axis=-1, keepdims=True)
    mean = np.trace(cov, axis1=-2, axis2=-1) / 3
    axis = rotvec / np.maximum(angle, 1e-12)
    along = np.einsum("...i,...ij,...j->...", axis, cov, axis)
    return np.where(angle[..., 0] > 1e-9, along, mean)


def add_timing_noise(steps: Steps, dt_cov: Array) -> Steps:
    """Steps whose covariance holds what the timing leaves open: equations (19) and (20).

    dt_cov: (n, n) of the sensors' offsets, seconds squared. A clock that is off by d moves both ends of a step,
    so the motion changes by d times the rate at which the motion itself changes.
    """
    middle = steps.ends.mean(axis=1)
    rate = np.gradient(steps.vec, middle, axis=1) if len(steps) > 2 else np.zeros_like(steps.vec)
    extra = np.diag(dt_cov)[:, None, None, None] * np.einsum("nmi,nmj->nmij", rate, rate)
    return Steps(steps.ends, steps.vec, steps.cov + extra, steps.has_scale, steps.rejected)


def _without_overlap(start: Array, end: Array) -> NDArray[np.int64]:
    keep, last = [], -np.inf
    for k, (s, e) in enumerate(zip(start, end, strict=True)):
        if s >= last - SAME_STAMP:
            keep.append(k)
            last = e
    return np.array(keep)


def _summed(knots: Array, vec: Array, known: Mask) -> PPoly:
    """Cubic spline through the summed twists of each unbroken run; constant over what is not known."""
    twist = np.column_stack([np.linalg.solve(se3.left_jacobian(vec[:, 3:]), vec[:, :3, None])[..., 0], vec[:, 3:]])
    at_knots = np.vstack([np.zeros(6), np.cumsum(twist, axis=0)])
    c = np.zeros((4, len(vec), 6))
    c[3] = at_knots[:-1]
    edges = np.flatnonzero(np.diff(np.concatenate([[False], known, [False]]).astype(int)))
    for i, j in edges.reshape(-1, 2):
        c[:, i:j] = CubicSpline(knots[i : j + 1], at_knots[i : j + 1], bc_type="natural").c
    return PPoly(c, knots)


def _angles_of(c: Chain, start: Array, window: float) -> tuple[Array, Array]:
    end = start + window
    rotvec = c.turned(end) - c.turned(start)
    variance, unknown = (np.interp(end, c.knots, g) - np.interp(start, c.knots, g) for g in c.gathered.T)
    bad = (unknown > SAME_STAMP) | (start < c.knots[0] - SAME_STAMP) | (end > c.knots[-1] + SAME_STAMP)
    return (
        np.where(bad, np.nan, np.sqrt(np.einsum("mi,mi->m", rotvec, rotvec))),
        np.where(bad, np.nan, np.maximum(variance, 1e-18)),
    )


def _between(c: Chain, ends: Array) -> tuple[Array, Array, Mask]:
    """Motion of one sensor over each (start, end), its covariance, and whether it is known throughout."""
    poses = _poses(c, ends.ravel()).reshape(-1, 2, 4, 4)
    vec = se3.vector(se3.relative(poses[:, 0], poses[:, 1]))
    gathered = _added_up(np.concatenate([c.cov.reshape(-1, 36), _unknown(c)[:, None]], axis=1))
    link = _link(c, ends.ravel())
    part = np.clip((ends.ravel() - c.knots[link]) / (c.knots[link + 1] - c.knots[link]), 0.0, 1.0)
    at_ends = gathered[link] + part[:, None] * (gathered[link + 1] - gathered[link])
    step = np.diff(at_ends.reshape(-1, 2, 37), axis=1)[:, 0]
    cov = step[:, :36].reshape(-1, 6, 6)
    if not c.has_scale:
        length = np.linalg.norm(vec[:, :3], axis=1, keepdims=True)
        unit = np.ones_like(vec)
        unit[:, :3] = 1 / np.maximum(length, 1e-12)
        vec *= unit
        cov *= unit[:, :, None] * unit[:, None, :]
    return vec, cov, step[:, 36] <= SAME_STAMP


def _unknown(c: Chain) -> Array:
    """(m,) how long each link's motion is not known, seconds."""
    return np.where(c.known, 0.0, np.diff(c.knots))


def _added_up(per_link: Array) -> Array:
    """What the links (m, q) add up to at each knot, (m + 1, q)."""
    return np.vstack([np.zeros(per_link.shape[1]), np.cumsum(per_link, axis=0)])


def _link(c: Chain, stamps: Array) -> NDArray[np.int64]:
    return np.clip(np.searchsorted(c.knots, stamps, side="right") - 1, 0, len(c.knots) - 2)


def _poses(c: Chain, stamps: Array) -> Array:
    """Pose of the sensor at each stamp in its own first frame: the last knot's, then along the link's spline."""
    T = se3.matrix(c.vec)
    at_knots = np.empty((len(c.knots), 4, 4))
    at_knots[0] = np.eye(4)
    for k in range(len(T)):
        at_knots[k + 1] = at_knots[k] @ T[k]
    link = _link(c, stamps)
    twist = c.summed(np.clip(stamps, c.knots[0], c.knots[-1])) - c.summed.c[3, link]
    t = (se3.left_jacobian(twist[:, 3:]) @ twist[:, :3, None])[..., 0]
    return at_knots[link] @ se3.rigid(se3.exp_so3(twist[:, 3:]), t)
