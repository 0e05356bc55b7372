"""The pose at which a metric finds least fault, searched for by CMA-ES from the motion's own estimate (VII-B).

Poses are whitened by the motion's covariance: ``z`` of length one is one sigma off. The search goes from smooth
pictures to sharp ones; what it finds is appearance alone (see :mod:`~calib_toolkit.appearance.evidence`).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib_toolkit import se3
from calib_toolkit.appearance.evidence import Evidence, evidence
from calib_toolkit.appearance.pairs import rate
from calib_toolkit.hookspecs import CostMetric, Metric
from calib_toolkit.types import Pair, PairEstimate, Transform

Array = NDArray[np.float64]

VERSION = "3"
"""Of the search that metrics share: to be raised when its answers change, so that no old ones come from the cache."""
LEAST = np.array([0.05] * 3 + [np.radians(0.5)] * 3)
"""Metres, radians: a search is never narrower than this, for a stated sigma may be too small."""
MOST = np.array([0.5] * 3 + [np.radians(5.0)] * 3)
"""One sigma is never taken to be more: half of the range that is searched."""
ASIDE, CLOSE = 2.0, 0.5
"""Of these: where else searches start along what the motion leaves open, since its own pose means nothing there; and
how much narrower than others they are, so that they stay."""
TOLD = 0.5
"""Share of these within which appearance must tell by itself what the motion leaves open."""
FAR = 4.0
"""Length of ``z`` beyond which the best pose is not believed."""
BLURS = (2.0, 1.0)
NARROWER = (1.0, 0.5)
"""Sigma of the search at each of these, in those of the motion."""
ROUNDS = (30, 20)
POPULATION = 12
DRAWS = 24
PARABOLA = np.array([0.02] * 3 + [np.radians(0.1)] * 3)
"""Metres, radians: how far around the best pose the cost is looked at, at least."""
SHARPEST = (0.25, 0.5)
"""Sigma, in those of the motion, and blur with which the cost is looked at in the end."""
LOOKS = 5
"""How often it is looked at anew, at most, until the pose moves by no more than its own sigma."""
FEWEST = 8
"""Moments that must have something to compare."""
CLEAR = 3.0
"""Standard errors by which the best pose must be better than those the motion allows."""
ANYWHERE = np.array([0.5] * 3 + [np.pi / 2] * 3)
"""Metres, radians: half of what an unconstrained search goes either way (section VIII-F)."""
ANYWHERE_ROUNDS = 150


@dataclass(frozen=True)
class Frame:
    """Poses around a first guess, whitened: T is the guess, L (6, 6) takes ``z`` to ``(dt, delta)`` in a's axes."""

    prior: Transform
    L: Array

    def poses(self, z: Array) -> Array:
        """(k, 4, 4) of ``z`` (k, 6)."""
        step = np.atleast_2d(z) @ self.L.T
        T = self.prior.T_a_b
        return se3.rigid(se3.exp_so3(step[:, 3:]) @ T[:3, :3], T[:3, 3] + step[:, :3])


def estimate(
    metric: Metric | CostMetric, pair: Pair, options: Any, seed: int = 0, moments: Sequence[Any] | None = None
) -> PairEstimate:
    """What a metric makes of a pair: by its own search if it has one, or else by this one.

    moments: those of the pair, where they are :func:`prepared` already.
    """
    if not isinstance(metric, CostMetric):
        return metric.estimate(pair, options)
    if moments is None:
        moments = prepared(metric, pair, options)
    if len(moments) < FEWEST:
        return _refused(metric, pair, f"only {len(moments)} of {len(pair)} moments have something to compare")
    frame, untold = whitened(pair.prior), MOST[:, None] * _untold(pair.prior)
    try:
        found = _searched(metric, moments, frame, untold, seed)
    except np.linalg.LinAlgError:
        return _refused(metric, pair, "its cost has no least value near the motion's pose")
    if found is None:
        return _refused(metric, pair, "in too few moments do both see the same")
    if np.linalg.norm(found.posterior) > FAR:
        return _refused(metric, pair, "the best pose lies further from the motion's than its sigma allows")
    cov = frame.L @ found.cov @ frame.L.T + np.diag(np.square(metric.own))
    if _open(pair.prior, cov):
        return _refused(metric, pair, "the motion leaves the pose open, and what the two see does not tell it either")
    if found.apart > FAR / 2:
        return _refused(metric, pair, "two searches end far from each other")
    if found.clear < CLEAR:
        return _refused(metric, pair, "no pose fits better than others that the motion allows")
    statistics = {
        "moments": float(len(found.costs)),
        "clear": found.clear,
        "cost": float(found.costs.mean()),
        "apart": found.apart,
    }
    transform = Transform(pair.a.name, pair.b.name, frame.poses(found.z)[0], cov)
    return PairEstimate(metric.id, transform, _by_clock(pair), statistics=statistics)


