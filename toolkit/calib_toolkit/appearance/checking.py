"""Whether a calibration from any source could be better: every metric's look at it, and at poses a little beside it.

Each pair that sees the same place is compared at moments of the drive that a run would not choose. A step along one
axis counts as better where the costs of the moments are lower by ``CLEAR`` standard errors (paired differences). How
far to go is what a search around the given pose finds (see :mod:`~calib_toolkit.appearance.search`); of that way,
along all axes together, a part may be clearly better where no axis alone is. An axis
of it that is ``CLEAR`` of its own sigmas long counts by itself.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from typing import Any

import joblib
import numpy as np
from numpy.typing import NDArray

from calib_toolkit import se3
from calib_toolkit.appearance.pairs import Comparison, Moved, comparisons, select
from calib_toolkit.appearance.refinement import chosen, options
from calib_toolkit.appearance.search import CLEAR, FEWEST, LEAST, SHARPEST, Frame, estimate, focused, prepared
from calib_toolkit.config import Config
from calib_toolkit.errors import CalibrationError
from calib_toolkit.hookspecs import CostMetric
from calib_toolkit.plugins import Registry
from calib_toolkit.progress import Progress
from calib_toolkit.types import Calibration, Log, Pair, Transform

Array = NDArray[np.float64]

TASK = "check"
STEPS = np.array([-1.0, -0.5, -0.2, 0.2, 0.5, 1.0])[:, None] * np.array([0.1] * 3 + [np.radians(0.5)] * 3)
"""(s, 6) metres, radians: how far a pose is moved along each axis."""
BEYOND = 3.0
"""Times what a metric is off on any drive: of longer steps more than half is beyond that."""
SHOWN = np.array([0.05] * 3 + [np.radians(0.25)] * 3)
"""Sigma up to which a metric shows an axis: the longest step is two of them."""
AROUND = np.array([0.1] * 3 + [np.radians(1.0)] * 3)
"""Sigma of the search around the given pose."""
PARTS = np.array([0.2, 0.5, 1.0])
"""Of the way to the pose that is found. A small part is told best from none: its noise is small."""
TOLD = 2.0
"""Sigmas of the whole move from which one axis of it is told apart from the others."""
APART = 2.5
"""The same where no step along that axis alone is better: the way was chosen to fit these very moments."""
MORE = 5
"""Times as many moments as a run looks at are drawn, of which those that it would choose are left out: a small move
is told from none only by many."""


@dataclass(frozen=True)
class Look:
    """One metric's look at ``T_a_b`` as it was given. Moves are ``(dt, delta)`` in axes of a, metres and radians.

    costs, gain: (s, 6) of the ``STEPS``, the mean cost and by how many standard errors it is lower than ``cost``,
    that of the given pose; nan for a metric that only says what it finds. move, cov: (6,) and (6, 6) to the pose it
    finds, all axes together; nan if it finds none, for the reason in ``note``. on_the_way: (p,)
    gain of the ``PARTS`` of the move. own: (6,) by which the metric is off on any drive. held_out: no run would
    choose its moments.
    """

    metric: str
    a: str
    b: str
    moments: int
    held_out: bool
    cost: float
    costs: Array
    gain: Array
    on_the_way: Array
    move: Array
    cov: Array
    own: Array
    note: str = ""

    @property
    def found(self) -> bool:
        """Whether it found a pose."""
        return bool(np.isfinite(self.move).all())

    @property
    def sigma(self) -> Array:
        """(6,) of the move."""
        return np.sqrt(np.diag(self.cov))

    @property
    def shown(self) -> NDArray[np.bool_]:
        """(6,) along which axes it would see a fault."""
        return self.sigma < SHOWN

    @property
    def favours(self) -> Array:
        """(6,) standard errors by which a move along each axis is better, negative for one backwards; zero if no such
        move is clearly better."""
        trusted = np.abs(STEPS) >= BEYOND * self.own
        gain = np.where(trusted & np.isfinite(self.gain), self.gain, 0.0)
        best = np.argmax(gain, axis=0), np.arange(6)
        by_step = np.where(gain[best] > CLEAR, np.sign(STEPS[best]) * gain[best], 0.0)
        times = np.nan_to_num(self.move / self.sigma)
        way = float(np.max(np.nan_to_num(self.on_the_way)))
        by_way = np.where((np.abs(times) > APART) & (way > CLEAR), np.sign(times) * way, 0.0)
        by_move = np.where(np.abs(times) > CLEAR, times, 0.0)
        return np.asarray(np.where(by_step != 0.0, by_step, np.where(by_way != 0.0, by_way, by_move)))


@dataclass(frozen=True)
class Judgement:
    """What all looks at one pair say together.

    better: (6,) 1 or -1 along axes where a move would fit better, by most of the metrics that show the axis.
    disputed: (6,) where the sharpest metric says so and most others do not. shown: (6,) where any would see a fault.
    """

    looks: tuple[Look, ...]
    better: NDArray[np.int64]
    disputed: NDArray[np.bool_]
    shown: NDArray[np.bool_]

    @property
    def a(self) -> str:
        """Sensor whose axes moves are given in."""
        return self.looks[0].a

    @property
    def b(self) -> str:
        """Sensor that is moved."""
        return self.looks[0].b

    @property
    def lead(self) -> Look | None:
        """The look that shows most; None if none found a pose."""
        return _sharpest(self.looks)

    @property
    def told(self) -> NDArray[np.bool_]:
        """(6,) of the axes that are ``better``, those that the whole move tells apart from the others."""
        lead = self.lead
        if lead is None:
            return np.zeros(6, dtype=bool)
        return np.asarray((self.better * lead.move > TOLD * lead.sigma) & (self.better != 0))


@dataclass(frozen=True)
class Check:
    """A calibration as the drive sees it. alone: sensors that could not be compared with any other. open_: sensors of
    which no chain of pairs, each shown along all axes, leads to the first sensor."""

    judgements: tuple[Judgement, ...]
    alone: tuple[str, ...]
    open_: tuple[str, ...]

    @property
    def fine(self) -> bool:
        """Whether everything could be judged and nothing better was found."""
        found = any(np.any(j.better != 0) or j.disputed.any() for j in self.judgements)
        return not self.open_ and not found


def check(
    log: Log,
    motion: Mapping[str, Moved],
    calibration: Calibration,
    config: Config,
    plugins: Registry,
    progress: Progress,
) -> Check:
    """What every metric in ``config.appearance`` says of a calibration whose sensors the log all has.

    motion: of each sensor, on its own stamps. Of the calibration poses and clocks are read, and how well clocks are
    known; of poses that does not matter. Raises ConfigError on a metric that does not exist.
    """
    metrics = chosen(config, plugins)
    found = comparisons(log, motion, searched(calibration), metrics, config.moments, config.seed)
    progress.begin(TASK, len(found))
    looks = []
    pool = joblib.Parallel(n_jobs=max(min(config.jobs, len(found)), 1), return_as="generator")
    for look in pool(joblib.delayed(_look)(c, calibration, config) for c in found):
        looks.append(look)
        progress.advance(TASK, 1)
    judgements = tuple(judge(tuple(pair)) for _, pair in groupby(looks, key=lambda look: (look.a, look.b)))
    compared = {name for j in judgements for name in (j.a, j.b)}
    linked = set(_linked(calibration.names[0], judgements))
    return Check(
        judgements,
        tuple(n for n in calibration.names if n not in compared),
        tuple(n for n in calibration.names if n not in linked),
    )


def searched(calibration: Calibration) -> Calibration:
    """The calibration with ``AROUND`` as sigma of every sensor but the first, whatever it says of itself."""
    n = len(calibration.names)
    sigma = np.zeros((n, 7))
    sigma[1:, :6] = AROUND
    return replace(calibration, covariance=np.diag(sigma.ravel() ** 2))


def judge(looks: tuple[Look, ...]) -> Judgement:
    """One verdict of all looks at a pair."""
    favours, shown = np.array([look.favours for look in looks]), np.array([look.shown for look in looks])
    voting = (shown | (favours != 0)).sum(axis=0)
    votes = np.sign(favours).sum(axis=0).astype(int)
    better = np.where(2 * np.abs(votes) > voting, np.sign(votes), 0)
    lead = _sharpest(looks)
    wanted = np.zeros(6) if lead is None else lead.favours
    disputed: NDArray[np.bool_] = np.logical_and(better == 0, wanted != 0)
    return Judgement(looks, better, disputed, np.asarray(shown.any(axis=0)))


def _look(comparison: Comparison, calibration: Calibration, config: Config) -> Look:
    metric = comparison.metric
    pair, held_out = _held_out(comparison.pair, config)
    pair = replace(pair, prior=replace(pair.prior, cov=np.diag(AROUND**2)))
    steps, parts, one = (np.full(shape, np.nan) for shape in (STEPS.shape, PARTS.shape, (6, 6)))
    own = np.array(metric.own) if isinstance(metric, CostMetric) else np.zeros(6)
    look = Look(
        metric.id, pair.a.name, pair.b.name, len(pair), held_out, np.nan, steps, steps, parts, one[0], one, own
    )
    values = options(metric, config)
    try:
        moments = prepared(metric, pair, values) if isinstance(metric, CostMetric) else []
        found = estimate(metric, pair, values, config.seed, moments)
        if found.converged:
            move, cov = _move(pair.prior.T_a_b, found.transform)
            late = calibration.dt_between(look.a, look.b)[1] * found.by_clock
            look = replace(look, move=move, cov=cov + np.outer(late, late))
        look = replace(look, note=found.note)
        return _stepped(look, metric, moments, pair.prior) if isinstance(metric, CostMetric) else look
    except CalibrationError as e:
        return replace(look, note=str(e))


def _held_out(pair: Pair, config: Config) -> tuple[Pair, bool]:
    """The pair with other readings than it has, spread over the drive; with all there are if others are few."""
    drawn = select(pair.a, pair.b, pair.motion_a, pair.dt_a_b, MORE * config.moments, config.seed + 1)
    other = drawn[~np.isin(drawn[:, 1], pair.selected[:, 1])]
    if len(other) < 2 * FEWEST:
        return replace(pair, selected=drawn), False
    return replace(pair, selected=other), True


def _stepped(look: Look, metric: CostMetric, moments: Sequence[Any], given: Transform) -> Look:
    """The look with the costs of all steps, and of those on the way to the pose that was found."""
    frame = Frame(replace(given, cov=np.diag(LEAST**2)), np.diag(LEAST))
    cost = focused(metric, moments, frame, np.zeros(6), 1.0, SHARPEST[1])
    if cost is None:
        return look
    along = (STEPS[:, :, None] * np.eye(6)).reshape(-1, 6)
    seen = cost(np.concatenate([np.zeros((1, 6)), along, np.outer(PARTS, np.nan_to_num(look.move))]) / LEAST)
    lower = seen[0] - seen[1:]
    error = lower.std(axis=1, ddof=1) / np.sqrt(seen.shape[1])
    gain = lower.mean(axis=1) / np.maximum(error, 1e-12)
    return replace(
        look,
        moments=seen.shape[1],
        cost=float(seen[0].mean()),
        costs=seen[1:].mean(axis=1)[: len(along)].reshape(STEPS.shape),
        gain=gain[: len(along)].reshape(STEPS.shape),
        on_the_way=gain[len(along) :],
    )


def _move(T_a_b: Array, found: Transform) -> tuple[Array, Array]:
    """``(dt, delta)`` from a pose to the one that was found, and its covariance; where only the direction of the
    translation was found, its length is left as it is and not known."""
    t, cov = T_a_b[:3, 3], found.cov.copy()
    to = found.T_a_b[:3, 3]
    if not found.has_scale:
        length = max(float(np.linalg.norm(t)), 1e-9)
        to, cov = length * to, cov * np.repeat([length, 1.0], 3) * np.repeat([length, 1.0], 3)[:, None]
        along = np.append(to / length, np.zeros(3))
        cov = cov + np.outer(along, along)
    return np.concatenate([to - t, se3.log_so3(found.T_a_b[:3, :3] @ T_a_b[:3, :3].T)]), cov


def _sharpest(looks: Sequence[Look]) -> Look | None:
    found = [look for look in looks if look.found]
    return min(found, key=lambda look: float(np.sum(np.minimum(look.sigma / SHOWN, 10.0))), default=None)


def _linked(first: str, judgements: Sequence[Judgement]) -> Iterator[str]:
    """Sensors to which pairs lead from the first that are shown along all axes."""
    pairs = [{j.a, j.b} for j in judgements if j.shown.all()]
    reached, new = set[str](), {first}
    while new:
        yield from new
        reached |= new
        new = {name for pair in pairs if pair & reached for name in pair} - reached
