"""Where each sensor sits, from all readings of all sensors at once, the base's motion being latent.

The base's summed twist is a cubic spline with one knot a reading; each sensor reads the motion over each of its own
intervals through its own pose. Nothing but the readings holds the motion back, since a prior on it would take a part
of what they say of heights. What noise alone would feign to be motion is told beside the information.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from calib_toolkit import se3, sync
from calib_toolkit.joint import noise, turning
from calib_toolkit.joint.arrow import Arrow, Solved
from calib_toolkit.joint.clocks import Clocks
from calib_toolkit.joint.model import Linear, linear, read
from calib_toolkit.joint.readings import WIDENED, travel
from calib_toolkit.joint.windows import Index, Windows, coning, splines
from calib_toolkit.types import Motions

Array = NDArray[np.float64]
Prior = Callable[[Array, Array], tuple[Array, Array]]
"""Of poses (n, 4, 4) and biases (n, 3): the information (9(n-1), 9(n-1)) of what was known and its gradient."""

STENCIL = np.array([-1.0, 3.0, -3.0, 1.0])
LOOSE = 100.0
"""The signal's third differences may vary by so many times what they do: felt in gaps only."""
SLIGHT = 1e-9
"""Least weight of that, in weights of a reading: arithmetic needs some."""
LEAST_TRAVEL = 6.0
"""Sigma of a base's reading that the base must travel for the direction of a sensor without scale to count."""
NOTHING, ANY = 1e6, 2.0
"""Variance given to a direction that does not count, and that from which one does not: it may be any."""
AROUND = 1.0
"""Seconds over which that travel is told: a single reading would choose itself by its noise."""
FAR = 30.0
"""Metres or radians: what the drive tells nothing of is no further from where it started."""
ROUNDS = 30
LEAST_SCALE = 0.1  # of the first stage's scale of turns: readings without any noise would have no end
CLOSE = 0.01
DRAWS = 2
"""Of the motion's error, to tell what noise feigns."""


@dataclass(frozen=True)
class Moving:
    """T_base_sensor: (n, 4, 4). bias: (n, 3) radians, base axes: a sensor's travel is turned so against its turns.
    rounds: until all stood still.

    Parameters are ``(dt, delta)`` of each sensor but the base, then the bias of each, base axes: 9(n-1) in all.
    information: of these; feigned: the part of it that is made of noise. by_clock: (9(n-1), 2(q-1)), shared with the
    offsets and skews of the clocks. free: (9(n-1), k) orthonormal directions that were searched. scale: (n,) of each
    sensor's stated variance of shifts. freedom: (n,) degrees of freedom it is told from. together: sensors for which
    only the sum of theirs is told. rejected: (n,) share of readings. pulls: by sensor, each reading's part of the
    gradient (m, 9(n-1)).
    """

    T_base_sensor: Array
    bias: Array
    rounds: int
    information: Array
    feigned: Array
    by_clock: Array
    free: Array
    scale: Array
    freedom: Array
    together: tuple[int, ...]
    rejected: Array
    pulls: tuple[Array, ...]


def estimate(
    motions: Sequence[Motions], T: Array, clocks: Clocks, turn_scale: Array, free: Array, prior: Prior
) -> Moving:
    """From a start right to a few degrees. motions: (n) in order of time. T: (n, 4, 4). turn_scale: (n,).

    free: (9(n-1), k) orthonormal directions in which poses and biases may move.
    """
    search = _Search(motions, T, clocks, turn_scale, free, prior)
    rounds, solved, seen = search.maximise()
    poses = len(free)
    return Moving(
        search.T,
        search.bias,
        rounds,
        solved.information[:poses, :poses],
        search.feigned(solved, seen)[:poses, :poses],
        solved.information[:poses, poses:],
        free,
        search.scale,
        noise.freedoms(search.shifts, search.kept),
        tuple(search.together),
        np.array([np.mean(w == 0) for w in search.weights]),
        tuple(_pulls(s, solved, poses) for s in seen),
    )


