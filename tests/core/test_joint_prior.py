"""Measured numbers as information: against differences of the squared residuals that they stand for."""

import numpy as np
import pytest
from builders import CAMERA, INS, LIDAR, in_base
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from calib_toolkit import se3
from calib_toolkit.errors import ConfigError
from calib_toolkit.joint import prior
from calib_toolkit.joint.clocks import Clocks
from calib_toolkit.types import Measured

NAMES = ("velo", "ins", "cam")
T = in_base((LIDAR, INS, CAMERA))
PLACES = ("x", "y", "z")
ANGLES = ("roll", "pitch", "yaw")
STEP = 1e-4


def numbers(T_base_sensor):
    """What a ruler and an inclinometer would read."""
    yaw, pitch, roll = Rotation.from_matrix(T_base_sensor[:3, :3]).as_euler("ZYX")
    return dict(zip(PLACES + ANGLES, (*T_base_sensor[:3, 3], roll, pitch, yaw), strict=True))


def moved(change):
    """All poses, moved by (12,)."""
    parts = change.reshape(2, 6)
    R = se3.exp_so3(parts[:, 3:]) @ T[1:, :3, :3]
    return np.concatenate([T[:1], se3.rigid(R, T[1:, :3, 3] + parts[:, :3])])


def misfit(change, known):
    """Half the squared residuals of measured numbers, angles of a full turn being none."""
    poses, total = moved(change), 0.0
    for m in known:
        off = m.value - numbers(poses[NAMES.index(m.sensor)])[m.parameter]
        if m.parameter in ANGLES:
            off = np.angle(np.exp(1j * off))
        total += off**2 / m.sigma**2 / 2
    return total


def known(off):
    """All twelve numbers, each so many sigma from what the poses have."""
    rng = np.random.default_rng(0)
    return [
        Measured(name, p, float(value + off * sigma), float(sigma))
        for name, pose in zip(NAMES[1:], T[1:], strict=True)
        for (p, value), sigma in zip(numbers(pose).items(), rng.uniform(0.01, 0.1, 6), strict=True)
    ]


def test_gradient_is_that_of_the_squared_residuals():
    for m in [*[[one] for one in known(1.5)], known(-0.7)]:
        _, pull = prior.information(T, NAMES, m)
        expected = [-(misfit(h, m) - misfit(-h, m)) / (2 * STEP) for h in STEP * np.eye(12)]
        assert_allclose(pull, expected, rtol=1e-4, atol=1e-4)


def test_information_is_their_curvature():
    exact = known(0.0)
    found, pull = prior.information(T, NAMES, exact)
    assert_allclose(pull, 0.0, atol=1e-6)
    eye = STEP * np.eye(12)
    expected = [
        [(misfit(a + b, exact) - misfit(a - b, exact)) / (2 * STEP**2) for a in eye] for b in eye
    ]  # even, so two of the four terms are enough
    assert_allclose(found, expected, rtol=1e-3, atol=1e-3 * np.abs(found).max())


@pytest.mark.parametrize("turns", [-2, -1, 1])
def test_angles_wrap(turns):
    """An angle just short of a half turn, measured just beyond it; and whole turns more."""
    R = Rotation.from_euler("ZYX", [np.pi - 0.01, 0.1, -np.pi + 0.02]).as_matrix()
    poses = np.array([np.eye(4), se3.rigid(R, np.zeros(3))])
    for parameter, value, off in (("yaw", -np.pi + 0.01, 0.02), ("roll", np.pi - 0.01, -0.03)):
        measured = Measured("ins", parameter, value + 2 * np.pi * turns, 0.1)
        info, pull = prior.information(poses, NAMES[:2], [measured])
        step = np.linalg.pinv(info) @ pull
        turned = se3.rigid(se3.exp_so3(step[3:]) @ R, np.zeros(3))
        change = numbers(turned)[parameter] - numbers(poses[1])[parameter]
        assert np.angle(np.exp(1j * change)) == pytest.approx(off, abs=2e-3)


def test_no_numbers_tell_nothing_and_a_clocks_tells_no_pose():
    for none in ([], [Measured("ins", "dt", 0.1, 0.01)]):
        info, pull = prior.information(T, NAMES, none)
        assert_allclose(info, np.zeros((12, 12)))
        assert_allclose(pull, np.zeros(12))


def test_clocks_are_told_by_the_sensor_on_them():
    clocks = Clocks.starting(("a", "b", "b"), np.zeros(3), 0.0)
    found = prior.late([Measured("cam", "dt", 0.03, 0.002), Measured("cam", "z", 1.0, 0.1)], NAMES, clocks)
    assert [(k.clock, k.dt, k.sigma) for k in found] == [(1, 0.03, 0.002)]


def held(*measured):
    return prior.information(T, NAMES, measured)[0][:6, :6]


def test_directions_that_a_number_holds_are_not_open():
    z, yaw = np.eye(6)[:, [2]], np.eye(6)[:, [5]]
    assert prior.unheld(z, held()).shape == (6, 1)
    assert prior.unheld(z, held(Measured("ins", "z", 1.0, 0.02))).shape == (6, 0)
    assert prior.unheld(z, held(Measured("ins", "x", 1.0, 0.02))).shape == (6, 1)
    assert prior.unheld(z, held(Measured("ins", "z", 1.0, 5.0))).shape == (6, 1)  # too vague to hold anything
    assert prior.unheld(yaw, held(Measured("ins", "yaw", 0.0, 0.01))).shape == (6, 0)
    assert prior.unheld(np.zeros((6, 0)), held()).shape == (6, 0)


def test_of_several_open_directions_those_are_left_that_no_number_holds():
    shifts = np.eye(6)[:, :3]
    left = prior.unheld(shifts, held(Measured("ins", "y", 0.3, 0.01)))
    assert left.shape == (6, 2)
    assert_allclose(left[[1, 3, 4, 5]], 0.0, atol=1e-9)
    assert_allclose(left.T @ left, np.eye(2), atol=1e-12)


def test_a_mixed_direction_is_held_by_a_number_on_any_part_of_it():
    """Turning about a point 20 m aside: yaw (worth a tenth of a radian) and a shift."""
    v = np.array([[20.0, 0, 0, 0, 0, 1.0]]).T / [[1.0], [1], [1], [0.1], [0.1], [0.1]]
    v /= np.linalg.norm(v)
    assert prior.unheld(v, held()).shape == (6, 1)
    for m in (Measured("ins", "x", 0.0, 0.02), Measured("ins", "yaw", 0.0, 0.01)):
        assert prior.unheld(v, held(m)).shape == (6, 0)


def test_numbers_of_strangers_and_of_the_base_are_refused():
    prior.checked([Measured("ins", "z", 1.0, 0.1)], NAMES)
    with pytest.raises(ConfigError, match=r"'radar'.*there are: velo, ins, cam"):
        prior.checked([Measured("radar", "z", 1.0, 0.1)], NAMES)
    with pytest.raises(ConfigError, match=r"'velo'.*--base"):
        prior.checked([Measured("velo", "z", 1.0, 0.1)], NAMES)


def test_measured_poses_of_cameras_alone_are_refused_and_offsets_are_not():
    prior.without_scale([Measured("cam1", "dt", 0.01, 0.001)])
    with pytest.raises(ConfigError, match=r"cam1\.z.*cameras alone"):
        prior.without_scale([Measured("cam1", "dt", 0.01, 0.001), Measured("cam1", "z", 0.5, 0.01)])
