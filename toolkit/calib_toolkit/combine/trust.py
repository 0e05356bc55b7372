"""Which estimates to believe, and where it is the motion result that must give way.

The worst of the estimates that the rest contradicts is left out, again and again. But a motion result's own sigma can
be too small. So where all estimates of a sensor agree with one another, and contradict its motion whichever of them
is left out, the sigmas of that sensor's pose by motion are widened by the Birge ratio instead.

One estimate alone thus never overrules motion. Two do, be they of two pairs or by two metrics of one pair: a search
that ends in a wrong place does so by itself. What misleads both alike (wrong intrinsics, a clock that is far off) is
not noticed here.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from calib_toolkit.combine.evidence import Evidence
from calib_toolkit.combine.solution import Prior, Solution, counted, solve
from calib_toolkit.types import Calibration

Array = NDArray[np.float64]

SURE = 0.9999
"""Probability below which the normalised square of a disagreement must be."""


@dataclass(frozen=True)
class Trusted:
    """The solution that is left; used: which of the estimates are in it; notes: a sentence for each of the others and
    for each sensor whose motion gave way.
    """

    solution: Solution
    used: tuple[bool, ...]
    notes: tuple[str, ...]


def trusted(motion: Calibration, evidence: Sequence[Evidence]) -> Trusted:
    """Leaves out what contradicts the rest, worst first, and solves again each time.

    What only contradicted an estimate that was left out after it comes back in the end, the last one first.
    """
    left, wider, notes = list(evidence), np.ones(len(motion.names)), list[str]()
    out: list[tuple[Evidence, str]] = []
    while left:
        squares = [_disagreement(e, solve(Prior.of(motion, wider), _without(left, e))) for e in left]
        worst = int(np.argmax(squares))
        over = squares[worst] > 1
        suspects = {s for e in (left[worst : worst + 1] if over else left) for s in (e.a, e.b) if wider[s] == 1}
        ratios = [_birge(motion, wider, s, left) if s in suspects else 1.0 for s in range(len(wider))]
        blamed = int(np.argmax(ratios))
        if ratios[blamed] > 1:
            wider[blamed] = ratios[blamed]
            notes.append(
                f"the pose of {motion.names[blamed]} by motion contradicts the pairs it is in, which agree; its "
                f"sigmas were taken as {wider[blamed]:.1f} times as large"
            )
        elif over:
            why = f"the motion and the other pairs (normalised square {squares[worst]:.1f} times the limit)"
            e = left.pop(worst)
            out.append((e, f"{e.label} was left out: it contradicts {why}"))
        else:
            break
    for e, note in reversed(out):
        if _disagreement(e, solve(Prior.of(motion, wider), left)) <= 1:
            left.append(e)
        else:
            notes.append(note)
    kept = {id(e) for e in left}
    return Trusted(solve(Prior.of(motion, wider), left), tuple(id(e) in kept for e in evidence), tuple(notes))


def _without(evidence: Sequence[Evidence], one: Evidence) -> list[Evidence]:
    return [e for e in evidence if e is not one]


def _disagreement(e: Evidence, rest: Solution) -> float:
    """Normalised square of an estimate's residual under a rig that knows nothing of it, over its limit."""
    e = counted(e, rest)
    off, cov = rest.expected(e)
    return _over_limit(off, cov + e.cov)


def _birge(motion: Calibration, wider: Array, sensor: int, evidence: Sequence[Evidence]) -> float:
    """How many times too small a sensor's sigma by motion is, if its estimates agree on that; else one.

    They are asked without the motion of this sensor, and again without any, since that of others may be wrong, too.
    """
    others = [i for i, name in enumerate(motion.names) if name != motion.base]
    touching = [e for e in evidence if sensor in (e.a, e.b)]
    if sensor not in others or len(touching) < 2:
        return 1.0
    for free in (Prior.of(motion, wider, [sensor]), Prior.of(motion, wider, others)):
        off, cov = _off_motion(motion, solve(free, evidence), sensor)
        if _over_limit(off, cov) > 1 and all(
            _over_limit(*_off_motion(motion, rest, sensor)) > 1 and _disagreement(e, rest) <= 1
            for e, rest in ((e, solve(free, _without(evidence, e))) for e in touching)
        ):
            return float(np.sqrt(off @ np.linalg.solve(cov, off) / len(off)))
    return 1.0


def _off_motion(motion: Calibration, found: Solution, sensor: int) -> tuple[Array, Array]:
    """(6,) a sensor's pose less its pose by motion, which ``found`` does not know, and the covariance of that."""
    pose = slice(7 * sensor, 7 * sensor + 6)
    return found.change[pose], motion.covariance[pose, pose] + found.covariance[pose, pose]


def _over_limit(off: Array, cov: Array) -> float:
    return float(off @ np.linalg.solve(cov, off) / chdtri(len(off), 1 - SURE))
