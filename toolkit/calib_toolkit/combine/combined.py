"""The combination: what is used of the estimates, the rig that follows, and what it leaves undetermined."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calib_toolkit import assembly, observability
from calib_toolkit.combine.factors import factor, labelled, unusable
from calib_toolkit.combine.solution import Solution
from calib_toolkit.combine.trust import trusted
from calib_toolkit.types import Calibration, PairEstimate

Array = NDArray[np.float64]

VAGUE = np.array([observability.VAGUE_SHIFT] * 3 + [np.radians(observability.VAGUE_TURN_DEG)] * 3 + [0.0])
"""Sigma above which a number is not determined; appearance never determines a clock."""


@dataclass(frozen=True)
class Combined:
    """One consistent rig. used: for each estimate whether it is in it. notes: a sentence for each that is not, and
    for each sensor whose motion result had to give way.
    """

    calibration: Calibration
    used: tuple[bool, ...]
    notes: tuple[str, ...]


def combine(motion: Calibration, estimates: Sequence[PairEstimate]) -> Combined:
    """The rig that is most likely given the motion result and the estimates of pairs (section VII-D).

    All poses and clock offsets move together: the motion result counts with its joint covariance, each estimate with
    its own and with the clock's error that ``by_clock`` carries into it; an estimate without scale by its direction.
    Estimates have errors in common (:mod:`~calib_toolkit.combine.shared`), and those that contradict the rest are
    left out (:mod:`~calib_toolkit.combine.trust`). No pair's covariance is larger than that of an estimate of it that
    was used (its clock's error included), or than motion's unless that gave way.
    """
    reasons = [unusable(e, motion.names) for e in estimates]
    usable = [i for i, reason in enumerate(reasons) if not reason]
    found = trusted(motion, [factor(estimates[i], motion.names) for i in usable])
    used = np.zeros(len(estimates), dtype=bool)
    used[usable] = found.used
    return Combined(
        _calibration(motion, found.solution), tuple(map(bool, used)), left_out(estimates, reasons) + found.notes
    )


def left_out(estimates: Sequence[PairEstimate], reasons: Sequence[str]) -> tuple[str, ...]:
    """A sentence for each estimate that there is a reason not to use."""
    return tuple(f"{labelled(e)} was left out: {why}" for e, why in zip(estimates, reasons, strict=True) if why)


def _calibration(motion: Calibration, solution: Solution) -> Calibration:
    n = len(motion.names)
    sigma = np.sqrt(np.diag(solution.covariance)).reshape(n, 7)
    vague = ~motion.determined & (sigma > VAGUE)
    open_ = [u for u in motion.undetermined if np.any(vague & ~assembly.determined(motion.names, [u]))]
    return replace(
        motion,
        T_base_sensor=solution.T,
        dt_base_sensor=motion.dt_base_sensor + solution.late,
        covariance=solution.stated,
        determined=assembly.determined(motion.names, open_) & ~vague,
        undetermined=tuple(open_),
    )
