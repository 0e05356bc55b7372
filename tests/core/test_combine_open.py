"""What one side alone can not tell: distances of cameras, open heights, numbers that were not stated."""

from dataclasses import replace

import numpy as np
from combined_rigs import (
    BY_LOOK,
    BY_MOTION,
    TRUE,
    at_most,
    moved,
    seen,
)
from numpy.testing import assert_allclose

from calib_toolkit import se3
from calib_toolkit.combine import combine
from calib_toolkit.types import Undetermined


def test_a_direction_tells_where_but_not_how_far():
    t = np.array([2.0, 0.5, -0.5])
    true = np.array([np.eye(4), se3.rigid(TRUE[2, :3, :3], t)])
    cov = np.zeros((2, 7, 2, 7))
    cov[1, :, 1] = np.diag(BY_MOTION**2)
    motion = moved(true, np.array([[0] * 7, [0.1, 0.1, 0.2, 0, 0, 0, 0]]), cov)
    sure = seen(0, 1, cov=np.diag([1e-10] * 6), has_scale=False, T=true)
    c = combine(motion, [sure]).calibration
    found = c.T_base_sensor[1, :3, 3]
    assert_allclose(found / np.linalg.norm(found), t / np.linalg.norm(t), atol=1e-4)
    along = t / np.linalg.norm(t)
    sigma = np.sqrt(along @ c.covariance[7:10, 7:10] @ along)
    assert 0.1 < sigma < 0.3
    across = np.cross(along, [0, 0, 1.0]) / np.linalg.norm(np.cross(along, [0, 0, 1.0]))
    assert np.sqrt(across @ c.covariance[7:10, 7:10] @ across) < 1e-3


def test_a_direction_says_nothing_where_the_distance_may_be_none():
    wide = moved().covariance.copy()
    wide[[14, 15, 16, 21, 22, 23], [14, 15, 16, 21, 22, 23]] = 1.0
    motion = replace(moved(), covariance=wide)
    found = combine(motion, [seen(2, 3, has_scale=False)])
    assert found.used == (True,)
    assert_allclose(found.calibration.covariance[14:17, 14:17], wide[14:17, 14:17], rtol=1e-3)
    turned = found.calibration.between("cam0", "cam1").cov[3:, 3:]
    assert at_most(turned, np.diag(BY_LOOK[3:] ** 2))


def test_cameras_in_one_place_are_turned_alone():
    T = TRUE.copy()
    T[:, :3, 3] = 0
    motion = replace(moved(T), determined=np.repeat([[False] * 3 + [True] * 4], 4, axis=0))
    found = combine(motion, [seen(2, 3, has_scale=False, error=np.array([0, 0, 0, 1e-3, 0, 0]))])
    assert np.all(np.isfinite(found.calibration.T_base_sensor))
    assert not found.calibration.determined[1:, :3].any()


def unknown_height(error=3.0):
    """A motion result of which the height of two sensors is open."""
    open_ = tuple(Undetermined({f"{n}.z": 1.0}, f"the height of {n} is open") for n in ("ins", "cam0"))
    determined = np.ones((4, 7), dtype=bool)
    determined[[1, 2], 2] = False
    cov = moved().covariance.copy()
    off = np.zeros((4, 7))
    for i in (1, 2):
        cov[7 * i + 2, 7 * i + 2] += 2.0**2
        off[i, 2] = error
    return moved(error=off, cov=cov, undetermined=open_, determined=determined)


def test_an_undetermined_height_becomes_determined():
    found = combine(unknown_height(), [seen(0, 2)])
    c = found.calibration
    assert found.used == (True,)
    # what was put in for the unknown height holds no information: not even a thousandth of a sigma
    assert_allclose(c.T_base_sensor[2, 2, 3], TRUE[2, 2, 3], atol=1e-5)
    assert c.determined[2].all()
    assert not c.determined[1, 2]
    assert [u.sentence for u in c.undetermined] == ["the height of ins is open"]
    assert c.sigma[2, 2] < 0.0101


def test_a_pair_of_two_sensors_without_height_leaves_both_open():
    found = combine(unknown_height(1.0), [seen(1, 2)])
    c = found.calibration
    assert not c.determined[[1, 2], 2].any()
    assert len(c.undetermined) == 2
    assert c.between("ins", "cam0").cov[2, 2] < 0.02**2
    assert np.sqrt(c.covariance[9, 9]) < 2.1


def test_what_was_not_stated_holds_no_information():
    motion = unknown_height()
    lost = np.zeros((28, 28))
    lost[7:, 7:] = motion.covariance[7:, 7:]
    lost[[9, 16]] = lost[:, [9, 16]] = 0.0
    motion = replace(motion, covariance=lost, undetermined=())
    c = combine(motion, [seen(0, 2)]).calibration
    assert_allclose(c.T_base_sensor[2, 2, 3], TRUE[2, 2, 3], atol=1e-5)
    assert c.determined[2, 2]
    assert not c.determined[1, 2]
    assert_allclose(c.sigma[2, 2], 0.01, rtol=1e-3)
