"""Which sensors to compare, and when: all that a metric takes and that see the same place, spread over the drive."""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from calib_toolkit import se3
from calib_toolkit.hookspecs import CostMetric, Metric
from calib_toolkit.paths import poses_at
from calib_toolkit.types import Calibration, Log, Motions, Pair, Stream, Trajectory, Transform

Array = NDArray[np.float64]
Moved = Motions | Trajectory

LOST = np.radians(10.0)
"""Sigma of a rotation from which appearance can not be searched."""
TOGETHER = 0.6
"""Periods of the slower sensor within which two readings belong together."""
FAST, TURNING = 8.0, np.radians(15.0)
"""Metres and radians a second that are as good as more."""
STEP = 0.05
"""Seconds over which a rate is told."""


@dataclass(frozen=True)
class Comparison:
    """One metric's look at one pair."""

    metric: Metric | CostMetric
    pair: Pair


def comparisons(
    log: Log,
    motion: Mapping[str, Moved],
    calibration: Calibration,
    metrics: Mapping[str, Metric | CostMetric],
    count: int,
    seed: int,
) -> list[Comparison]:
    """Every metric with every pair of sensors that it takes and that see the same. count: readings of a pair."""
    found = []
    for names in combinations(calibration.names, 2):
        for a, b in (names, names[::-1]):
            kinds = log.streams[a].kind, log.streams[b].kind
            taking = [m for m in metrics.values() if m.accepts(*kinds)]
            if taking and (pair := _pair(log, motion, calibration, a, b, count, seed)) is not None:
                found += [Comparison(m, pair) for m in taking if m.overlap(pair)]
                break
    return found


def _pair(
    log: Log, motion: Mapping[str, Moved], calibration: Calibration, a: str, b: str, count: int, seed: int
) -> Pair | None:
    """The readings of two sensors to compare; None if how they are turned is not known, or none go together."""
    prior = calibration.between(a, b)
    if np.max(np.linalg.eigvalsh(prior.cov[3:, 3:])) > LOST**2:
        return None
    T = prior.T_a_b.copy()
    T[:3, 3] = np.nan_to_num(T[:3, 3])
    middle = float(np.mean(log.streams[calibration.base].stamps[[0, -1]]))
    dt = calibration.dt_at(a, b, middle)
    selected = select(log.streams[a], log.streams[b], motion[a], dt, count, seed)
    if not len(selected):
        return None
    prior = Transform(a, b, T, prior.cov, prior.has_scale)
    return Pair(log.streams[a], log.streams[b], motion[a], motion[b], dt, selected, prior)


def select(a: Stream, b: Stream, motion_a: Moved, dt: float, count: int, seed: int) -> NDArray[np.int64]:
    """(m, 2) readings of a and b that go together, at most ``count``: one of each part of the drive.

    Of each part that one is taken at which a moves and turns most, not quite: which of several good ones is drawn.
    """
    instants = b.stamps + dt
    i = np.clip(np.searchsorted(a.stamps, instants), 1, len(a) - 1)
    i = i - (np.abs(a.stamps[i - 1] - instants) < np.abs(a.stamps[i] - instants))
    near = np.abs(a.stamps[i] - instants) < TOGETHER * max(a.period, b.period)
    k = np.flatnonzero(near)
    if not len(k):
        return np.zeros((0, 2), dtype=np.int64)
    rng = np.random.default_rng([seed, len(a), len(b)])
    score = _moving(motion_a, instants[k]) * rng.uniform(0.5, 1.0, len(k))
    part = ((instants[k] - instants[k][0]) / max(np.ptp(instants[k]), 1e-9) * count).astype(int).clip(0, count - 1)
    order = np.lexsort((-score, part))
    first = order[np.flatnonzero(np.diff(part[order], prepend=-1))]
    chosen = np.sort(k[first])
    return np.column_stack([i[chosen], chosen]).astype(np.int64)


def rate(pair: Pair) -> Array:
    """(6,) metres and radians a second at which a moves on average when the readings were taken, in its own axes."""
    instants = pair.b.stamps[pair.selected[:, 1]] + pair.dt_a_b
    steps = np.array([poses_at(pair.motion_a, [t + STEP], t)[0] for t in instants])
    known = np.isfinite(steps).all(axis=(1, 2))
    return se3.vector(steps[known]).mean(axis=0) / STEP if known.any() else np.zeros(6)


def _moving(motion: Moved, instants: Array) -> Array:
    """(n,) from 0, standing, to 2, driving fast round a bend."""
    m = motion.motions() if isinstance(motion, Trajectory) else motion
    if not len(m):
        return np.zeros(len(instants))
    at = np.clip(np.searchsorted(m.start, instants) - 1, 0, len(m) - 1)
    seconds = np.maximum(m.end - m.start, 1e-9)[at]
    shift, turn = (np.linalg.norm(m.vec[at, part], axis=1) / seconds for part in (slice(3), slice(3, 6)))
    shift = shift if m.has_scale else np.full(len(at), FAST)
    return np.asarray(np.minimum(shift / FAST, 1.0) + np.minimum(turn / TURNING, 1.0))
