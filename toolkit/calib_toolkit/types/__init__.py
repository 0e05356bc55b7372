"""The data that flows between the rooms: immutable, struct-of-arrays."""

from calib_toolkit.types.calibration import Calibration, Transform, Undetermined
from calib_toolkit.types.measured import Measured
from calib_toolkit.types.motions import Motions, Trajectory
from calib_toolkit.types.pairs import Pair, PairEstimate
from calib_toolkit.types.readings import Fix, LazyReadings, MotionReading, PoseReading, Scan
from calib_toolkit.types.result import Result
from calib_toolkit.types.streams import CameraIntrinsics, Log, Stream, Topic

__all__ = [
    "Calibration",
    "CameraIntrinsics",
    "Fix",
    "LazyReadings",
    "Log",
    "Measured",
    "MotionReading",
    "Motions",
    "Pair",
    "PairEstimate",
    "PoseReading",
    "Result",
    "Scan",
    "Stream",
    "Topic",
    "Trajectory",
    "Transform",
    "Undetermined",
]
