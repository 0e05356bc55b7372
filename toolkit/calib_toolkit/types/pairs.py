"""Two sensors that see the same place: what a metric gets, and what it returns."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from calib_toolkit.types.calibration import Transform
from calib_toolkit.types.motions import Motions, Trajectory
from calib_toolkit.types.streams import Stream

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Pair:
    """Everything known about two sensors before their appearance is compared.

    a, b: both streams. motion_a, motion_b: how each moved. dt_a_b: seconds added to b's stamps to get a's time.
    selected: (m, 2) indices of the readings of a and of b to compare. prior: the motion stage's ``T_a_b``.
    """

    a: Stream
    b: Stream
    motion_a: Motions | Trajectory
    motion_b: Motions | Trajectory
    dt_a_b: float
    selected: NDArray[np.int64]
    prior: Transform


@dataclass(frozen=True)
class PairEstimate:
    """What one metric found for one pair: appearance evidence alone, the prior divided out.

    converged: False if the estimate is not to be used, with the reason in ``note``.
    """

    metric: str
    transform: Transform
    converged: bool = True
    note: str = ""
    statistics: Mapping[str, float] = field(default_factory=dict)
