"""Which directions a drive measured, told without trusting anyone's stated noise, and what to drive instead.

An information matrix made of noisy motions holds the noise too, and so reports a finite sigma for a direction that
was never excited. Here the excitation is the product of two sensors' readings of the same turn: their noises
are independent, so it is zero on average wherever nothing moved. A direction counts as measured when its
excitation stands well above the spread that the two sensors' disagreement gives it, and is not mostly noise.
"""

from collections.abc import Hashable, Sequence

import numpy as np
from numpy.typing import NDArray

from calib_toolkit import se3
from calib_toolkit.sync import Chain, Steps, angles, common_span
from calib_toolkit.types import Undetermined

Array = NDArray[np.float64]

THRESHOLD = 6.0
"""Standard deviations of noise: without any motion the best of several directions, or of many lags, reaches four."""
VAGUE_TURN_DEG, VAGUE_SHIFT = 5.0, 1.0
"""A sigma above these (degrees, metres) tells nothing: a ruler does better."""
CLIP = 2.0
"""Readings count as if they were no longer than so many times what two sensors commonly disagree by."""
COMMON = 0.3
"""Least correlation of two sensors' readings along a direction: below it noise biases what is estimated there."""


def unmeasured_times(
    names: Sequence[str], chains: Sequence[Chain], clocks: Sequence[Hashable], periods: int = 1, chance: float = 0.0
) -> list[Undetermined]:
    """Sensors on clocks of which none's angular speed changes together with the first sensor's.

    chains: (n,) on one clock. clocks: (n,) sensors with equal ones share an offset. periods: of the slowest sensor,
    over which a speed is told. chance: of few windows even a high correlation is chance; how many standard deviations
    of that it must have.
    """
    lo, hi = common_span(chains)
    window = periods * max(c.period for c in chains)
    angle, _ = angles(chains, np.arange(lo, hi - window, window), window)
    slope = np.diff(angle, axis=1)
    known = np.isfinite(slope).all(axis=0)
    slope = slope[:, known, None]
    if not known.any():
        slope = np.zeros((len(names), 1, 1))
    common = chance / np.sqrt(slope.shape[1])
    measured = {
        clocks[0],
        *(c for c, other in zip(clocks, slope, strict=True) if stand_out(slope[0], other, 12.0, common)),
    }
    return [
        Undetermined(
            {f"{name}.dt": 1.0},
            f"the clock offset of {name} was not determined and is taken as zero: the vehicle's turning hardly "
            "changed; drive bends at changing speed",
        )
        for name, clock in zip(names, clocks, strict=True)
        if clock not in measured
    ]


def unmeasured_turns(names: Sequence[str], steps: Steps, R: Array) -> list[Undetermined]:
    """Directions about which turning a sensor changes nothing that was measured. R: (n, 3, 3)."""
    w = se3.turn_vectors(R, steps.vec[..., 3:])
    found = []
    for i, name in enumerate(names[1:], start=1):
        null = _null_directions(w[0], w[i], np.sqrt(_weight(steps, i))[:, None, None] * np.eye(3))
        for v in null:
            why = "turned about that axis only" if len(null) == 1 else "hardly turned"
            found.append(
                Undetermined(
                    _direction(name, ("rx", "ry", "rz"), v),
                    f"the rotation of {name} about {axis_words(v, names[0])} was not determined: the vehicle {why}; "
                    "drive bends, and a ramp, kerbs or rough ground",
                )
            )
    return found


def unmeasured_shifts(
    names: Sequence[str], steps: Steps, R: Array, turns: Sequence[Undetermined]
) -> list[Undetermined]:
    """Directions along which moving a sensor changes nothing that was measured. turns: what rotation left open."""
    found = []
    w, p = se3.turn_vectors(R, steps.vec[..., 3:]), se3.turn_vectors(R, steps.vec[..., :3])
    for i, name in enumerate(names[1:], start=1):
        if not steps.has_scale.any():
            null, why = np.eye(3), "no sensor knows distances, only directions; add a lidar, a GPS/INS or an odometry"
        elif any(key.startswith(f"{name}.") for t in turns for key in t.direction):
            null, why = np.eye(3), "its rotation was not determined either; see there what to drive"
        else:
            keep = np.sqrt(_weight(steps, i))[:, None, None] * np.eye(3)
            if not steps.has_scale[i]:  # how far a camera went is not known, so what lies along its motion is not
                u = p[i] / np.linalg.norm(p[i], axis=1, keepdims=True).clip(1e-12)
                keep = keep @ (np.eye(3) - u[:, :, None] * u[:, None, :])
            null = _null_directions(w[0], w[i], keep)
            why = (
                "the vehicle hardly turned about any other direction; drive over a ramp, kerbs or rough ground, "
                "or measure it by hand"
            )
        found += [
            Undetermined(
                _direction(name, ("x", "y", "z"), v),
                f"the position of {name} along {axis_words(v, names[0])} was not determined: {why}",
            )
            for v in null
        ]
    return found