def unconstrained(metric: CostMetric, pair: Pair, options: Any, seed: int = 0) -> Array | None:
    """``T_a_b`` (4, 4) of least cost among all rotations and up to a metre from the prior's position, each axis; what
    is found without the motion's covariance (section VIII-F). None if too few moments have something to compare.

    Compared are the points that are seen from near the prior: nobody knows others that are seen from everywhere.
    """
    frame, z = whitened(pair.prior), np.zeros(6)
    cost = focused(metric, prepared(metric, pair, options), frame, z, 1.0, 1.0)
    if cost is None:
        return None
    wide = np.linalg.solve(frame.L, np.diag(ANYWHERE))
    best = _best(lambda z: cost(z @ wide.T), z, 1.0, ANYWHERE_ROUNDS, seed, bound=2.0)
    return np.asarray(frame.poses(wide @ best)[0], np.float64)


def prepared(metric: CostMetric, pair: Pair, options: Any) -> list[Any]:
    """The moments of a pair that have something to compare, each as the metric made it ready."""
    found = (metric.prepare(pair[k : k + 1], options) for k in range(len(pair)))
    return [m for m in found if m is not None]


def whitened(prior: Transform) -> Frame:
    """The frame of a motion's estimate, its sigma within reason."""
    values, axes = np.linalg.eigh(prior.cov / np.outer(MOST, MOST))
    wide = (axes * np.minimum(values, 1.0)) @ axes.T * np.outer(MOST, MOST)
    cov = wide + np.diag(LEAST**2)
    return Frame(replace(prior, cov=cov), np.linalg.cholesky(cov))


def _untold(prior: Transform) -> Array:
    """(6, u) orthonormal directions, in units of ``MOST``, along which the motion allows more than is searched."""
    values, axes = np.linalg.eigh(prior.cov / np.outer(MOST, MOST))
    return np.asarray(axes[:, values > FAR])


def _open(prior: Transform, cov: Array) -> bool:
    """Whether along something that the motion does not tell appearance, with cov (6, 6), does not either.

    There the answer lies where the search happened to be, or beyond: nothing holds a parabola that is nearly flat.
    """
    untold = _untold(prior)
    found = untold.T @ (cov / np.outer(MOST, MOST)) @ untold
    return bool(np.linalg.eigvalsh(found).max(initial=0.0) > TOLD**2)


def _searched(metric: CostMetric, moments: Sequence[Any], frame: Frame, untold: Array, seed: int) -> Evidence | None:
    """From smooth to sharp, from several starts; what the sharpest tells of the best pose, the wider the less they
    agree. untold: (6, u) steps along what the motion leaves open."""
    starts = enumerate(_starts(frame, untold, seed))
    ends = [_end(metric, moments, frame, z, width, seed + k) for k, (z, width) in starts]
    told = [_told(metric, moments, frame, z, seed + k) for k, z in enumerate(ends) if z is not None]
    reached = sorted((e for e in told if e is not None), key=lambda e: float(e.costs.mean()))
    if not reached:
        return None
    found, *others = reached
    # one that fits clearly worse is not another answer
    rivals = [found.posterior - e.posterior for e in others if _worse(e.costs, found.costs) < CLEAR]
    apart = max(rivals, key=lambda z: float(np.linalg.norm(z)), default=np.zeros(6))
    return replace(found, cov=found.cov + np.outer(apart, apart) / 2, apart=float(np.linalg.norm(apart)))


def _starts(frame: Frame, untold: Array, seed: int) -> list[tuple[Array, float]]:
    """The motion's own pose, one that it allows, and both ways along what it leaves open; and how wide to search."""
    aside = ASIDE * np.linalg.solve(frame.L, untold).T
    near = np.vstack([np.zeros(6), 0.7 * np.random.default_rng(seed).normal(size=6)])
    return [*((z, 1.0) for z in near), *((z, CLOSE) for z in (*aside, *-aside))]


