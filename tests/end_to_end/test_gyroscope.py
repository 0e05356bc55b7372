"""A gyroscope alone beside a lidar: how it is turned and how late it is, and never where it sits."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calib_toolkit import Stream, calibrate_motions, se3
from calib_toolkit.plugins import registry
from calib_toolkit_datasets.gyro import gyro_steps
from calib_toolkit_datasets.simulated import SimulatedSensor, measure
from calib_toolkit_datasets.simulation.vehicle import GRID, path

LATE = 0.03


def rates_of_turn(true, T, at):
    """What a gyroscope at T reads at instants. The path's rates jump every 5 ms: it would seem up to 2.5 ms off."""
    poses = true.T_world_vehicle @ T
    rates = se3.vector(se3.relative(poses[:-1], poses[1:]))[:, 3:] / GRID
    return np.column_stack([np.interp(at, true.stamps[:-1] + GRID / 2, rate) for rate in rates.T])


@pytest.mark.long
@pytest.mark.parametrize(("seed", "hertz"), [(1, 100), (2, 200), (3, 400)])
def test_a_gyroscope_tells_turns_and_time_alone(seed, hertz):
    true, rng = path(60.0, seed, "street"), np.random.default_rng(seed)
    R = Rotation.from_euler("ZYX", [1.2, 0.05, -0.1]).as_matrix()
    T = se3.rigid(R, np.array([-1.0, 0.4, -0.8]))
    at = np.arange(true.stamps[0] + 2 + rng.uniform(0, 0.05), true.stamps[-1] - 2, 1 / hertz)
    rates = rates_of_turn(true, T, at) + rng.normal(0, 0.002, (len(at), 3))
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
    assert abs(c.dt_base_sensor[1] + LATE) < 3 * sigma[6] < 2e-3
