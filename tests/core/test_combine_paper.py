"""The paper's own combination beside ours."""

import numpy as np
from combined_rigs import BY_MOTION, TRUE, difference, drawn, moved, seen
from numpy.testing import assert_allclose

from calib_toolkit.combine import combine, combine_paper


def test_the_papers_form_finds_about_the_same():
    T, motion, estimates = drawn(np.random.default_rng(8))
    ours, papers = combine(motion, estimates), combine_paper(motion, estimates)
    assert all(papers.used)
    c = papers.calibration
    assert np.all(np.abs(difference(c, T)[2:]) < 5 * ours.calibration.sigma[2:, :6] + 0.03)
    assert_allclose(c.dt_base_sensor, motion.dt_base_sensor)


def test_the_papers_form_counts_motion_once_for_each_pair():
    c = combine_paper(moved(), []).calibration
    assert np.all(c.sigma[1:, :6] < 0.9 * BY_MOTION[:6])


def test_the_papers_form_with_exact_transforms_stays_at_the_truth():
    found = combine_paper(moved(), [seen(0, 2), seen(3, 0), seen(2, 3, has_scale=False)])
    assert_allclose(found.calibration.T_base_sensor, TRUE, atol=1e-6)
