"""Which estimates are believed, where motion gives way, and what is said of the rest."""

from dataclasses import replace

import numpy as np
import pytest
from combined_rigs import (
    TRUE,
    difference,
    moved,
    seen,
)
from numpy.testing import assert_allclose

from calib_toolkit.combine import combine, combine_paper


def test_a_failed_pair_is_left_out_and_said():
    good = [seen(0, 2), seen(0, 3), seen(2, 3, has_scale=False, cov=np.diag([1e-4] * 6))]
    bad = seen(0, 2, "nmi", error=np.array([0.8, 0.0, 0.3, 0.0, 0.05, 0.0]))
    found = combine(moved(), [good[0], bad, *good[1:]])
    assert found.used == (True, False, True, True)
    (note,) = found.notes
    assert note.startswith("nmi of velo and cam0 was left out: ")
    assert_allclose(found.calibration.T_base_sensor, TRUE, atol=1e-9)


def test_a_single_estimate_does_not_overrule_motion():
    bad = seen(0, 2, error=np.array([0.8, 0, 0, 0, 0.05, 0]))
    found = combine(moved(), [bad])
    assert found.used == (False,)
    assert_allclose(found.calibration.T_base_sensor, TRUE, atol=1e-9)


@pytest.mark.parametrize("witnesses", [((0, 2, "im"), (0, 2, "nmi")), ((0, 2, "im"), (2, 3, "x"), (0, 3, "im"))])
def test_motion_gives_way_to_estimates_that_agree(witnesses):
    error = np.zeros((4, 7))
    error[2, :6] = [0.5, -0.5, 1.5, 0.02, 0.02, 0.01]  # 5 sigma
    found = combine(moved(error=error), [seen(*w) for w in witnesses])
    assert all(found.used)
    (note,) = found.notes
    assert note.startswith("the pose of cam0 by motion contradicts")
    assert np.abs(difference(found.calibration, TRUE)).max() < 0.01
    assert found.calibration.sigma[2, 1] < 0.011


def test_motion_of_two_sensors_that_are_a_pair_gives_way():
    error = np.zeros((4, 7))
    error[2:, :6] = np.array([[0.5, -0.5, 1.5, 0.02, 0.02, 0.01], [-0.5, 0.5, 1.5, 0.02, -0.02, -0.01]])
    cameras = [seen(0, k, metric) for k in (2, 3) for metric in ("im", "gom")]
    found = combine(moved(error=error), [*cameras, seen(2, 3, "features", has_scale=False, cov=np.eye(6) * 1e-5)])
    assert all(found.used)
    assert len(found.notes) == 2
    assert np.abs(difference(found.calibration, TRUE)).max() < 0.01


def test_what_can_not_be_used_is_said():
    diverged = replace(seen(0, 2), converged=False, note="the two see different places")
    broken = replace(seen(0, 3), by_clock=np.full(6, np.nan))
    negative = seen(0, 3, "gom", cov=np.diag([1, 1, 1, 1, 1, -1.0]))
    stranger = replace(seen(0, 2), transform=replace(seen(0, 2).transform, b="radar"))
    for method in (combine, combine_paper):
        found = method(moved(), [diverged, broken, negative, stranger])
        assert not any(found.used)
        assert found.notes == (
            "im of velo and cam0 was left out: the two see different places",
            "im of velo and cam1 was left out: it holds numbers that are not finite",
            "gom of velo and cam1 was left out: its covariance is not positive",
            "im of velo and radar was left out: these are not two sensors of the rig",
        )