def vague_turns(names: Sequence[str], cov: Array, known: Sequence[Undetermined]) -> list[Undetermined]:
    """Rotations that were measured, but to no use. cov: (3n, 3n). known: what is undetermined already."""
    what = "the rotation of {} about {} of {} was found only to {:.0f} degrees"
    return _vague(names, np.degrees(_sigma(cov)), known, VAGUE_TURN_DEG, ("rx", "ry", "rz"), what)


def vague_shifts(names: Sequence[str], cov: Array, known: Sequence[Undetermined]) -> list[Undetermined]:
    """Positions that were measured, but to no use. cov: (3n, 3n). known: what is undetermined already."""
    what = "the position of {} along {} of {} was found only to {:.1f} m"
    return _vague(names, _sigma(cov), known, VAGUE_SHIFT, ("x", "y", "z"), what)


def _sigma(cov: Array) -> Array:
    return np.sqrt(np.maximum(np.diag(cov), 0.0)).reshape(-1, 3)


def _vague(
    names: Sequence[str],
    sigma: Array,
    known: Sequence[Undetermined],
    limit: float,
    axes: tuple[str, str, str],
    what: str,
) -> list[Undetermined]:
    return [
        Undetermined(
            {f"{name}.{axis}": 1.0},
            what.format(name, axis[-1], names[0], sigma[i, k]) + "; drive longer, with more bends and rough ground",
        )
        for i, name in enumerate(names)
        if not any(f"{name}.{axes[0]}" in u.direction for u in known)  # then it was said already, and why
        for k, axis in enumerate(axes)
        if sigma[i, k] > limit
    ]


def _null_directions(w_base: Array, w_sensor: Array, keep: Array) -> Array:
    """(k, 3) directions v along which ``keep @ (v x w)`` of the two sensors has nothing in common.

    w_base, w_sensor: (m, 3) turns in base axes. keep: (m, 3, 3) what of a change shows, weighted.
    """
    by_base, by_sensor = keep @ se3.skew(w_base), keep @ se3.skew(w_sensor)
    excitation = np.einsum("mia,mib->ab", by_base, by_sensor)
    _, vectors = np.linalg.eigh(0.5 * (excitation + excitation.T))
    return np.array([v for v in vectors.T if not stand_out(by_base @ v, by_sensor @ v)]).reshape(-1, 3)


def stand_out(a: Array, b: Array, kurtosis: float = 16.0, common: float = COMMON) -> bool:
    """Whether two noisy readings (m, d) of one signal hold any: their product against its spread if they did not.

    If both were noise, the variance of ``a . b`` would be at most ``E |a - b|^4 / kurtosis``: 12 in one
    dimension, 16 in two, reached when both are equally noisy.
    """
    noise = np.sqrt(np.median(np.einsum("mi,mi->m", a - b, a - b)))
    if noise > 0:  # readings that are wrong at the same time, by chance, must not count for much
        a, b = (
            v * np.minimum(1.0, CLIP * noise / np.linalg.norm(v, axis=1, keepdims=True).clip(1e-300)) for v in (a, b)
        )
    product = float(np.einsum("mi,mi->", a, b))
    spread = np.sqrt((np.einsum("mi,mi->m", a - b, a - b) ** 2).sum() / kurtosis)
    power = np.sqrt(float((a**2).sum()) * float((b**2).sum()))
    return product > THRESHOLD * spread and product > common * power


def _weight(steps: Steps, i: int) -> Array:
    return 1 / np.trace(steps.cov[0, :, 3:, 3:] + steps.cov[i, :, 3:, 3:], axis1=1, axis2=2)


def _direction(name: str, axes: tuple[str, str, str], v: Array) -> dict[str, float]:
    v = v * np.sign(v[np.argmax(np.abs(v))])
    return {f"{name}.{axis}": float(x) for axis, x in zip(axes, v, strict=True)}


def axis_words(v: Array, base: str) -> str:
    """A unit vector (3,) in the base's axes, by the name of the axis that it is along if it is."""
    largest = int(np.argmax(np.abs(v)))
    if abs(v[largest]) > 0.95:
        return f"{'xyz'[largest]} of {base}"
    v = v * np.sign(v[largest])
    return f"the direction ({v[0]:.2f}, {v[1]:.2f}, {v[2]:.2f}) of {base}"
