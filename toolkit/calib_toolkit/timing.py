"""How late each clock is: sections VI-A1, VI-B1, VI-C and VI-D for the timing offsets.

All points of a rigid body turn through the same angle (equation 6), whatever the extrinsics, so the offsets
are found from the angles alone. ``dt`` is added to a sensor's stamps to get base time; the base is the first.
"""

from collections.abc import Hashable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.signal import correlate

from calib_toolkit import delta
from calib_toolkit.errors import NotObservableError
from calib_toolkit.likelihood import all_pairs, log_normal, maximise, trimmed
from calib_toolkit.sync import Chain, angles, common_span

Array = NDArray[np.float64]


@dataclass(frozen=True)
class TimingOptions:
    """steps: at how many instants the sensors are compared (VI-A1). trim: share of each pair left out (VI-C1).

    start: ``correlation`` of the angular speeds, or ``zero`` as in the paper. max_offset: seconds.
    """

    steps: int = 10_000
    trim: float = 0.25
    start: str = "correlation"
    max_offset: float = 5.0


@dataclass(frozen=True)
class TimeOffsets:
    """dt: (n,) seconds added to each sensor's stamps to get base time. cov: (n, n), zero for the base."""

    dt: Array
    cov: Array


@dataclass(frozen=True)
class Grid:
    """Instants at which angles are compared, each over a window of two readings of the slowest sensor.

    Within a reading the rate of turn is not known, and what an interpolation makes of it depends on where the
    stamps lie, which draws those of two sensors together; over two readings that averages out.
    """

    stamps: Array
    window: float

    @property
    def independent(self) -> float:
        """Windows overlap: how many independent ones each stands for."""
        return min(float(self.stamps[1] - self.stamps[0]) / self.window, 1.0)


def estimate(chains: Sequence[Chain], clocks: Sequence[Hashable], options: TimingOptions) -> TimeOffsets:
    """Offsets of all sensors to the first. clocks: (n,) sensors with equal ones share one offset."""
    groups = _groups(clocks)
    start = initialise(chains, options)[_first_of(groups)]
    over = grid(chains, _spread(start, groups), options.steps)
    dt = optimise(start, chains, groups, over, options.trim)
    to_clock = _to_clock(groups)
    cov = to_clock @ uncertainty(dt, chains, groups, over, options.trim) @ to_clock.T
    return TimeOffsets(_spread(dt, groups), cov)


def grid(chains: Sequence[Chain], dt: Array, steps: int) -> Grid:
    """Equally spaced instants (VI-A1) over the time that all sensors cover. dt: (n,). Raises NotObservableError."""
    window = 2 * max(c.period for c in chains)
    start, end = common_span(chains, dt)
    if end - start <= 2 * window:
        raise NotObservableError(
            "the sensors' recordings hardly overlap in time; check their clocks, that they are of one drive, and "
            "that the part chosen is long enough"
        )
    return Grid(np.linspace(start, end - window, steps), window)


def without(offsets: TimeOffsets, unknown: NDArray[np.bool_]) -> TimeOffsets:
    """The same offsets with the unknown ones (n,) taken as zero, as the paper does before it knows any."""
    dt, cov = offsets.dt.copy(), offsets.cov.copy()
    dt[unknown], cov[unknown], cov[:, unknown] = 0.0, 0.0, 0.0
    return TimeOffsets(dt, cov)


def initialise(chains: Sequence[Chain], options: TimingOptions) -> Array:
    """Zero for all, as in the paper; or the lag at which each sensor's angular speed best matches the first's."""
    if options.start == "zero":
        return np.zeros(len(chains))
    return np.array([0.0, *(_lag(chains[0], c, options.max_offset) for c in chains[1:])])


def log_likelihood(dt: Array, chains: Sequence[Chain], grid: Grid, trim: float) -> float:
    """Equations (9) and (17): trimmed sum over all pairs that the angles of both are the same. dt: (n,)."""
    angle, variance = angles(chains, grid.stamps, grid.window, dt)
    total = 0.0
    for x, y in all_pairs(len(chains)):
        known = np.isfinite(angle[x] + angle[y])
        if not known.any():
            return -np.inf
        each = log_normal((angle[x] - angle[y])[known], (variance[x] + variance[y])[known])
        # the mean, since how many windows both cover depends on the offsets
        total += trimmed(each, trim)[0] / len(each) * grid.independent * len(grid.stamps)
    return total


