"""The mount of a lidar from how far its scans lie off each other along a path that has errors of its own.

Two scans, laid together along the path, differ by the error of the mount, which all pairs share, and by that of the
path between them, which is each pair's own. The path's is drawn from a covariance that the pairs tell themselves, and
is eliminated: what is left are six equations.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib_toolkit import se3

Array = NDArray[np.float64]

FREEDOM = 5.0
"""Degrees of freedom of the t distribution of the path's errors: one step in some ten may be off by several sigma."""
FLOOR = np.array([1e-4, 1e-4, 1e-4, 1e-5, 1e-5, 1e-5])
"""No error of a path is taken to be smaller than this between two scans (metres, radians)."""

LATE = 1e-2
"""Seconds, for the derivative by the clock offset; with less, points that change their match are felt."""
LASTING = 5e-4
"""Radians: what a run's attitude error is taken for at first."""


@dataclass(frozen=True)
class Links:
    """Pairs of scans.

    T_path: (n, 4, 4) the path's own motion between the two. T_late: the same if the clock offset were ``LATE`` more.
    when: (n,) stamps of the second. span: (n,) seconds between them. group: (n,) which run of scans they are of.
    one_mount: both scans are of the lidar that is looked for; otherwise only the second is, and the first made the
    path.
    """

    T_path: Array
    T_late: Array
    when: Array
    span: Array
    group: NDArray[np.int64]
    one_mount: bool

    def __len__(self) -> int:
        return len(self.span)

    def __getitem__(self, part: NDArray[np.bool_]) -> "Links":
        T_path, T_late, when, span = (c[part] for c in (self.T_path, self.T_late, self.when, self.span))
        return Links(T_path, T_late, when, span, self.group[part], self.one_mount)


@dataclass(frozen=True)
class State:
    """T: (4, 4) the mount. error: (n, 6) of the path over each link, ``(dt, delta)`` in the path's axes at its first
    scan. variance: (6,) of such an error over one second."""

    T: Array
    error: Array
    variance: Array

    def motions(self, links: Links) -> Array:
        """``T_path`` with its error taken out, (n, 4, 4)."""
        R = se3.exp_so3(self.error[:, 3:]) @ links.T_path[:, :3, :3]
        return se3.rigid(R, links.T_path[:, :3, 3] + self.error[:, :3])

    def targets_sources(self, links: Links) -> Array:
        """``T_target_source`` of each link's scans, (n, 4, 4)."""
        after = self.motions(links) @ self.T
        return se3.invert(self.T) @ after if links.one_mount else after


@dataclass(frozen=True)
class Equations:
    """information x = -gradient for the mount's ``(dt, delta)``, the sums of what each run of scans adds.

    shares, slopes: (k, 6, 6) and (k, 6), what each adds. feigned: (6, 6) the part of the information that the path's
    errors alone would show. error, spread: (n, 6) and (n, 6, 6) of each link's step given no step of the mount.
    coupling: (n, 6, 6) its change with one. when: (k,) seconds of each run. drift: what each adds of an error that
    the path gathers every second alike.
    """

    shares: Array
    slopes: Array
    feigned: Array
    error: Array
    spread: Array
    coupling: Array
    when: Array
    drift: "Drift"

    @property
    def information(self) -> Array:
        """(6, 6)."""
        return np.asarray(self.shares.sum(axis=0))

    @property
    def gradient(self) -> Array:
        """(6,)."""
        return np.asarray(self.slopes.sum(axis=0))


@dataclass(frozen=True)
class Drift:
    """Of an error (6,) that a path gathers each second, by run: shares (k, 6, 6) and slopes (k, 6) as of the mount's;
    with_mount: (k, 6, 6) what both have in common. variance: (6,) that it may have.
    """

    shares: Array
    slopes: Array
    with_mount: Array
    variance: Array


def equations(state: State, links: Links, information: Array, gradient: Array) -> Equations:
    """Normal equations of the mount. information, gradient: (n, 6, 6) and (n, 6), see ``Misfit``, at the state."""
    L, G = _by_path(state, links), _by_mount(state, links)
    Lt, Gt = np.swapaxes(L, 1, 2), np.swapaxes(G, 1, 2)
    prior = state.variance * links.span[:, None]
    weight = (FREEDOM + 6) / (FREEDOM + np.sum(state.error**2 / prior, axis=1))
    P = np.eye(6) * (weight[:, None] / prior)[:, None]  # the path's information about its error
    H = Lt @ information @ L + P
    own = _of(Lt, gradient) + _of(P, state.error)
    spread = np.linalg.inv(H)
    cross = Gt @ information @ L
    each = Gt @ information @ G - cross @ spread @ np.swapaxes(cross, 1, 2)
    slope = _of(Gt, gradient) - _of(cross @ spread, own)
    _, run = np.unique(links.group, return_inverse=True)
    shares, slopes = _per_run(run, each), _per_run(run, slope)
    return Equations(
        shares,
        slopes,
        _feigned(state, links, information, L, spread),
        -_of(spread, own),
        spread,
        -spread @ np.swapaxes(cross, 1, 2),
        _per_run(run, links.when) / np.bincount(run),
        _drift(state, links, run, P, spread, own, cross),
    )


def moved(state: State, links: Links, found: Equations, step: Array) -> State:
    """The state after a step (6,) of the mount: each link's error follows, and what they tell of their variance.

    The variance is that of expectation maximisation, with the weights of the t distribution.
    """
    error = state.error + found.error + found.coupling @ step
    prior = state.variance * links.span[:, None]
    weight = (FREEDOM + 6) / (FREEDOM + np.sum(error**2 / prior, axis=1))
    own = np.diagonal(found.spread, axis1=1, axis2=2)
    each = (weight[:, None] * error**2 + own) / links.span[:, None]
    return replace(state, T=stepped(state.T, step), error=error, variance=np.maximum(each.mean(axis=0), FLOOR**2))


