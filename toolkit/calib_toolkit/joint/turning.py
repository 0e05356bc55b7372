"""How late each clock is and how each sensor is turned, from the rates of turn of all sensors at once.

The base's rate of turn is a latent signal whose second difference is white (a Gaussian process); every sensor sees
its integral over each of its own intervals, in its own axes and by its own clock. Rotations, offsets and skews
maximise the likelihood with the signal integrated out. How rough the signal is, and how noisy each sensor, is found
with them. Nothing is resampled, so nothing draws the stamps of two sensors together.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular

from calib_toolkit import se3, sync
from calib_toolkit.joint import noise, spread
from calib_toolkit.joint.arrow import Arrow, Solved
from calib_toolkit.joint.clocks import Clocks, Late
from calib_toolkit.joint.windows import Index, Windows, coning, hats
from calib_toolkit.types import Motions

Array = NDArray[np.float64]

SPACING = 0.035
"""Seconds between the knots of the signal."""
STENCIL = np.array([1.0, -2.0, 1.0])
SMOOTHEST = 1e-4
"""Least roughness of the signal, in variances of a reading's rate: a vehicle at rest would leave it none."""
ROUNDS = 30
CLOSE = 0.01
"""A step of so many sigma is the end; so is a change of scales by twice this share."""
TURN, LATE, SKEW = 0.5, 1.0, 1e-3
"""How far from its start, in radians, seconds and parts, something may end of which the drive tells nothing."""
MOST_LATE = 0.05
"""Seconds that a clock may move at once."""
SURE = 5.0
"""Sigma from which a clock is said to run at a speed of its own."""


@dataclass(frozen=True)
class Turning:
    """R_base_sensor: (n, 3, 3). clocks: offsets and skews.

    cov: (p, p) of the rotations (``delta``, base axes, 3 for each sensor but the base), then the offsets and then the
    skews of the clocks but the base's. feigned: (q-1,) share of what tells an offset that may be error of the signal.
    scale: (n,) of each sensor's stated variance. freedom: (n,) degrees of freedom
    it is told from. kept: (n) of (m,) readings that count. rounds: until all stood still.
    """

    R_base_sensor: Array
    clocks: Clocks
    cov: Array
    feigned: Array
    scale: Array
    freedom: Array
    kept: tuple[NDArray[np.bool_], ...]
    rounds: int

    @property
    def clock_cov(self) -> Array:
        """Offsets, then skews, of the clocks but the base's, (2(q-1), 2(q-1))."""
        k = 3 * (len(self.R_base_sensor) - 1)
        return self.cov[k:, k:]


