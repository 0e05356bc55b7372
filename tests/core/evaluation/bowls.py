"""A metric whose best pose is known, and a lidar and cameras for it to compare."""

from pathlib import Path

import numpy as np
from builders import CAMERA, INS, LIDAR, drive

from calib_toolkit import Config, CostMetric, Log, se3
from calib_toolkit.evaluation import drives, experiment, sections
from calib_toolkit.plugins import Registry
from calib_toolkit.progress import Silent
from calib_toolkit.timing import TimingOptions
from calib_toolkit_datasets.simulated import SimulatedSensor, measure, path, truth

FAST = Config(method="paper", jobs=1, timing=TimingOptions(steps=300), appearance=("bowl",), moments=12)
SIGMA = (0.004, 0.004, 0.004, 2e-4, 2e-4, 2e-4)
SHAPE = np.array([10.0] * 3 + [100.0] * 3)
NOISE = np.array([0.005] * 3 + [0.0005] * 3)


class Bowl(CostMetric):
    """Costs like a bowl around the true pose, which is a little different at every moment."""

    id = "bowl"

    def __init__(self, best, noise=NOISE, shift=0.0):
        self.best, self.noise, self.shift = best, noise, shift

    def accepts(self, kind_a, kind_b):
        return True

    def prepare(self, pair, options):
        return np.random.default_rng(int(pair.selected[0, 1])).normal(size=6) * self.noise + self.shift

    def cost(self, T_a_b, pair):
        return float(self.costs(T_a_b[None], pair)[0])

    def costs(self, T_a_b, moment):
        turn = se3.log_so3(T_a_b[:, :3, :3] @ self.best[:3, :3].T)
        error = np.column_stack([T_a_b[:, :3, 3] - self.best[:3, 3], turn])
        return np.sum(((error - moment) * SHAPE) ** 2, axis=1)


class Installed(Registry):
    """A registry that holds these metrics and nothing else."""

    def __init__(self, **metrics):
        super().__init__(())
        self.there = metrics

    @property
    def metrics(self):
        return self.there


def a_drive(seconds=25.0, cameras=1, name="rough"):
    """A lidar and cameras as the experiments see them."""
    sensors = [SimulatedSensor("velo", LIDAR, sigma=SIGMA)]
    mounts = (CAMERA, INS)[:cameras]
    sensors += [SimulatedSensor(f"cam{k}", T, dt=0.02, has_scale=False, sigma=SIGMA) for k, T in enumerate(mounts)]
    true = path(seconds, 3, "rough")
    log = Log(Path(name), {s.name: measure(true, s, 3) for s in sensors})
    return drives.Drive(name, log, drive(true, sensors, 3), tuple(s.name for s in sensors), truth(sensors))


def section_of(one, name="appearance", repeat=0, wider=1.0, seconds=20.0):
    draw = sections.Draw(0, seconds, 0.0, repeat)
    return sections.with_sight(sections.cut(draw, [one], name, 0), draw, one, wider)


def run(name, one, folder, repeats=2, **choices):
    chosen = experiment.Choices(repeats, (100.0,), ("paper",), **choices)
    return experiment.run(name, [one], folder, chosen, FAST, Silent())
