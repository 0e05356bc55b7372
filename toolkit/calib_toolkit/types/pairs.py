"""Two sensors that see the same place: what a metric gets, and what it returns."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from calib_toolkit.types.calibration import Transform
from calib_toolkit.types.motions import Motions, Trajectory
from calib_toolkit.types.streams import Stream

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Pair:
    """Everything known about two sensors before their appearance is compared.

    a, b: both streams. motion_a, motion_b: how each moved, on its own stamps. dt_a_b: seconds added to b's stamps to
    get a's time. selected: (m, 2) indices of the readings of a and of b to compare. prior: the motion stage's
    ``T_a_b``; its covariance is finite, and wide where the drive told nothing.
    """

    a: Stream
    b: Stream
    motion_a: Motions | Trajectory
    motion_b: Motions | Trajectory
    dt_a_b: float
    selected: NDArray[np.int64]
    prior: Transform

    def __len__(self) -> int:
        return len(self.selected)

    def __getitem__(self, rows: slice) -> "Pair":
        return replace(self, selected=self.selected[rows])


@dataclass(frozen=True)
class PairEstimate:
    """What one metric found for one pair: appearance evidence alone, the prior divided out.

    transform: its covariance is large along what the pair does not show. by_clock: (6,) how the estimate moves with
    ``dt_a_b``, in the order and axes of the covariance, per second; that error is not in the covariance. converged:
    False if the estimate is not to be used, with the reason in ``note``.
    """

    metric: str
    transform: Transform
    by_clock: Array = field(default_factory=lambda: np.zeros(6))
    converged: bool = True
    note: str = ""
    statistics: Mapping[str, float] = field(default_factory=dict)