def optimise(start: Array, chains: Sequence[Chain], groups: Array, grid: Grid, trim: float) -> Array:
    """The offsets of highest likelihood, one per clock that is not the base's. start: (q,)."""

    def likelihood(dt: Array) -> float:
        return log_likelihood(_spread(dt, groups), chains, grid, trim)

    # the start may be a reading off, which is many sigma: coarse, then fine
    near = maximise(likelihood, start, np.eye(start.size) * (min(c.period for c in chains) / 4) ** 2)
    return maximise(likelihood, near, uncertainty(near, chains, groups, grid, trim))


def uncertainty(dt: Array, chains: Sequence[Chain], groups: Array, grid: Grid, trim: float) -> Array:
    """Covariance (q, q) of the clocks' offsets: the larger of Cramer-Rao and the approximate delta method (VI-D1)."""
    full, nearby = _spread(dt, groups), grid.window / 8
    angle, variance = angles(chains, grid.stamps, grid.window, full)
    before, after = (angles(chains, grid.stamps + h, grid.window, full)[0] for h in (-nearby, nearby))
    slope = (after - before) / (2 * nearby)
    to_clock = _to_clock(groups)
    sums = delta.Sums.zero(dt.size, len(chains), len(grid.stamps))
    for x, y in all_pairs(len(chains)):
        known = np.isfinite(angle[x] + angle[y] + slope[x] + slope[y])
        error, spread2 = (angle[x] - angle[y])[known], (variance[x] + variance[y])[known]
        kept = np.flatnonzero(known)[trimmed(log_normal(error, spread2), trim)[1]]
        # a later clock shows an earlier angle: d angle(t - dt) / d dt = -slope
        J = -slope[x, kept, None] * to_clock[x] + slope[y, kept, None] * to_clock[y]
        weight = grid.independent / (variance[x, kept] + variance[y, kept])
        sums.add(kept, x, y, J[:, None, :], weight[:, None, None], np.ones((1, 1)), -np.ones((1, 1)))
    noise = variance[:, :, None, None] / grid.independent
    return delta.larger(sums.cramer_rao(), sums.approximate_delta(noise))


def _groups(clocks: Sequence[Hashable]) -> Array:
    """(n,) 0 for sensors on the first's clock, then 1, 2, ... in order of appearance."""
    order = list(dict.fromkeys(clocks))
    return np.array([order.index(c) for c in clocks], dtype=float)


def _first_of(groups: Array) -> NDArray[np.int64]:
    return np.array([np.flatnonzero(groups == g)[0] for g in range(1, int(groups.max()) + 1)], dtype=np.int64)


def _to_clock(groups: Array) -> Array:
    """(n, q) which of the offsets to be found each sensor's clock has."""
    return (groups[:, None] == np.arange(1, groups.max() + 1)).astype(float)


def _spread(dt: Array, groups: Array) -> Array:
    return np.concatenate([[0.0], dt])[groups.astype(int)]


def _lag(base: Chain, other: Chain, max_offset: float) -> float:
    """Offset of a clock by normalised cross-correlation of angular speeds, to a quarter of a reading."""
    tick = min(base.period, other.period) / 4
    signals, starts = zip(*(_speed(c, tick) for c in (base, other)), strict=True)
    a, b = (s - s.mean() for s in signals)
    score = correlate(a, b, method="fft")
    shift = np.arange(len(score)) - (len(b) - 1)
    dt = starts[0] - starts[1] + shift * tick
    if not a.any() or not b.any():
        return 0.0  # one of them never turned
    energy = correlate(a**2, np.ones(len(b)), method="fft") * correlate(np.ones(len(a)), b**2, method="fft")
    allowed = (np.abs(dt) <= max_offset) & (energy > 1e-3 * energy.max())
    if not allowed.any():
        raise NotObservableError(
            f"the sensors' recordings do not overlap in time to within {max_offset:g} s; check their clocks"
        )
    score = np.where(allowed, score / np.sqrt(np.maximum(energy, 1e-300)), -np.inf)
    return float(dt[np.argmax(score)])


def _speed(c: Chain, tick: float) -> tuple[Array, float]:
    stamps = np.arange(c.knots[0], c.knots[-1] - tick, tick)
    angle, _ = angles([c], stamps, tick)
    known = np.isfinite(angle[0])
    return np.where(known, angle[0], np.mean(angle[0], where=known)), float(stamps[0])
