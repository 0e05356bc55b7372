"""Errors that stay as they are through a drive: a leaning travel, motions that seem late."""

from dataclasses import replace

import numpy as np
import pytest
from builders import drive, pose, turn_error
from numpy.testing import assert_allclose
from scipy.stats import chi2

from calib_toolkit import Config, calibrate_motions, se3
from calib_toolkit.joint import leaning
from calib_toolkit_datasets.simulated import SimulatedSensor, path

MOUNTS = {
    "velo": np.eye(4),
    "ins": pose(0.4, 0.1, 0.9, 0.01, 0.02, 0.03),
    "odo": pose(-0.5, 0.3, 0.2, 0.0, -0.1, 1.5),
}
LEAN = np.radians([0.2, 0.2, 0.4])
LATE = 2e-3
DRIVES = 12


def lasting(motions, ahead, rng):
    """The motions with faults drawn from what they then state. ahead: (3,) where the vehicle goes, sensor axes."""
    turned = motions.vec.copy()
    turned[:, :3] = turned[:, :3] @ se3.exp_so3(LEAN * rng.standard_normal(3)).T
    turned[:, 3:] = turned[:, 3:] @ se3.exp_so3(ahead * (np.linalg.norm(LEAN * ahead) * rng.standard_normal())).T
    return replace(replace(motions, vec=turned, lean=LEAN, late=LATE).shifted(LATE * rng.standard_normal()))


@pytest.fixture(scope="module")
def drives():
    """The truth less what was found of rotations (n, 2, 3) and clocks (n, 2), and the results."""
    turns, clocks, results = [], [], []
    for seed in range(DRIVES):
        rng = np.random.default_rng(seed)
        sensors = [SimulatedSensor(name, T) for name, T in MOUNTS.items()]
        motions = drive(path(40, seed, "street"), sensors, seed)
        faulty = {n: lasting(m, MOUNTS[n][0, :3], rng) for n, m in motions.items()}
        c = calibrate_motions(faulty, Config()).calibration
        true = list(MOUNTS.values())[1:]
        turns.append([turn_error(T[:3, :3], t[:3, :3]) for T, t in zip(c.T_base_sensor[1:], true, strict=True)])
        clocks.append(-c.dt_base_sensor[1:])
        results.append(c)
    return np.array(turns), np.array(clocks), results


def covariance(c, parameters):
    at = np.array([7 * k + i for k in (1, 2) for i in parameters])
    return c.covariance[np.ix_(at, at)]


@pytest.mark.parametrize("which", ["rotation", "clock"])
def test_sigmas_hold_where_errors_last(drives, which):
    turns, clocks, results = drives
    errors, parameters = (turns.reshape(DRIVES, 6), (3, 4, 5)) if which == "rotation" else (clocks, (6,))
    squared = sum(e @ np.linalg.solve(covariance(c, parameters), e) for e, c in zip(errors, results, strict=True))
    assert chi2.ppf(0.001, errors.size) < squared < chi2.ppf(0.999, errors.size)


def test_the_fault_of_the_base_is_shared(drives):
    """By all other sensors, which know each other's clocks no worse for it."""
    for c in drives[2]:
        both = covariance(c, (6,))
        assert both[0, 1] > 0.9 * LATE**2
        assert both[0, 0] > 1.9 * LATE**2


def test_stated_leans_in_base_axes():
    rng = np.random.default_rng(0)
    motions = drive(path(10, 0, "street"), [SimulatedSensor(n, T) for n, T in MOUNTS.items()], 0)
    stated = [replace(m, lean=rng.random(3)) for m in motions.values()]
    R = np.array([T[:3, :3] for T in MOUNTS.values()])
    found = leaning.stated(stated, R)
    base, ins, odo = (r @ np.diag(m.lean**2) @ r.T for r, m in zip(R, stated, strict=True))
    assert_allclose(found, np.block([[ins + base, base], [base, odo + base]]))


@pytest.mark.parametrize("lean", [0.1, 1e-4])
def test_turns_are_tilted_as_travel_leans_but_across_it_by_little(lean):
    motions = drive(path(10, 0, "street"), [SimulatedSensor(n, T) for n, T in MOUNTS.items()], 0)
    stated = [replace(m, lean=np.full(3, lean)) for m in motions.values()]
    R = np.array([T[:3, :3] for T in MOUNTS.values()])
    found = leaning.tilted(stated, R, np.array([8.0, 0.0, 0.0]))
    across = min(lean, leaning.TILT)
    turns = np.diag([lean, across, across]) ** 2
    assert_allclose(found[:3], 0.0)
    assert_allclose(found[3:6, 3:6], 2 * turns, atol=1e-15)
    assert_allclose(found[3:6, 9:12], turns, atol=1e-15)  # what the base has is shared
