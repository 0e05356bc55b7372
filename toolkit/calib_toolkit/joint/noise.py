"""How noisy each sensor is and which of its readings are wrong, both told by the residuals.

Readings that fit badly count less at first (a Student's t); once that has settled, those beyond a chi-square gate do
not count and all others count in full, so that the covariance is that of least squares. Stated variances are
multiplied by a scale, so that the residuals come out as large as they must be with the latents fitted (REML).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

TRUSTED = 0.9999
"""Share of good readings that the gate lets through."""
SETTLING = 4
"""Rounds in which readings are weighed by how well they fit."""
LATE = 12
"""Rounds after which no reading that was rejected comes back."""
FREEDOM = 4.0
"""Of the Student's t."""
STATED = 20.0
"""The scale that was stated counts as much as so many readings' residuals."""
VISIBLE = 100.0
"""Residual degrees of freedom from which a sensor's noise can be told by itself."""
LEVERAGE = 0.5
"""Least share of a residual that is taken to be left by the fit: less would make a small fault of the model large."""
DAMPED = 0.7


@dataclass(frozen=True)
class Readings:
    """One sensor's readings in one round.

    squared: (n,) normalised squared residuals at the present scale. expected: (n,) what they are on average: less
    than the size of a residual where the latents are fitted to it, more where they are not. size: numbers in one
    residual. usable: (n,).
    """

    squared: Array
    expected: Array
    size: int
    usable: NDArray[np.bool_]


def expected(size: int, fitted: Array, weight: Array) -> Array:
    """(n,) of residuals of so many numbers. fitted: (n,) share of their variance that what is fitted to them has.

    weight: (n,) how much each counted in the fit.
    """
    return size + (1 - 2 * weight) * fitted


def weights(readings: Readings, round_: int, before: Array) -> Array:
    """(n,) from 0 to 1: how much each reading counts in the next round. before: (n,) and in this one."""
    fit = readings.squared * readings.size / np.maximum(readings.expected, LEVERAGE * readings.size)
    if round_ < SETTLING:
        return np.where(readings.usable, np.minimum(1.0, (FREEDOM + readings.size) / (FREEDOM + fit)), 0.0)
    # at last none comes back: one on the border would come and go for ever
    candidate = readings.usable & ((round_ < LATE) | (before > 0))
    return (candidate & (fit < chi2.ppf(TRUSTED, readings.size))).astype(float)


def ratios(
    sensors: Sequence[Readings], kept: Sequence[Mask], round_: int, scales: Array, together: Sequence[int] = ()
) -> Array:
    """(n,) by which each sensor's scale (n,) should be multiplied. kept: (n) of (m,) to tell it from.

    together: sensors of which only the sum of their noise shows: all get the same.
    """
    if round_ < SETTLING:
        found = np.array([_median(r) for r in sensors])
        if together:
            found[list(together)] = np.median(found[list(together)])
        return found
    total = np.array([r.squared[k].sum() for r, k in zip(sensors, kept, strict=True)])
    freedom = np.maximum(freedoms(sensors, kept), 0.0)
    stated = STATED / scales
    if together:
        for values in (total, freedom, stated):
            values[list(together)] = values[list(together)].mean()
    return (total + stated) / (freedom + STATED)


def freedoms(sensors: Sequence[Readings], kept: Sequence[Mask]) -> Array:
    """(n,) degrees of freedom that each sensor's residuals have left."""
    return np.array([r.expected[k].sum() for r, k in zip(sensors, kept, strict=True)])


def damped(ratio: Array, round_: int) -> Array:
    """(n,) the step to take towards it: sensors exchange noise, and would swing."""
    most = 30.0 if round_ < SETTLING else 4.0
    return np.clip(ratio, 1 / most, most) ** (0.8 if round_ < 2 else DAMPED)


def _median(r: Readings) -> float:
    used = r.usable & (r.expected > 1e-3 * r.size)
    if not used.any():
        return 1.0
    return float(np.median(r.squared[used] * r.size / r.expected[used]) / chi2.median(r.size))
