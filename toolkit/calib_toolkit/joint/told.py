"""Which clocks the drive tells, by how the vehicle turned or else by how fast it went."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from calib_toolkit import observability, sync
from calib_toolkit.joint import spread, start, turning
from calib_toolkit.joint.clocks import Clocks, Late
from calib_toolkit.joint.readings import travel
from calib_toolkit.joint.turning import Turning
from calib_toolkit.types import Motions

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

PERIODS = (1, 4, 16)
"""Of the slower sensor, over which a speed is told: turns change within a second, a speed hardly does."""
CHANCE = 4.5
"""Standard deviations of a correlation that is chance, more so at the lag that was chosen for it."""
FEWEST = 30
"""Readings below which those that were rejected are looked at, too."""


@dataclass(frozen=True)
class Told:
    """clocks: those that nothing told are taken as they are. cov: (2(q-1), 2(q-1)) of the offsets, then the skews, of
    the clocks but the base's; zero for what nothing told. open: (q,) which those are.
    """

    clocks: Clocks
    cov: Array
    open: Mask


def estimate(motions: Sequence[Motions], turned: Turning, known: Sequence[Late]) -> Told:
    """What the first stage found, and for clocks that turning does not tell what the speed of travel tells.

    A drive straight on at changing speed tells the clocks of sensors that have scale.
    """
    clocks = turned.clocks
    told = _told(motions, turned, known)
    dt, skew, cov = clocks.dt * told, clocks.skew * told, _only(turned.clock_cov, told)
    scaled = [i for i, m in enumerate(motions) if m.has_scale]
    if 0 in scaled and not told[clocks.of[scaled]].all():
        travels = [travel(motions[i]) for i in scaled]
        went = _by_speed(travels, Clocks(clocks.of[scaled], dt, skew, clocks.t_ref), told)
        more = ~told & _told(travels, went, known)
        more[np.setdiff1d(np.arange(len(clocks)), clocks.of[scaled])] = False
        dt, skew, told = dt + went.clocks.dt * more, skew + went.clocks.skew * more, told | more
        # a speed changes so slowly that noise may be most of what changed
        wider = np.tile(1 / np.clip(1 - went.feigned, spread.LEAST, 1.0), 2)
        cov = cov + _only(went.clock_cov * np.outer(wider, wider), more)
    own = told.copy()
    own[[k.clock for k in known]] = False
    return Told(replace(clocks, dt=dt, skew=skew), cov + _only(_late(motions, clocks.of), own), ~told)


def _late(motions: Sequence[Motions], of: NDArray[np.int64]) -> Array:
    """(2(q-1), 2(q-1)) of offsets and skews: what the sensors' motions are late by and the base's, which all share.

    of: (n,) clocks. Of several on one clock the best counts.
    """
    late = np.array([min(m.late for m, c in zip(motions, of, strict=True) if c == k) for k in range(of.max() + 1)])
    return block_diag(np.diag(late[1:] ** 2) + late[0] ** 2, np.zeros((len(late) - 1, len(late) - 1)))


def _by_speed(travels: Sequence[Motions], clocks: Clocks, told: Mask) -> Turning:
    """The first stage with travels in the place of turns: straight on, they too differ by a rotation alone."""
    chains = [sync.chain(m) for m in travels]
    late = Clocks.starting(list(clocks.of), start.lags(chains), clocks.t_ref)
    dt = clocks.dt.copy()
    for c, there in zip(dict.fromkeys(clocks.of), late.dt, strict=True):
        dt[c] = dt[c] if told[c] else there
    first = replace(clocks, dt=dt)
    on_base = [c.shifted(d) for c, d in zip(chains, dt[clocks.of], strict=True)]
    R = start.poses(sync.synchronise(on_base, np.inf))[:, :3, :3]
    return turning.estimate(travels, R, first, [Late(int(c), dt[c], 1e-6) for c in np.flatnonzero(told)[1:]])


def _told(motions: Sequence[Motions], turned: Turning, known: Sequence[Late]) -> Mask:
    """(q,) whether the angular speed of a sensor on each clock changes with the base's, or a number tells it."""
    chains = []
    for i, (m, kept) in enumerate(zip(motions, turned.kept, strict=True)):
        good = m[kept] if kept.sum() >= FEWEST else m
        chains.append(sync.chain(good).shifted(float(turned.clocks.dt[turned.clocks.of[i]])))
    told = np.zeros(len(turned.clocks), dtype=bool)
    told[[0, *(k.clock for k in known)]] = True
    for chain, c in zip(chains[1:], turned.clocks.of[1:], strict=True):
        told[c] |= any(not observability.unmeasured_times("ab", [chains[0], chain], "ab", k, CHANCE) for k in PERIODS)
    return told


def _only(cov: Array, clocks: Mask) -> Array:
    """A covariance of offsets and skews with zero for all but some clocks (q,)."""
    kept = np.tile(clocks[1:], 2).astype(float)
    return cov * np.outer(kept, kept)
