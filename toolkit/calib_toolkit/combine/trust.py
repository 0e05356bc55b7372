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

from calib_toolkit.combine.factors import Factor
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


def trusted(motion: Calibration, factors: Sequence[Factor]) -> Trusted:
    """Leaves out what contradicts the rest, worst first, and solves again each time.

    What only contradicted an estimate that was left out after it comes back in the end, the last one first.
    """
    left, wider, notes = list(factors), np.ones(len(motion.names)), list[str]()
    out: list[tuple[Factor, str]] = []
    while left:
        squares = [_disagreement(f, solve(Prior.of(motion, wider), _without(left, f))) for f in left]
        worst = int(np.argmax(squares))
        over = squares[worst] > 1
        suspects = {s for f in (left[worst : worst + 1] if over else left) for s in (f.a, f.b) if wider[s] == 1}
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
            f = left.pop(worst)
            out.append((f, f"{f.label} was left out: it contradicts {why}"))
        else:
            break
    for f, note in reversed(out):
        if _disagreement(f, solve(Prior.of(motion, wider), left)) <= 1:
            left.append(f)
        else:
            notes.append(note)
    kept = {id(f) for f in left}
    return Trusted(solve(Prior.of(motion, wider), left), tuple(id(f) in kept for f in factors), tuple(notes))


def _without(factors: Sequence[Factor], one: Factor) -> list[Factor]:
    return [f for f in factors if f is not one]


def _disagreement(f: Factor, rest: Solution) -> float:
    """Normalised square of an estimate's residual under a rig that knows nothing of it, over its limit."""
    f = counted(f, rest)
    off, cov = rest.expected(f)
    return _over_limit(off, cov + f.cov)


def _birge(motion: Calibration, wider: Array, sensor: int, factors: Sequence[Factor]) -> float:
    """How many times too small a sensor's sigma by motion is, if its estimates agree on that; else one.

    They are asked without the motion of this sensor, and again without any, since that of others may be wrong, too.
    """
    others = [i for i, name in enumerate(motion.names) if name != motion.base]
    touching = [f for f in factors if sensor in (f.a, f.b)]
    if sensor not in others or len(touching) < 2:
        return 1.0
    for free in (Prior.of(motion, wider, [sensor]), Prior.of(motion, wider, others)):
        off, cov = _off_motion(motion, solve(free, factors), sensor)
        if _over_limit(off, cov) > 1 and all(
            _over_limit(*_off_motion(motion, rest, sensor)) > 1 and _disagreement(f, rest) <= 1
            for f, rest in ((f, solve(free, _without(factors, f))) for f in touching)
        ):
            return float(np.sqrt(off @ np.linalg.solve(cov, off) / len(off)))
    return 1.0


def _off_motion(motion: Calibration, found: Solution, sensor: int) -> tuple[Array, Array]:
    """(6,) a sensor's pose less its pose by motion, which ``found`` does not know, and the covariance of that."""
    pose = slice(7 * sensor, 7 * sensor + 6)
    return found.change[pose], motion.covariance[pose, pose] + found.covariance[pose, pose]


def _over_limit(off: Array, cov: Array) -> float:
    return float(off @ np.linalg.solve(cov, off) / chdtri(len(off), 1 - SURE))
