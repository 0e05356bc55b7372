"""Recordings as the experiments see them, an experiment on one, and rows of its table."""

from dataclasses import replace

import numpy as np
from builders import drive, pose

from calib_toolkit import Config, Log
from calib_toolkit.evaluation import drives, experiment
from calib_toolkit.progress import Silent
from calib_toolkit.timing import TimingOptions
from calib_toolkit_datasets.simulated import SimulatedSensor, measure, path, truth

FAST = Config(method="paper", jobs=1, timing=TimingOptions(steps=1000))
PAPER = ("paper",)
SIGMA = (0.004, 0.004, 0.004, 2e-4, 2e-4, 2e-4)
SIDEWAYS, BACK = pose(0.2, 0.8, 1.1, -90, 0, -20), pose(0.1, -0.4, 1.2, -88, 1, 60)


def a_drive(sensors, seconds=60.0, seed=3, name="rough", clocks=None):
    """A simulated recording as the experiments see it."""
    true = path(seconds, seed, "rough")
    log = Log(None, {s.name: measure(true, s, seed) for s in sensors})
    names = tuple(s.name for s in sensors)
    return drives.Drive(name, log, drive(true, sensors, seed), clocks or names, truth(sensors))


def sensor(name, mount, **values):
    """One with a little noise."""
    return SimulatedSensor(name, mount, **{"sigma": SIGMA, **values})


def run(two, folder, repeats=3, seed=0, seconds=(20.0,), methods=PAPER):
    choices = experiment.Choices(repeats, seconds, methods)
    return experiment.run("pair", [two], folder, choices, replace(FAST, seed=seed), Silent())


def rows_of(values, **more):
    """Rows of the timing table with these errors and a sigma of one; None refused, nan not determined."""
    base = {"drive": "d", "seconds": "20", "spread": "1", "estimator": "paper", "sensor": "cam1", "note": ""}
    made = []
    for k, v in enumerate(values):
        row = {**base, **more, "repeat": str(k), "status": "found", "undetermined": ""}
        row |= {"dt_ms": "", "sigma_dt_ms": ""}
        if v is None:
            row |= {"status": "refused", "note": "it stood still"}
        elif np.isnan(v):
            row["undetermined"] = "dt"
        else:
            row |= {"dt_ms": str(v), "sigma_dt_ms": "1"}
        made.append(row)
    return made
