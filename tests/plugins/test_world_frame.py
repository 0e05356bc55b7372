"""Clouds moved to a world frame are refused with a sentence; those of a scanner that drives or stands are not."""

import numpy as np
import pytest

from calib_toolkit import DataError, Scan, Stream
from calib_toolkit_plugins.velodyne import VelodyneOptions, estimate

STEPS = 19
POINTS = 3000


def street(rng):
    """Points of the ground, two rows of house fronts with gaps, and posts, along 140 m."""
    ground = np.column_stack([rng.uniform(-60, 80, 40000), rng.uniform(-12, 12, 40000), np.zeros(40000)])
    front = np.column_stack([rng.uniform(-60, 80, 60000), rng.choice([-12.0, 12.0], 60000), rng.uniform(0, 8, 60000)])
    front = front[np.sin(front[:, 0] * 0.7) + np.sin(front[:, 0] * 0.31) > -0.6]
    posts = np.column_stack([np.repeat(rng.uniform(-60, 80, 40), 200), np.repeat(rng.uniform(-9, 9, 40), 200)])
    return np.vstack([ground, front, np.column_stack([posts, rng.uniform(0, 4, len(posts))])]) - [0, 0, 1.8]


def stream(step, world):
    """A scanner that goes so many metres a step through the street and sees 40 m far."""
    rng = np.random.default_rng(0)
    everything = street(rng)
    scans = []
    for k in range(STEPS):
        at = np.array([step * k, 0.0, 0.0])
        near = everything[np.linalg.norm(everything - at, axis=1) < 40]
        seen = near[rng.choice(len(near), POINTS, replace=False)] + rng.normal(0, 0.01, (POINTS, 3))
        scans.append(Scan((seen if world is not None else seen - at).astype(np.float32) + np.float32(world or 0.0)))
    return Stream("velo", "velodyne", 0.1 * np.arange(STEPS), scans)


OPTIONS = VelodyneOptions(cell=0.6)


@pytest.mark.parametrize("step", [0.0, 1.0])
def test_scans_as_recorded_are_taken(step):
    motions = estimate(stream(step, None), OPTIONS)
    assert len(motions) == STEPS - 1
    assert np.abs(motions.vec[:, 0] - step).max() < 0.1


@pytest.mark.parametrize("world", [0.0, 30.0])
def test_clouds_in_a_world_frame_are_refused(world):
    with pytest.raises(DataError, match=r"sensor velo, at 0.000 s: its clouds look like they were moved to a world"):
        estimate(stream(1.0, world), OPTIONS)


def test_clouds_far_from_everything_are_refused():
    with pytest.raises(DataError, match=r"beyond its range of 100 m; they look like they were moved to a world"):
        estimate(stream(1.0, 5e4), OPTIONS)
