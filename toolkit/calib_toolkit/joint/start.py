"""Where the search begins: offsets from a minute and a half early to as much late, and any mounting, without a guess.

Offsets are the lags at which two sensors' angular speeds go together; of the best few that one is taken at which
some rotation makes the turns themselves agree. Poses are then least squares on common steps: rotations from turns
and travels both, so that a drive without ramps still tells a sensor's yaw.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.signal import correlate, find_peaks

from calib_toolkit import se3
from calib_toolkit.errors import DataError
from calib_toolkit.sync import Chain, Steps

Array = NDArray[np.float64]

MOST_LATE = 90.0
"""Seconds; clocks further apart than that are refused."""
TICK = 0.05
OVERLAP = 0.2
"""Share of the shorter recording that must be common to both, whatever the lag."""
CANDIDATES = 12
SMOOTH = 4
"""Ticks over which turns are summed up: two readings at 10 Hz."""
ALIKE = 0.8
"""Most of two sensors' turning that the lag and rotation that are taken may leave unexplained, to begin with."""
AGREED, AGREED_SHORT = 0.35, 0.1
"""The same in the end; and where the sensors share less than LONG of their time, so that chance may do much."""
LONG = 0.75
MOVED = 0.6
"""Share of a sensor's turning that is jitter, from which it may be nothing else."""
CLIP = 4.0
"""Readings count as if they were no longer than so many times the usual."""
LEVER = 1.0
"""Metres: how far two sensors are apart, before that is known."""
ROUNDS = 8
WIDE = 5.0
"""Metres: how far a sensor may be put by readings that hardly tell."""


def lags(chains: Sequence[Chain]) -> Array:
    """(n,) by how much each sensor's clock is behind the first's, to half a tick; zero where none stands out."""
    base = _turns(chains[0])
    return np.array([0.0, *(_lag(base, _turns(c)) for c in chains[1:])])


def agree(names: Sequence[str], chains: Sequence[Chain]) -> None:
    """Refuse sensors whose turns can not be those of one vehicle. chains: on one clock. Raises DataError.

    A wrong lag may make a few bends go together, and would otherwise give a confident wrong answer.
    """
    a, known_a, start_a = _turns(chains[0])
    for name, c in zip(names[1:], chains[1:], strict=True):
        b, known_b, start_b = _turns(c)
        shift = round((start_b - start_a) / TICK)
        left, noise = _unexplained(a, b, shift), max(_jitter(a), _jitter(b))
        short = _common(known_a, known_b, shift) < LONG * min(known_a.sum(), known_b.sum())
        if noise < MOVED and left > (AGREED_SHORT if short else AGREED):
            raise DataError(
                f"the turns of {name} and {names[0]} do not go together at any clock offset within {MOST_LATE:g} s, "
                "or for too short a time; check that both are of one drive, have three quarters of it in common, "
                "and count their seconds from the same epoch"
            )


def poses(steps: Steps) -> Array:
    """(n, 4, 4) of all sensors in the first. Without any sensor that has scale positions stay zero."""
    return np.array([np.eye(4), *(_pose(steps, i) for i in range(1, len(steps.vec)))])


def _turns(c: Chain) -> tuple[Array, Array, float]:
    """Turns (m, 3) over each tick, whether they are known (m,), and when they begin."""
    stamps = np.arange(c.knots[0], c.knots[-1], TICK)
    link = np.clip(np.searchsorted(c.knots, stamps[:-1] + TICK / 2) - 1, 0, len(c.known) - 1)
    known = c.known[link]
    turn = np.diff(c.turned(stamps), axis=0) * known[:, None]
    length = np.linalg.norm(turn, axis=1)
    usual = np.median(length[known]) if known.any() else 0.0
    spread = np.sqrt(np.mean(np.minimum(length[known], 20 * usual) ** 2)) if known.any() else 0.0
    turn *= np.minimum(1.0, CLIP * max(spread, 1e-12) / np.maximum(length, 1e-12))[:, None]
    return turn, known.astype(float), float(stamps[0])


def _lag(base: tuple[Array, Array, float], other: tuple[Array, Array, float]) -> float:
    """Seconds to add to the other's stamps."""
    (a, known_a, start_a), (b, known_b, start_b) = base, other
    speed_a, speed_b = np.linalg.norm(a, axis=1), np.linalg.norm(b, axis=1)
    sums = {
        "n": (known_a, known_b),
        "a": (speed_a, known_b),
        "b": (known_a, speed_b),
        "aa": (speed_a**2, known_b),
        "bb": (known_a, speed_b**2),
        "ab": (speed_a, speed_b),
    }
    at = {name: correlate(x, y, method="fft") for name, (x, y) in sums.items()}
    shift = np.arange(len(at["n"])) - (len(b) - 1)
    dt = start_a - start_b + shift * TICK
    n = np.maximum(at["n"], 1.0)
    spread = np.maximum(at["aa"] - at["a"] ** 2 / n, 0.0) * np.maximum(at["bb"] - at["b"] ** 2 / n, 0.0)
    allowed = (np.abs(dt) <= MOST_LATE) & (n >= OVERLAP * min(known_a.sum(), known_b.sum())) & (spread > 0)
    if not allowed.any():
        return 0.0
    alike = np.where(allowed, (at["ab"] - at["a"] * at["b"] / n) / np.sqrt(np.where(allowed, spread, 1.0)), -1.0)
    # a high correlation over a short time is worth less
    score = np.where(allowed, np.clip(alike, 0.0, 1.0) * np.sqrt(n), 0.0)
    peaks, _ = find_peaks(np.concatenate([[0.0], score, [0.0]]))
    best = sorted(peaks - 1, key=lambda k: -score[k])[:CANDIDATES]
    left = [_unexplained(a, b, int(shift[k])) for k in best]
    # a lag that explains little is worth less than one that explains more over a shorter time
    worth = [-n[k] * np.log(max(e, 1e-6)) for k, e in zip(best, left, strict=True)]
    if not worth or left[int(np.argmax(worth))] > ALIKE:
        return 0.0
    k = best[int(np.argmax(worth))]
    return float(dt[k])