@dataclass(frozen=True)
class _Seen:
    """One sensor's readings in one round. weight: (m, d, d) of those that count, by_parameter: (m, d, q) for
    columns (q,).
    """

    windows: Windows
    twist: Array
    reading: Linear
    weight: Array
    by_parameter: Array
    columns: Index


class _Search:
    """Rounds of Gauss-Newton: T, the spline's coefficients (K, 6), scale and weights as they stand."""

    def __init__(
        self, motions: Sequence[Motions], T: Array, clocks: Clocks, turn_scale: Array, free: Array, prior: Prior
    ) -> None:
        n = len(motions)
        self.motions, self.T, self.clocks = motions, T.copy(), clocks
        self.turn_scale = self.first_turn_scale = turn_scale
        self.free, self.prior, self.bias = free, prior, np.zeros((n, 3))
        # of two sensors' distances only the sum of the noise shows; how it divides, each one's own jitter tells
        self.together = [i for i, m in enumerate(motions) if m.has_scale]
        if len(self.together) > 2:
            self.together = []
        self.scale = np.array(
            [turning.alone(travel(m)) if i in self.together else 1.0 for i, m in enumerate(motions)]
        )
        spans = [(clocks.base_time(i, m.start), clocks.base_time(i, m.end)) for i, m in enumerate(motions)]
        base = sync.chain(motions[0])
        breaks = _breaks(base, min(a.min() for a, _ in spans), max(b.max() for _, b in spans))
        knots = np.concatenate([np.repeat(breaks[0], 3), breaks, np.repeat(breaks[-1], 3)])
        self.windows = [splines(knots, a, b) for a, b in spans]
        self.more = [coning(base, a, b) for a, b in spans]
        self.reach = max(len(STENCIL), *(w.weights.shape[1] for w in self.windows))
        middles = np.clip((knots[1:-3] + knots[2:-2] + knots[3:-1]) / 3, base.knots[0], base.knots[-1] - 1e-9)
        self.twists = base.summed(middles)
        least = SLIGHT / np.median(np.einsum("nii->ni", motions[0].cov), axis=0)
        self.hold = np.maximum(1 / (LOOSE * np.var(np.diff(self.twists, 3, axis=0), axis=0) + 1e-12), least)
        sigma = np.sqrt(np.median(np.trace(motions[0].cov[:, :3, :3], axis1=1, axis2=2)) / 3 / WIDENED)
        self.far = [
            m.has_scale | ((_travel(base, a, b) > LEAST_TRAVEL * sigma) & (np.trace(m.cov[:, :3, :3].T) < ANY))
            for m, (a, b) in zip(motions, spans, strict=True)
        ]
        self.weights = [np.ones(len(m)) for m in motions]
        self.shifts: list[noise.Readings] = []
        self.kept: list[NDArray[np.bool_]] = []

    def maximise(self) -> tuple[int, Solved, list[_Seen]]:
        """Rounds until nothing moves, and the last equations."""
        for round_ in range(ROUNDS):
            seen = [self.seen(i) for i in range(len(self.motions))]
            solved = self.equations(seen).solved()
            step, sigma = self.step(solved)
            self.move(step, solved)
            change = self.judge(round_, solved, seen, step)
            still = np.max(np.abs(self.free.T @ step[: len(self.free)]) / sigma, initial=0.0) < CLOSE
            if round_ > noise.SETTLING and still and np.max(np.abs(np.log(change))) < 2 * CLOSE:
                break
        return round_ + 1, solved, seen

    def equations(self, seen: Sequence[_Seen]) -> Arrow:
        """Of all readings and of what was measured beforehand."""
        arrow = self.arrow()
        for s in seen:
            r = s.reading
            arrow.add(s.windows, r.by_twist, s.weight, r.residual)
            arrow.add_parameters(s.columns, s.by_parameter, s.windows, r.by_twist, s.weight, r.residual)
        information, pull = self.prior(self.T, self.bias)
        known, poses = np.arange(len(pull)), np.arange(6 * (len(self.T) - 1))
        arrow.information[np.ix_(known, known)] += information
        arrow.information[poses, poses] += 1 / FAR**2
        arrow.gradient[known] += pull
        arrow.add_prior(STENCIL, self.twists, np.diag(self.hold))
        arrow.hold(0, 1e6)
        return arrow

    def judge(self, round_: int, solved: Solved, seen: Sequence[_Seen], step: Array) -> Array:
        """Bring weights and scales up to date; (n,) by what the scales were wrong."""
        moved, whole, turns = solved.latents(step), [], []
        self.shifts = []
        for s, counted, far in zip(seen, self.weights, self.far, strict=True):
            r = s.reading
            left = (
                r.residual - (r.by_twist @ s.windows.of(moved)[:, :, None])[..., 0] - s.by_parameter @ step[s.columns]
            )
            fitted = r.by_twist @ solved.covariance(s.windows) @ np.swapaxes(r.by_twist, 1, 2)
            d = left.shape[1]
            whole.append(_readings(r, left, fitted, counted, slice(d)))
            turns.append(_readings(r, left, fitted, counted, slice(d - 3, d)))
            shifts = _readings(r, left, fitted, counted, slice(d - 3))
            self.shifts.append(replace(shifts, usable=shifts.usable & far))
        before = self.weights
        self.weights = [noise.weights(r, round_, w) for r, w in zip(whole, before, strict=True)]
        self.kept = [(a > 0) & (b > 0) & s.usable for a, b, s in zip(before, self.weights, self.shifts, strict=True)]
        change = noise.ratios(self.shifts, self.kept, round_, self.scale, self.together)
        self.scale = self.scale * noise.damped(change, round_)
        # one cubic a reading leaves more of the turns to noise than the first stage did
        scale = self.turn_scale * noise.damped(noise.ratios(turns, self.kept, round_, self.turn_scale), round_)
        self.turn_scale = np.maximum(scale, LEAST_SCALE * self.first_turn_scale)
        return change

    def move(self, step: Array, solved: Solved) -> None:
        """By a step of the parameters, and the motion with it."""
        self.twists = self.twists + solved.latents(step)
        poses, biases = np.split(step[: len(self.free)], [6 * (len(self.T) - 1)])
        poses = poses.reshape(-1, 6)
        self.bias[1:] += biases.reshape(-1, 3)
        self.T[1:, :3, 3] += poses[:, :3]
        self.T[1:, :3, :3] = se3.exp_so3(poses[:, 3:]) @ self.T[1:, :3, :3]

    def arrow(self) -> Arrow:
        """No readings yet."""
        return Arrow(len(self.twists), 6, self.reach, len(self.free) + 2 * (len(self.clocks) - 1))

    def seen(self, i: int) -> _Seen:
        """Sensor i's readings against the motion and its pose as they stand."""
        m, windows = self.motions[i], self.windows[i]
        twist = windows.of(self.twists) + self.more[i]
        spread = np.sqrt(np.repeat([self.scale[i], self.turn_scale[i]], 3))
        cov = m.cov * spread[:, None] * spread
        reading = linear(self.T[i], self.bias[i], twist, m.vec, cov, m.has_scale)
        reading.cov[~self.far[i], :2, :2] += NOTHING * np.eye(2)
        weight = np.linalg.inv(reading.cov) * (self.weights[i] * reading.usable)[:, None, None]
        parts, columns = [], np.zeros(0, dtype=np.int64)
        if i:
            parts, columns = [reading.by_sensor], self.columns(i)
        if c := int(self.clocks.of[i]):
            later = reading.by_twist @ windows.of(self.twists, windows.rate)[:, :, None]
            since = (m.start + m.end) / 2 - self.clocks.t_ref
            parts += [later, later * since[:, None, None]]
            first = len(self.free) + c - 1
            columns = np.append(columns, [first, first + len(self.clocks) - 1])
        by_parameter = np.concatenate(parts, axis=2) if parts else np.zeros((*reading.residual.shape, 0))
        return _Seen(windows, twist, reading, weight, by_parameter, columns)

    def step(self, solved: Solved) -> tuple[Array, Array]:
        """Of all parameters, the clocks standing still, and the sigma (k,) along each direction that is free."""
        poses = len(self.free)
        step = np.zeros(len(solved.gradient))
        inside = self.free.T @ solved.information[:poses, :poses] @ self.free
        step[:poses] = self.free @ np.linalg.solve(inside, self.free.T @ solved.gradient[:poses])
        return step, np.sqrt(np.diag(np.linalg.inv(inside)))

    def columns(self, i: int) -> Index:
        """Where a sensor's pose and bias are among the parameters."""
        biases = 6 * (len(self.T) - 1)
        return np.append(np.arange(6 * (i - 1), 6 * i), biases + np.arange(3 * (i - 1), 3 * i))

    def feigned(self, solved: Solved, seen: Sequence[_Seen]) -> Array:
        """(p, p) the information that would be found if there were only the error of the motion, and no motion."""
        rng = np.random.default_rng(0)
        total = np.zeros_like(solved.information)
        for _ in range(DRAWS):
            error, arrow = solved.sample(rng), self.arrow()
            for i, s in enumerate(seen[1:], start=1):
                r, there = s.reading, s.twist + s.windows.of(error)
                by_error = read(self.T[i], self.bias[i], there)[2] - read(self.T[i], self.bias[i], s.twist)[2]
                arrow.add_parameters(self.columns(i), r.shown @ by_error, s.windows, r.by_twist, s.weight, r.residual)
            total = total + solved.schur(arrow) / DRAWS
        return total


