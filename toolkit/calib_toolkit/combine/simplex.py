"""The paper's own combination (section VII-D): the poses that make all pairwise transforms together most probable."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from calib_toolkit import likelihood, se3
from calib_toolkit.combine.combined import Combined, left_out
from calib_toolkit.combine.factors import Factor, factor, unusable
from calib_toolkit.combine.solution import linear
from calib_toolkit.types import Calibration, PairEstimate

Array = NDArray[np.float64]


def combine_paper(motion: Calibration, estimates: Sequence[PairEstimate]) -> Combined:
    """Nelder-Mead over the poses, started at the estimates against the base; every converged estimate is used.

    The motion result counts as one more transform of every pair, each on its own, as the paper has it. The covariance
    is the inverse of the curvature of the summed log-probabilities (Cramer-Rao): what enters by several pairs counts
    as independent, so it is too small. Clock offsets, and what is determined, stay as they were.
    """
    reasons = [unusable(e, motion.names) for e in estimates]
    appearance = [factor(e, motion.names) for e, why in zip(estimates, reasons, strict=True) if not why]
    everything = [*_by_motion(motion), *appearance]
    start, base, n = _start(motion, appearance), motion.index(motion.base), len(motion.names)
    others = [i for i in range(n) if i != base]
    rows = (7 * np.array(others)[:, None] + np.arange(6)).ravel()
    weights = [np.linalg.inv(f.cov) for f in everything]
    late = np.zeros(n)

    def moved(change: Array) -> Array:
        T, parts = start.copy(), change.reshape(-1, 6)
        R = se3.exp_so3(parts[:, 3:]) @ start[others, :3, :3]
        T[others] = se3.rigid(R, start[others, :3, 3] + parts[:, :3])
        return T

    def log_probability(change: Array) -> float:
        T = moved(change)
        off = (f.residual(T, late) for f in everything)
        return -0.5 * float(sum(r @ w @ r for r, w in zip(off, weights, strict=True)))

    def bound(T: Array) -> Array:
        J = [linear(f, T, late)[1][:, rows] for f in everything]
        return np.asarray(np.linalg.inv(sum(j.T @ w @ j for j, w in zip(J, weights, strict=True))))

    T = moved(likelihood.maximise(log_probability, np.zeros(len(rows)), bound(start)))
    times = 7 * np.arange(n) + 6
    covariance = np.zeros_like(motion.covariance)
    covariance[np.ix_(times, times)] = motion.covariance[np.ix_(times, times)]
    covariance[np.ix_(rows, rows)] = bound(T)
    found = replace(motion, T_base_sensor=T, covariance=covariance)
    return Combined(found, tuple(not why for why in reasons), left_out(estimates, reasons))


def _by_motion(motion: Calibration) -> list[Factor]:
    """The motion result as a transform of every pair."""
    pairs = [(motion.names[i], motion.names[j]) for i, j in likelihood.all_pairs(len(motion.names))]
    transforms = [replace(motion.between(a, b), has_scale=True) for a, b in pairs]
    return [factor(PairEstimate("motion", t), motion.names) for t in transforms]


def _start(motion: Calibration, appearance: Sequence[Factor]) -> Array:
    """(n, 4, 4) where the first estimate of each sensor against the base puts it, or else motion."""
    T, base = motion.T_base_sensor.copy(), motion.index(motion.base)
    for f in reversed([f for f in appearance if f.has_scale]):
        if f.a == base:
            T[f.b] = f.T_a_b
        elif f.b == base:
            T[f.a] = se3.invert(f.T_a_b)
    return T
