"""A pair of sensors on a drive and a metric that costs like a bowl around the true pose."""

import numpy as np
from builders import bowl

from calib_toolkit import CostMetric, Motions, Pair, Stream, Transform, se3
from calib_toolkit.appearance import pairs

STEPS = 100
SIGMA = np.array([0.1, 0.1, 0.2, 0.01, 0.01, 0.01])
TRUE = se3.matrix([0.3, -0.2, 0.5, 0.1, 1.5, -0.4])


def driven(speed=5.0, turn=0.1, standing=()):
    """A sensor that drives round a bend at 10 Hz, and stands where it is told to."""
    stamps = 0.1 * np.arange(STEPS + 1)
    vec = np.zeros((STEPS, 6))
    vec[:, 0], vec[:, 5] = 0.1 * speed, 0.1 * turn
    vec[list(standing)] = 0.0
    return Motions(stamps[:-1], stamps[1:], vec, np.tile(1e-8 * np.eye(6), (STEPS, 1, 1)))


def pair_at(T, dt=0.0, sigma=SIGMA, motion=None):
    motion = motion or driven()
    stamps = 0.1 * np.arange(STEPS + 1)
    a, b = (Stream(name, "any", stamps, list(range(STEPS + 1))) for name in "ab")
    selected = pairs.select(a, b, motion, dt, 25, 0)
    return Pair(a, b, motion, motion, dt, selected, Transform("a", "b", T, np.diag(sigma**2)))


class Bowl(CostMetric):
    """Costs like a bowl around a pose that is a little different at every moment."""

    id = "bowl"

    def __init__(self, best=TRUE, noise=SIGMA / 20, shape=1 / SIGMA, seed=0):
        self.best, self.noise, self.shape, self.seed = best, noise, shape, seed

    def accepts(self, kind_a, kind_b):
        return True

    def prepare(self, pair, options):
        rng = np.random.default_rng([self.seed, int(pair.selected[0, 1])])
        return rng.normal(size=6) * self.noise

    def cost(self, T_a_b, pair):
        return float(self.costs(T_a_b[None], pair)[0])

    def costs(self, T_a_b, moment):
        return bowl(T_a_b, self.best, moment, self.shape)


def off(T, error):
    """A pose that much from another: metres, then radians in axes of a."""
    return se3.rigid(se3.exp_so3(error[3:]) @ T[:3, :3], T[:3, 3] + error[:3])


def error_of(estimate):
    T = estimate.transform.T_a_b
    return np.concatenate([T[:3, 3] - TRUE[:3, 3], se3.log_so3(T[:3, :3] @ TRUE[:3, :3].T)])