def stepped(T: Array, step: Array) -> Array:
    """``t + dt``, ``Exp(delta) R`` for a step (6,)."""
    return se3.rigid(se3.exp_so3(step[3:]) @ T[:3, :3], T[:3, 3] + step[:3])


def freed(found: Equations, T: Array) -> Equations:
    """The equations when each run of scans has an attitude error of its own, which is eliminated.

    A heading that is slightly off shows as a step aside at every scan. It wanders over tens of seconds: neither an
    error of single links nor one of the mount, and in turns it looks like a lever arm. Its variance about each axis
    is that of expectation maximisation.
    """
    turned = np.vstack([-se3.skew(T[:3, 3]), np.eye(3)])
    variance, shares, slopes = np.full(3, LASTING**2), found.shares, found.slopes
    for _ in range(30):
        inner = np.linalg.inv(turned.T @ found.shares @ turned + np.diag(1 / variance))
        gain = found.shares @ turned @ inner
        shares, slopes = (
            found.shares - gain @ turned.T @ found.shares,
            found.slopes - _of(gain @ turned.T, found.slopes),
        )
        step = -np.linalg.lstsq(shares.sum(axis=0), slopes.sum(axis=0), rcond=None)[0]
        error: Array = -_of(inner @ turned.T, found.slopes + found.shares @ step)
        variance = np.maximum(np.mean(error**2 + np.diagonal(inner, axis1=1, axis2=2), axis=0), FLOOR[3:] ** 2)
    return replace(found, shares=shares, slopes=slopes)


def steadied(found: Equations) -> Equations:
    """The equations when the path has an error that it gathers steadily, which is eliminated.

    A lidar's own path leans a little, always to the same side. Where one lidar sees what the other saw earlier, and
    never the other way round, that looks like an error of the mount. It may be as large as its errors at random are
    over a second.
    """
    drift = found.drift
    gain = drift.with_mount.sum(axis=0) @ np.linalg.inv(drift.shares.sum(axis=0) + np.diag(1 / drift.variance))
    both = gain @ np.swapaxes(drift.with_mount, 1, 2)
    prior = np.diag(1 / drift.variance) / len(drift.shares)
    shares = found.shares - both - np.swapaxes(both, 1, 2) + gain @ (drift.shares + prior) @ gain.T
    return replace(found, shares=shares, slopes=found.slopes - drift.slopes @ gain.T)


def _drift(
    state: State, links: Links, run: NDArray[np.int64], P: Array, spread: Array, own: Array, cross: Array
) -> Drift:
    by_error = links.span[:, None, None] * P
    return Drift(
        _per_run(run, by_error @ (links.span[:, None, None] * np.eye(6) - spread @ by_error)),
        _per_run(run, _of(by_error, _of(spread, own) - state.error)),
        _per_run(run, cross @ spread @ by_error),
        state.variance,
    )


def _of(A: NDArray[Any], v: NDArray[Any]) -> Array:
    return np.einsum("nij,nj->ni", A, v)


def _per_run(run: NDArray[np.int64], part: Array) -> Array:
    """Sums over the links of each run."""
    out = np.zeros((int(run.max()) + 1, *part.shape[1:]))
    np.add.at(out, run, part)
    return out


def _by_path(state: State, links: Links) -> Array:
    """(n, 6, 6) of ``T_target_source`` by the path's motion, noise of both in their outer axes."""
    swing = state.motions(links)[:, :3, :3] @ state.T[:3, 3]
    L = np.zeros((len(swing), 6, 6))
    R = state.T[:3, :3].T if links.one_mount else np.eye(3)
    L[:, :3, :3] = L[:, 3:, 3:] = R
    L[:, :3, 3:] = -R @ se3.skew(swing)
    return L


def _by_mount(state: State, links: Links) -> Array:
    """(n, 6, 6) of ``T_target_source`` by the mount."""
    M = state.motions(links)
    G = np.zeros((len(M), 6, 6))
    if not links.one_mount:
        G[:, :3, :3] = G[:, 3:, 3:] = M[:, :3, :3]
        return G
    R = state.T[:3, :3].T
    lever = (M @ state.T)[:, :3, 3] - state.T[:3, 3]
    G[:, :3, :3] = G[:, 3:, 3:] = R @ (M[:, :3, :3] - np.eye(3))
    G[:, :3, 3:] = R @ se3.skew(lever)
    return G


def _feigned(state: State, links: Links, information: Array, L: Array, spread: Array) -> Array:
    """(6, 6) information that noise of the path's motion adds, since the mount shows only where the path turns.

    Without it a drive on a plane, on which noise tilts the path a little, would claim to know the mount's height.
    """
    if not links.one_mount:
        return np.zeros((6, 6))
    M, R = state.motions(links), state.T[:3, :3].T
    variance, axes = np.linalg.eigh(spread)
    draws = np.swapaxes(axes * np.sqrt(np.maximum(variance, 0.0))[:, None], 1, 2)  # (n, 6 draws, 6)
    turned = R @ se3.skew(draws[..., 3:]) @ M[:, None, :3, :3]
    lever = draws[..., :3] + np.cross(draws[..., 3:], (M[:, :3, :3] @ state.T[:3, 3])[:, None])
    noise = np.zeros((*draws.shape[:2], 6, 6))
    noise[..., :3, :3] = noise[..., 3:, 3:] = turned
    noise[..., :3, 3:] = R @ se3.skew(lever)
    # what is left of a pair's information when its own error is eliminated
    net = information - information @ L @ spread @ np.swapaxes(L, 1, 2) @ information
    return np.einsum("nkji,njl,nklm->im", noise, net, noise)