def _end(metric: CostMetric, moments: Sequence[Any], frame: Frame, z: Array, width: float, seed: int) -> Array | None:
    """Where a search from z ends; None where too little can be compared."""
    for blur, sigma, rounds in zip(BLURS, width * np.array(NARROWER), ROUNDS, strict=True):
        cost = focused(metric, moments, frame, z, sigma, blur)
        if cost is None:
            return None
        z = _best(cost, z, sigma, rounds, seed)
        del cost  # its pictures, before the next are made
    return z


def _told(metric: CostMetric, moments: Sequence[Any], frame: Frame, z: Array, seed: int) -> Evidence | None:
    """What the sharpest cost tells from z on, looked at anew from where it leads until it leads no further.

    The valley may be narrow and long (along a straight road): few rounds of the search come to its bottom.
    """
    least, found = np.linalg.solve(frame.L, np.diag(PARABOLA)), None
    for _ in range(LOOKS):
        cost = focused(metric, moments, frame, z, *SHARPEST)
        if cost is None:
            return None
        found = evidence(cost, z, least @ least.T, seed)
        del cost
        step, z = found.posterior - z, found.posterior
        if step @ (np.linalg.inv(found.cov) + np.eye(6)) @ step < len(step):
            break
    return found


def _worse(costs: Array, least: Array) -> float:
    """Standard errors by which costs (m,) are above others, moment by moment where they are of the same ones."""
    if len(costs) == len(least):
        variance = np.var(costs - least, ddof=1) / len(costs)
    else:
        variance = np.var(costs, ddof=1) / len(costs) + np.var(least, ddof=1) / len(least)
    return float((costs.mean() - least.mean()) / np.sqrt(variance + 1e-24))


def focused(
    metric: CostMetric, moments: Sequence[Any], frame: Frame, z: Array, sigma: float, blur: float
) -> Callable[[Array], Array] | None:
    """Costs (k, m) of poses ``z`` (k, 6) at the moments that have something to compare; None if they are too few."""
    around = Transform(frame.prior.a, frame.prior.b, frame.poses(z)[0], sigma**2 * frame.prior.cov)
    looked = [f for m in moments if (f := metric.focus(m, around, blur)) is not None]
    if len(looked) < FEWEST:
        return None
    return lambda z: np.column_stack([metric.costs(frame.poses(z), m) for m in looked])


def _best(
    cost: Callable[[Array], Array], z: Array, sigma: float, rounds: int, seed: int, bound: float | None = None
) -> Array:
    """The most likely z, given costs (k, m) and the motion, by CMA-ES; or the least cost within a bound alone."""
    import cma

    rng = np.random.default_rng(seed)
    weight = likelihood_weight(cost(z + sigma * rng.normal(size=(DRAWS, 6))))
    bounds = [None if bound is None else -bound, bound]
    options = {"seed": seed + 1, "verbose": -9, "maxiter": rounds, "tolx": 1e-3 * sigma, "popsize": POPULATION}
    search = cma.CMAEvolutionStrategy(z, sigma, {**options, "bounds": bounds})
    while not search.stop():
        asked = np.array(search.ask())
        worth = weight * cost(asked).mean(axis=1) + (0.5 * np.sum(asked**2, axis=1) if bound is None else 0.0)
        search.tell(list(asked), worth.tolist())
    return np.asarray(search.result.xfavorite, dtype=np.float64)


def likelihood_weight(costs: Array) -> float:
    """What makes the mean of costs (k, m) over the moments a negative log-likelihood.

    Of a likelihood's difference between two poses the variance is twice its mean: how much the moments differ in it
    tells what the cost is worth.
    """
    best = np.argmin(costs.mean(axis=1))
    more = np.delete(costs, best, axis=0) - costs[best]
    mean, variance = more.mean(axis=1), more.var(axis=1, ddof=1) / costs.shape[1]
    return float(np.median(2 * mean / np.maximum(variance, 1e-18)))


def _by_clock(pair: Pair) -> Array:
    """(6,) per second: seen later, points have moved against the motion of a, and the estimate with them."""
    moved, origin = rate(pair), pair.prior.T_a_b[:3, 3]
    return -np.concatenate([moved[:3] + np.cross(moved[3:], origin), moved[3:]])


def _refused(metric: CostMetric, pair: Pair, why: str) -> PairEstimate:
    """No estimate, and why."""
    return PairEstimate(metric.id, pair.prior, converged=False, note=why)