def estimate(motions: Sequence[Motions], R: Array, clocks: Clocks, known: Sequence[Late] = ()) -> Turning:
    """From a start that is right to a reading or so. motions: (n) in order of time. R: (n, 3, 3).

    A clock gets a skew where the drive shows that it has one.
    """
    search = _Search(motions, R, clocks, known)
    turns, others = 3 * (len(motions) - 1), len(clocks) - 1
    free = np.arange(search.parameters) < search.parameters - others
    rounds, solved, correction = search.maximise(free)
    step, cov = _step(solved, correction, np.ones_like(free))
    own = ~free & (np.abs(step) > SURE * np.sqrt(np.diag(cov)))
    if own.any():
        rounds, solved, correction = search.maximise(free | own)
    _, cov = _step(solved, correction, free | own)
    stamps = [search.clocks.base_time(i, m.start) for i, m in enumerate(motions)]
    # each rotation is one thing, and so is each clock
    groups = [*np.split(np.arange(turns), turns // 3), *(turns + np.array([[c, others + c] for c in range(others)]))]
    wider = np.sqrt(spread.inflation(search.pulls(solved), stamps, cov, cov, groups))
    cov = cov * np.outer(wider, wider)
    kept = tuple(w > 0 for w in search.weights)
    freedom = noise.freedoms(search.readings, search.kept)
    return Turning(search.R, search.clocks, cov, search.feigned(solved), search.scale, freedom, kept, rounds)


def alone(m: Motions) -> float:
    """How many times its stated variance a sensor's turns jitter, beside a signal that only they tell."""
    search = _Search([m], np.eye(3)[None], Clocks.starting([0], np.zeros(1), 0.0), ())
    search.maximise(np.zeros(0, dtype=bool))
    return float(search.scale[0])


class _Search:
    """Rounds of Gauss-Newton. R, clocks, rates (K, 3) of turn, roughness (3,), scale and weights as they stand."""

    def __init__(self, motions: Sequence[Motions], R: Array, clocks: Clocks, known: Sequence[Late]) -> None:
        n = len(motions)
        self.motions, self.R, self.known, self.scale = motions, R.copy(), known, np.ones(n)
        self.start = self.clocks = clocks
        self.R_start = R
        self.parameters = 3 * (n - 1) + 2 * (len(clocks) - 1)
        ends = [(clocks.base_time(i, m.start).min(), clocks.base_time(i, m.end).max()) for i, m in enumerate(motions)]
        self.first, last = min(a for a, _ in ends) - 10 * SPACING, max(b for _, b in ends) + 10 * SPACING
        knots = np.arange(self.first, last + SPACING, SPACING)
        self.base = sync.chain(motions[0])
        within = np.clip(knots, self.base.knots[0], self.base.knots[-1] - 1e-9)
        self.rates = self.base.turned.derivative()(within)
        noise_of_rate = (
            min(float(np.median(np.trace(m.cov[:, 3:, 3:], axis1=1, axis2=2))) for m in motions) / SPACING**2
        )
        self.smoothest = SMOOTHEST * noise_of_rate
        self.rough = 0.3 * np.cov(np.diff(self.rates, 2, axis=0).T) + self.smoothest * np.eye(3)
        self.weights = [np.ones(len(m)) for m in motions]
        self.readings: list[noise.Readings] = []
        self.kept: list[NDArray[np.bool_]] = []

    def maximise(self, free: NDArray[np.bool_]) -> tuple[int, Solved, Array]:
        """Rounds until nothing moves, the last equations, and the correction of their gradient. free: (p,)."""
        for round_ in range(ROUNDS):
            seen = [self.seen(i) for i in range(len(self.motions))]
            solved = self.equations(seen).solved()
            correction = self.correction(solved, seen)
            step, cov = _step(solved, correction, free)
            self.move(step, solved)
            change = self.judge(round_, solved, seen, step)
            still = np.max(np.abs(step[free]) / np.sqrt(np.diag(cov)[free]), initial=0.0) < CLOSE
            if round_ > noise.SETTLING and still and np.max(np.abs(np.log(change))) < 2 * CLOSE:
                break
        return round_ + 1, solved, correction

    def seen(self, i: int) -> "_Seen":
        """Sensor i's readings against the signal, rotation and clock as they stand."""
        m = self.motions[i]
        a, b = self.clocks.base_time(i, m.start), self.clocks.base_time(i, m.end)
        windows = hats(self.first, SPACING, len(self.rates), a, b)
        turned = windows.of(self.rates) + coning(self.base, a, b)[:, 3:]
        later = windows.of(self.rates, windows.rate)
        parts, columns = [], np.zeros(0, dtype=np.int64)
        if i:
            parts, columns = [self.R[i].T @ se3.skew(turned)], np.arange(3 * (i - 1), 3 * i)
        since = (m.start + m.end) / 2 - self.clocks.t_ref
        if c := int(self.clocks.of[i]):
            by_late = (later @ self.R[i])[:, :, None]
            parts += [by_late, by_late * since[:, None, None]]
            columns = np.append(columns, self.clock_columns(c))
        return _Seen(
            windows,
            m.vec[:, 3:] - turned @ self.R[i],
            np.linalg.inv(m.cov[:, 3:, 3:] * self.scale[i]),
            self.weights[i],
            np.concatenate([*parts, np.zeros((len(m), 3, 0))], axis=2),
            columns,
            since,
        )

    def equations(self, seen: Sequence["_Seen"]) -> Arrow:
        """Of all readings, the signal's smoothness, and what is known beforehand."""
        turns, others = 3 * (len(self.motions) - 1), len(self.clocks) - 1
        reach = max(len(STENCIL), *(s.windows.weights.shape[1] for s in seen))
        arrow = Arrow(len(self.rates), 3, reach, self.parameters)
        for R, s in zip(self.R, seen, strict=True):
            weight = s.weight * s.counted[:, None, None]
            by_rate = np.broadcast_to(R.T, weight.shape)
            arrow.add(s.windows, by_rate, weight, s.residual)
            arrow.add_parameters(s.columns, s.by_parameter, s.windows, by_rate, weight, s.residual)
        arrow.add_prior(STENCIL, self.rates, np.asarray(np.linalg.inv(self.rough), dtype=np.float64))
        arrow.hold(0, 1e-9)
        arrow.hold(len(self.rates) - 1, 1e-9)
        wide = 1 / np.repeat([TURN, LATE, SKEW], [turns, others, others]) ** 2
        arrow.information += np.diag(wide)
        arrow.gradient -= wide * self.gone()
        for k in self.known:
            column = self.clock_columns(k.clock)[0]
            arrow.information[column, column] += 1 / k.sigma**2
            arrow.gradient[column] += (k.dt - self.clocks.dt[k.clock]) / k.sigma**2
        return arrow

    def correction(self, solved: Solved, seen: Sequence["_Seen"]) -> Array:
        """(p,) what the fitted signal pulls at the clocks and the likelihood with it integrated out does not.

        A signal is fitted best where that costs least, which depends on how the sensors' stamps lie to each other.
        """
        return self.by_clock(seen, lambda w: solved.covariance(w, w.rate))

    def feigned(self, solved: Solved) -> Array:
        """(q-1,) share of the information on each clock's offset that the error of the signal would make alone."""
        error = self.by_clock(
            map(self.seen, range(len(self.motions))), lambda w: solved.covariance(replace(w, weights=w.rate))
        )
        columns = [self.clock_columns(c)[0] for c in range(1, len(self.clocks))]
        return np.asarray(error[columns] / np.diag(solved.information)[columns])

    def by_clock(self, seen: Iterable["_Seen"], covariance: Callable[[Windows], Array]) -> Array:
        """(p,) at the clocks' places: traces of (m, 3, 3) covariances by the readings' weights, added up."""
        total = np.zeros(self.parameters)
        for i, s in enumerate(seen):
            if c := int(self.clocks.of[i]):
                weight = se3.rotate_cov(self.R[i], s.weight * s.counted[:, None, None])
                each = np.einsum("nij,nji->n", weight, covariance(s.windows))
                total[self.clock_columns(c)] += [each.sum(), each @ s.since]
        return total

    def judge(self, round_: int, solved: Solved, seen: Sequence["_Seen"], step: Array) -> Array:
        """Bring weights, scales and the signal's roughness up to date; (n,) by what the scales were wrong."""
        moved = solved.latents(step)
        self.readings = []
        for R, s in zip(self.R, seen, strict=True):
            left = s.residual - s.windows.of(moved) @ R - s.by_parameter @ step[s.columns]
            squared = np.einsum("ni,nij,nj->n", left, s.weight, left)
            share = np.einsum("nij,nji->n", se3.rotate_cov(R, s.weight), solved.covariance(s.windows))
            expected = noise.expected(3, share, s.counted)
            self.readings.append(noise.Readings(squared, expected, 3, np.ones(len(squared), dtype=bool)))
        before = self.weights
        self.weights = [noise.weights(r, round_, w) for r, w in zip(self.readings, before, strict=True)]
        self.kept = [(a > 0) & (b > 0) for a, b in zip(before, self.weights, strict=True)]
        change = noise.ratios(self.readings, self.kept, round_, self.scale)
        self.scale = self.scale * noise.damped(change, round_)
        self.rough = self.rougher(solved)
        return change

    def pulls(self, solved: Solved) -> list[Array]:
        """(n) of (m, p) each reading's part of the gradient, the signal following."""
        found = []
        for i, R in enumerate(self.R):
            s = self.seen(i)
            by_parameter = -np.swapaxes(R[None], 1, 2) @ s.windows.of(solved.response)
            by_parameter[:, :, s.columns] += s.by_parameter
            weight = s.weight * s.counted[:, None, None]
            found.append(np.einsum("ndp,nde,ne->np", by_parameter, weight, s.residual))
        return found

    def rougher(self, solved: Solved) -> Array:
        """(3, 3) the covariance that the signal's second differences show, less what of them is not known.

        A full one: whatever axes the base has, its turns about them go together.
        """
        k = np.arange(len(self.rates) - len(STENCIL) + 1)
        stencils = np.broadcast_to(STENCIL, (len(k), len(STENCIL)))
        second = np.diff(self.rates, 2, axis=0)
        L = np.linalg.cholesky(self.rough)
        seen, unknown = (
            solve_triangular(L, solve_triangular(L, M, lower=True).T, lower=True)
            for M in (second.T @ second, solved.covariance(Windows(k, stencils, stencils)).sum(axis=0))
        )
        known, axes = np.linalg.eigh(len(k) * np.eye(3) - unknown)
        whiten = axes * np.maximum(known, 1.0) ** -0.5 @ axes.T
        ratio, axes = np.linalg.eigh(whiten @ seen @ whiten)
        rough = L @ (axes * np.clip(ratio, 0.2, 5.0)) @ axes.T @ L.T
        return np.asarray(rough + self.smoothest * np.eye(3))

    def move(self, step: Array, solved: Solved) -> None:
        """By a step of the parameters, and the signal with it."""
        turns, others = 3 * (len(self.motions) - 1), len(self.clocks) - 1
        self.rates = self.rates + solved.latents(step)
        self.R[1:] = se3.exp_so3(step[:turns].reshape(-1, 3)) @ self.R[1:]
        late, skew = np.clip(step[turns : turns + others], -MOST_LATE, MOST_LATE), step[turns + others :]
        self.clocks = self.clocks.moved(np.append(0.0, late), np.append(0.0, skew)).within(self.start, LATE)

    def gone(self) -> Array:
        """(p,) how far the parameters are from where they started."""
        turned = se3.log_so3(self.R[1:] @ np.swapaxes(self.R_start[1:], 1, 2)).ravel()
        return np.concatenate([turned, self.clocks.dt[1:] - self.start.dt[1:], self.clocks.skew[1:]])

    def clock_columns(self, clock: int) -> list[int]:
        """Where a clock's offset and skew are among the parameters."""
        turns, others = 3 * (len(self.motions) - 1), len(self.clocks) - 1
        return [turns + clock - 1, turns + others + clock - 1]


@dataclass(frozen=True)
class _Seen:
    """One sensor's readings in one round.

    residual: (m, 3), weight: (m, 3, 3) in the sensor's axes. counted: (m,) how much each counts. by_parameter:
    (m, 3, q) for columns (q,). since: (m,) seconds from the instant that skews are about.
    """

    windows: Windows
    residual: Array
    weight: Array
    counted: Array
    by_parameter: Array
    columns: Index
    since: Array


def _step(solved: Solved, correction: Array, free: NDArray[np.bool_]) -> tuple[Array, Array]:
    """The next step (p,) and the covariance (p, p) of the parameters that are free; zero for the others."""
    p = len(free)
    step, cov = np.zeros(p), np.zeros((p, p))
    if free.any():
        inside = np.ix_(free, free)
        cov[inside] = np.linalg.inv(solved.information[inside])
        step[free] = cov[inside] @ (solved.gradient - correction)[free]
    return step, cov