def _common(known_a: Array, known_b: Array, shift: int) -> float:
    """Ticks at which both are known."""
    a, b = (known_a[shift:], known_b) if shift >= 0 else (known_a, known_b[-shift:])
    n = min(len(a), len(b))
    return float(a[:n] @ b[:n])


def _jitter(turns: Array) -> float:
    """Share of a sensor's turning (m, 3) that changes from one moment to the next: near one if it is noise alone."""
    n = len(turns) // SMOOTH * SMOOTH
    smooth = turns[:n].reshape(-1, SMOOTH, 3).sum(axis=1)
    power = float((smooth**2).sum())
    return float((np.diff(smooth, axis=0) ** 2).sum()) / (2 * power) if power > 0 else 1.0


def _unexplained(a: Array, b: Array, shift: int) -> float:
    """Share of two sensors' turning that is left when one is late by so many ticks and turned as fits best."""
    a, b = (a[shift:], b) if shift >= 0 else (a, b[-shift:])
    n = min(len(a), len(b)) // SMOOTH * SMOOTH
    a, b = (v[:n].reshape(-1, SMOOTH, 3).sum(axis=1) for v in (a, b))
    U, s, Vt = np.linalg.svd(a.T @ b)
    total = float((a**2).sum() + (b**2).sum())
    return 1 - 2 * float(s[0] + s[1] + s[2] * np.linalg.det(U @ Vt)) / max(total, 1e-300)


def _pose(steps: Steps, i: int) -> Array:
    """Rotation, then position, in turns, by reweighted least squares on the base's steps and this sensor's."""
    (p_a, w_a), (p_b, w_b) = ((steps.vec[k, :, :3], steps.vec[k, :, 3:]) for k in (0, i))
    noise_p, noise_w = (
        np.trace(steps.cov[0, :, part, part] + steps.cov[i, :, part, part], axis1=1, axis2=2)
        for part in (slice(3), slice(3, 6))
    )
    swing = se3.exp_so3(w_a) - np.eye(3)
    length = np.linalg.norm(p_a, axis=1)
    if not steps.has_scale[0]:
        noise_p = np.full(len(p_a), np.inf)  # how far the levers swing is not known
    elif not steps.has_scale[i]:
        p_b, noise_p = p_b * length[:, None], noise_p * np.maximum(length, 0.1) ** 2
    R, t = np.eye(3), np.zeros(3)
    lever2 = (LEVER * np.linalg.norm(w_a, axis=1)) ** 2
    for _ in range(ROUNDS):
        travelled = p_a + swing @ t
        turn_error, travel_error = w_a - w_b @ R.T, travelled - p_b @ R.T
        first = not t.any() and np.allclose(R, np.eye(3))
        by_turn = _weights(None if first else turn_error, noise_w)
        by_travel = _weights(None if first else travel_error, noise_p + lever2)
        U, _, Vt = np.linalg.svd((w_a * by_turn[:, None]).T @ w_b + (travelled * by_travel[:, None]).T @ p_b)
        R = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
        if np.isfinite(noise_p).all():
            by_travel = _weights(p_a + swing @ t - p_b @ R.T, noise_p)
            t = _position(swing, p_b @ R.T - p_a, p_b @ R.T, by_travel, bool(steps.has_scale[i]))
            lever2 = np.zeros_like(lever2)
    return se3.rigid(R, t)


def _position(swing: Array, shift: Array, along: Array, weight: Array, has_scale: bool) -> Array:
    """The lever t of ``swing @ t = shift``; without scale only what lies across the travel (m, 3) counts."""
    if not has_scale:
        unit = along / np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-9)
        across = np.eye(3) - unit[:, :, None] * unit[:, None, :]
        swing, shift = across @ swing, (across @ shift[..., None])[..., 0]
    information = np.einsum("m,mij,mik->jk", weight, swing, swing) + np.eye(3) / WIDE**2
    return np.asarray(np.linalg.solve(information, np.einsum("m,mij,mi->j", weight, swing, shift)))


def _weights(error: Array | None, variance: Array) -> Array:
    """(m,) for errors (m, 3) of summed variance (m,), times whatever scale they show: a Cauchy's."""
    if error is None:
        return 1 / variance
    squared = np.einsum("mi,mi->m", error, error) / variance
    scale = max(float(np.median(squared)), 1e-12)
    return 1 / (variance * scale * (1 + squared / (4 * scale)))
