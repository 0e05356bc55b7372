"""A gyroscope alone beside a lidar: how it is turned and how late it is, and never where it sits."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calib_toolkit import Stream, calibrate_motions, se3
from calib_toolkit.plugins import registry
from calib_toolkit_datasets.bags.gyro import gyro_steps
from calib_toolkit_datasets.simulated import SimulatedSensor, measure
from calib_toolkit_datasets.simulation.vehicle import path

LATE = 0.03


@pytest.mark.long
@pytest.mark.parametrize("seed", [1, 2])
def test_a_gyroscope_tells_turns_and_time_alone(seed):
    true, rng, h = path(150.0, seed, "street"), np.random.default_rng(seed), 1e-3
    R = Rotation.from_euler("ZYX", [1.2, 0.05, -0.1]).as_matrix()
    T = se3.rigid(R, np.array([-1.0, 0.4, -0.8]))
    at = np.arange(true.stamps[0] + 3, true.stamps[-1] - 3, 0.01)
    turned = se3.vector(se3.relative(true.at(at - h) @ T, true.at(at + h) @ T))[:, 3:] / (2 * h)
    rates = turned + rng.normal(0, 0.002, turned.shape)
    rows, readings, bias = gyro_steps(at, rates, np.zeros_like(rates))
    assert bias is None
    streams = [
        measure(true, SimulatedSensor("velo", np.eye(4)), seed),
        Stream("imu", "odometry", (at + LATE)[rows], readings, has_scale=False),
    ]
    plugins = registry()
    found = {s.name: plugins.sensor(s.kind, s.name).estimate(s, plugins.sensors[s.kind].options()) for s in streams}
    c = calibrate_motions(found).calibration
    sigma = c.sigma[1]
    assert np.isnan(sigma[:3]).all()
    error = se3.log_so3(c.T_base_sensor[1][:3, :3] @ R.T)
    assert np.all(np.abs(error) < 4 * sigma[3:6])
    assert sigma[3:6].max() < 0.01
    assert abs(c.dt_base_sensor[1] + LATE) < 2e-3
