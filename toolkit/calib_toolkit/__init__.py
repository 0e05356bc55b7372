"""Calibration of a vehicle's lidars, cameras and GPS/INS from an ordinary drive.

``open_log`` reads a recording, ``calibrate`` turns it into a :class:`Result`. Plugins need :class:`Sensor`,
:class:`Dataset`, :class:`CostMetric`, :class:`Exporter`, ``hookimpl`` and the types.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from calib_toolkit.cli.bars import bars as bars
    from calib_toolkit.config import Config as Config
    from calib_toolkit.errors import CalibrationError as CalibrationError
    from calib_toolkit.errors import DataError as DataError
    from calib_toolkit.hookspecs import CostMetric as CostMetric
    from calib_toolkit.hookspecs import Dataset as Dataset
    from calib_toolkit.hookspecs import Exporter as Exporter
    from calib_toolkit.hookspecs import NoOptions as NoOptions
    from calib_toolkit.hookspecs import ReadContext as ReadContext
    from calib_toolkit.hookspecs import Sensor as Sensor
    from calib_toolkit.hookspecs import SensorTable as SensorTable
    from calib_toolkit.hookspecs import Written as Written
    from calib_toolkit.hookspecs import hookimpl as hookimpl
    from calib_toolkit.paths import poses_at as poses_at
    from calib_toolkit.pipeline import calibrate as calibrate
    from calib_toolkit.pipeline import calibrate_motions as calibrate_motions
    from calib_toolkit.pipeline import open_log as open_log
    from calib_toolkit.progress import Progress as Progress
    from calib_toolkit.result_file import read_calibration as read_calibration
    from calib_toolkit.result_file import write_calibration as write_calibration
    from calib_toolkit.types import Calibration as Calibration
    from calib_toolkit.types import CameraIntrinsics as CameraIntrinsics
    from calib_toolkit.types import Fix as Fix
    from calib_toolkit.types import LazyReadings as LazyReadings
    from calib_toolkit.types import Log as Log
    from calib_toolkit.types import MotionReading as MotionReading
    from calib_toolkit.types import Motions as Motions
    from calib_toolkit.types import Pair as Pair
    from calib_toolkit.types import PairEstimate as PairEstimate
    from calib_toolkit.types import PoseReading as PoseReading
    from calib_toolkit.types import Result as Result
    from calib_toolkit.types import Scan as Scan
    from calib_toolkit.types import Stream as Stream
    from calib_toolkit.types import Trajectory as Trajectory
    from calib_toolkit.types import Transform as Transform

_HOMES = {
    "calib_toolkit.cli.bars": ["bars"],
    "calib_toolkit.config": ["Config"],
    "calib_toolkit.errors": ["CalibrationError", "DataError"],
    "calib_toolkit.hookspecs": [
        *(
            "CostMetric",
            "Dataset",
            "Exporter",
            "NoOptions",
            "ReadContext",
            "Sensor",
            "SensorTable",
            "Written",
            "hookimpl",
        ),
    ],
    "calib_toolkit.paths": ["poses_at"],
    "calib_toolkit.pipeline": ["calibrate", "calibrate_motions", "open_log"],
    "calib_toolkit.progress": ["Progress"],
    "calib_toolkit.result_file": ["read_calibration", "write_calibration"],
    "calib_toolkit.types": [
        *(
            "Calibration",
            "CameraIntrinsics",
            "Fix",
            "LazyReadings",
            "Log",
            "MotionReading",
            "Motions",
            "Pair",
        ),
        *("PairEstimate", "PoseReading", "Result", "Scan", "Stream", "Trajectory", "Transform"),
    ],
}
_HOME_OF = {name: home for home, names in _HOMES.items() for name in names}
__all__ = sorted(_HOME_OF)


def __getattr__(name: str) -> Any:
    """Names are imported when first used, so that ``calib-toolkit --help`` does not wait for SciPy."""
    if name in _HOME_OF:
        return getattr(import_module(_HOME_OF[name]), name)
    raise AttributeError(f"module 'calib_toolkit' has no attribute '{name}'")
