"""The joint estimator: every reading once, in one likelihood over all sensors, with the vehicle's motion latent."""

from calib_toolkit.joint.estimator import calibrate as calibrate
from calib_toolkit.joint.estimator import clock_offsets as clock_offsets
