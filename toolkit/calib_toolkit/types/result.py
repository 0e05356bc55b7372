"""Everything one run found."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from calib_toolkit.types.calibration import Calibration
from calib_toolkit.types.pairs import PairEstimate


@dataclass(frozen=True)
class Result:
    """The best calibration, the one after each stage, and how they came about."""

    calibration: Calibration
    stages: Mapping[str, Calibration]
    pair_estimates: tuple[PairEstimate, ...] = ()
    statistics: Mapping[str, Any] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()
    configuration: Mapping[str, Any] = field(default_factory=dict)

    @property
    def complete(self) -> bool:
        """Whether every parameter was determined and no data were skipped (exit status 0 rather than 3)."""
        return not self.warnings and not self.calibration.undetermined