def _breaks(base: sync.Chain, first: float, last: float) -> Array:
    """Instants between which the motion is one cubic: the base's stamps, and as far apart where it has none."""
    knots, period = base.knots, base.period
    before = np.arange(knots[0] - period, first - period, -period)[::-1]
    after = np.arange(knots[-1] + period, last + period, period)
    inside = [np.linspace(a, b, max(round((b - a) / period), 1) + 1)[1:] for a, b in pairwise(knots)]
    return np.concatenate([before, knots[:1], *inside, after])


def _travel(base: sync.Chain, start: Array, end: Array) -> Array:
    """(m,) metres that the base goes in so long a time around each interval."""
    middle = np.clip((start + end) / 2, base.knots[0] + AROUND / 2, base.knots[-1] - AROUND / 2)
    shift = base.summed(middle + AROUND / 2) - base.summed(middle - AROUND / 2)
    return np.asarray(np.linalg.norm(shift[:, :3], axis=1) / AROUND * (end - start))


def _readings(reading: Linear, left: Array, fitted: Array, counted: Array, part: slice) -> noise.Readings:
    """Of some numbers of what is left (m, d). fitted: (m, d, d) covariance of what is explained."""
    weight = np.linalg.inv(reading.cov[:, part, part])
    squared = np.einsum("ni,nij,nj->n", left[:, part], weight, left[:, part])
    share = np.einsum("nij,nji->n", weight, fitted[:, part, part])
    size = weight.shape[1]
    return noise.Readings(squared, noise.expected(size, share, counted), size, reading.usable)


def _pulls(s: _Seen, solved: Solved, poses: int) -> Array:
    """(m, poses) each reading's part of the gradient, the motion following."""
    by_parameter = -s.reading.by_twist @ s.windows.of(solved.response[:, :, :poses])
    own = s.columns < poses
    by_parameter[:, :, s.columns[own]] += s.by_parameter[:, :, own]
    return np.einsum("ndp,nde,ne->np", by_parameter, s.weight, s.reading.residual)
