"""Which directions a drive measured, told without trusting anyone's stated noise, and what to drive instead.

An information matrix made of noisy motions holds the noise too, and so reports a finite sigma for a direction that
was never excited. Here the excitation is the product of two sensors' readings of the same turn: their noises
are independent, so it is zero on average wherever nothing moved. A direction counts as measured when its
excitation stands so many standard deviations above zero, with the spread taken from the steps themselves.
"""

from collections.abc import Hashable, Sequence

import numpy as np
from numpy.typing import NDArray

from calib_toolkit import se3
from calib_toolkit.sync import Chain, Steps, angles, common_span
from calib_toolkit.types import Undetermined

Array = NDArray[np.float64]

DIRECTION_THRESHOLD = 4.0
"""Standard deviations for a direction: without any motion the best of three reaches about three."""
TIME_THRESHOLD = 5.0
"""The same for time, where the offset was chosen among hundreds for its agreement."""


def unmeasured_times(names: Sequence[str], chains: Sequence[Chain], clocks: Sequence[Hashable]) -> list[Undetermined]:
    """Sensors on clocks of which none's angular speed changes together with the first sensor's.

    chains: (n,) on one clock. clocks: (n,) sensors with equal ones share an offset.
    """
    lo, hi = common_span(chains)
    window = max(c.period for c in chains)
    angle, _ = angles(chains, np.arange(lo, hi - window, window), window)
    slope = np.diff(angle, axis=1)
    product = slope[0] * slope
    score = np.nansum(product, axis=1) / np.sqrt(np.nansum(product**2, axis=1)).clip(1e-300)
    measured = {clocks[0], *(c for c, s in zip(clocks, score, strict=True) if s > TIME_THRESHOLD)}
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
    everything = np.broadcast_to(np.eye(3), (len(steps), 3, 3))
    found = []
    for i, name in enumerate(names[1:], start=1):
        null = _null_directions(_excitation(w[0], w[i], _weight(steps, i), everything))
        for v in null:
            why = "turned about that axis only" if len(null) == 1 else "hardly turned"
            found.append(
                Undetermined(
                    _direction(name, ("rx", "ry", "rz"), v),
                    f"the rotation of {name} about {_words(v, names[0])} was not determined: the vehicle {why}; "
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
            keep = np.broadcast_to(np.eye(3), (len(steps), 3, 3))
            if not steps.has_scale[i]:  # how far a camera went is not known, so what lies along its motion is not
                u = p[i] / np.linalg.norm(p[i], axis=1, keepdims=True).clip(1e-12)
                keep = np.eye(3) - u[:, :, None] * u[:, None, :]
            null = _null_directions(_excitation(w[0], w[i], _weight(steps, i), keep))
            why = (
                "the vehicle hardly turned about any other direction; drive over a ramp, kerbs or rough ground, "
                "or measure it by hand"
            )
        found += [
            Undetermined(
                _direction(name, ("x", "y", "z"), v),
                f"the position of {name} along {_words(v, names[0])} was not determined: {why}",
            )
            for v in null
        ]
    return found


def _excitation(w_base: Array, w_sensor: Array, weight: Array, keep: Array) -> Array:
    """(m, 3, 3) of each step: what a small change would do as both sensors tell it, multiplied."""
    product = np.swapaxes(se3.skew(w_base), 1, 2) @ keep @ se3.skew(w_sensor) * weight[:, None, None]
    return 0.5 * (product + np.swapaxes(product, 1, 2))


def _weight(steps: Steps, i: int) -> Array:
    return 1 / np.trace(steps.cov[0, :, 3:, 3:] + steps.cov[i, :, 3:, 3:], axis1=1, axis2=2)


def _null_directions(excitation: Array) -> Array:
    """(k, 3) eigenvectors of the summed excitation that do not stand out of its spread."""
    _, vectors = np.linalg.eigh(excitation.sum(axis=0))
    along = np.einsum("ai,mab,bi->mi", vectors, excitation, vectors)
    score = along.sum(axis=0) / np.sqrt((along**2).sum(axis=0)).clip(1e-300)
    return vectors.T[score < DIRECTION_THRESHOLD]


def _direction(name: str, axes: tuple[str, str, str], v: Array) -> dict[str, float]:
    v = v * np.sign(v[np.argmax(np.abs(v))])
    return {f"{name}.{axis}": float(x) for axis, x in zip(axes, v, strict=True)}


def _words(v: Array, base: str) -> str:
    largest = int(np.argmax(np.abs(v)))
    if abs(v[largest]) > 0.95:
        return f"{'xyz'[largest]} of {base}"
    v = v * np.sign(v[largest])
    return f"the direction ({v[0]:.2f}, {v[1]:.2f}, {v[2]:.2f}) of {base}"
