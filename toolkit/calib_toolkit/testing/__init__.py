"""What a plugin author's tests need: the conformance kit for sensors.

``test_my_sensor = parametrize_with_sensor_checks([SensorCase(MY_SENSOR, simulate)])``, in any test file.
"""

from calib_toolkit.testing.case import SensorCase
from calib_toolkit.testing.checks import CHECKS
from calib_toolkit.testing.conformance import parametrize_with_sensor_checks
from calib_toolkit.testing.drives import FORWARD, STILL, TURNING, Drive

__all__ = ["CHECKS", "FORWARD", "STILL", "TURNING", "Drive", "SensorCase", "parametrize_with_sensor_checks"]
