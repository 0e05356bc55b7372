"""A rig on small drives, by both methods, and what came out of it against the truth."""

from pathlib import Path

import numpy as np
import pytest
from builders import CAMERA, INS, LIDAR, pose, turn_error

from calib_toolkit import Config, Log, Motions, se3
from calib_toolkit.timing import TimingOptions
from calib_toolkit_datasets.simulated import SimulatedSensor, measure, path, truth

SENSORS = [
    SimulatedSensor("velo", LIDAR),
    SimulatedSensor("ins", INS, dt=0.02, rate=20.0),
    SimulatedSensor("cam", CAMERA, dt=-0.05, has_scale=False),
]
STREET, ROUGH = path(60, 0, "street"), path(60, 0, "rough")
QUICK = Config(method="paper", jobs=1, timing=TimingOptions(steps=2000))
JOINT = Config(jobs=1)
CONFIGS = {"paper": QUICK, "joint": JOINT}
METHODS = pytest.mark.parametrize("config", CONFIGS.values(), ids=CONFIGS)
NAMES = np.array(["x", "y", "z", "rx", "ry", "rz", "dt"])


def log_of(true, sensors=SENSORS, seed=0):
    return Log(Path("drive"), {s.name: measure(true, s, seed) for s in sensors})


def flat(n=200, noise=0.0, turning=True):
    """Two flat odometries, x y yaw and nothing else, as of robots that live in the plane."""
    rng, base = np.random.default_rng(0), np.zeros((n, 6))
    base[:, 0] = 1.0 if turning else 0.0
    base[:, 5] = 0.05 * np.sin(np.arange(n) * 0.1) * turning
    T = pose(1.0, 0.5, 0, 0, 0, 20)
    stamps, cov = 0.1 * np.arange(n + 1), np.broadcast_to(1e-6 * np.eye(6), (n, 6, 6))
    other = se3.vector(se3.invert(T) @ se3.matrix(base) @ T)
    for vec in (base, other):
        vec[:, [0, 1, 5]] += noise * rng.normal(size=(n, 3))
    return {name: Motions(stamps[:-1], stamps[1:], vec, cov) for name, vec in (("a", base), ("b", other))}


def sigmas(found, sensors=SENSORS):
    """(n-1, 7) errors of all sensors but the base, in sigmas as stated."""
    true = truth(list(sensors))
    turned = turn_error(found.T_base_sensor[:, :3, :3], true.T_base_sensor[:, :3, :3])
    shifted = true.T_base_sensor[:, :3, 3] - found.T_base_sensor[:, :3, 3]
    error = np.column_stack([shifted, turned, true.dt_base_sensor - found.dt_base_sensor])
    return error[1:] / found.sigma[1:]


def open_parameters(found, name):
    return set(NAMES[~found.determined[found.index(name)]])
