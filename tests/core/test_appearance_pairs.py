"""Which readings of a pair are compared, by which metrics, and what is kept of that."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from searched_pairs import SIGMA, STEPS, TRUE, Bowl, driven, off, pair_at

from calib_toolkit import Config, Stream, poses_at, se3
from calib_toolkit.appearance import pairs, refinement
from calib_toolkit.errors import ConfigError, DataError
from calib_toolkit.plugins import Registry


def test_poses_follow_a_bend():
    stamps = np.array([2.0, 2.03, 3.3])
    angle = 0.1 * (stamps - 2.0)
    radius = 5.0 / 0.1
    T = poses_at(driven(), stamps, 2.0)
    assert_allclose(T[:, 0, 3], radius * np.sin(angle), atol=5e-3)
    assert_allclose(se3.log_so3(T[:, :3, :3])[:, 2], angle, atol=1e-9)
    back = poses_at(driven(), [2.0], 3.3)[0]
    assert_allclose(back @ T[2], np.eye(4), atol=1e-9)


def test_poses_are_not_known_outside_the_motion_nor_across_a_gap():
    motion = driven()
    assert np.isnan(poses_at(motion, [11.0], 9.0)).all()
    gap = motion[np.r_[0:50, 60:STEPS]]
    T = poses_at(gap, [4.0, 7.0], 4.5)
    assert np.isfinite(T[0]).all()
    assert np.isnan(T[1]).all()


def test_readings_are_spread_over_the_drive_and_go_together():
    motion = driven(standing=range(40))
    pair = pair_at(TRUE, dt=0.31, motion=motion)
    assert len(pair) == 25
    apart = pair.a.stamps[pair.selected[:, 0]] - (pair.b.stamps[pair.selected[:, 1]] + 0.31)
    assert np.abs(apart).max() < 0.06
    assert np.diff(pair.b.stamps[pair.selected[:, 1]]).max() < 0.9
    assert_allclose(pair.selected, pair_at(TRUE, dt=0.31, motion=motion).selected)


def test_readings_without_a_partner_are_not_compared():
    motion, stamps = driven(), 0.1 * np.arange(STEPS + 1)
    a, b = Stream("a", "any", stamps, list(stamps)), Stream("b", "any", stamps + 100.0, list(stamps))
    assert len(pairs.select(a, b, motion, 0.0, 25, 0)) == 0


def test_unknown_metrics_are_refused():
    with pytest.raises(ConfigError, match=r"there is no metric 'sift'; there are: .*none"):
        refinement.chosen(replace(Config(), appearance=("sift",)), Registry([]))
    assert refinement.chosen(replace(Config(), appearance=("none",)), Registry([])) == {}
    assert refinement.chosen(Config(), Registry([])) == {}


class Counted(Bowl):
    """Says how often it was asked for a moment."""

    asked = 0

    def prepare(self, pair, options):
        Counted.asked += 1
        return super().prepare(pair, options)


def test_what_was_found_for_a_pair_is_kept(tmp_path):
    """A killed run goes on where it stopped; another prior, seed or version is other work."""

    def look(pair, seed=0, version="1"):
        metric, Counted.asked = Counted(), 0
        metric.version = version
        found = refinement._estimate(pairs.Comparison(metric, pair), metric.options(), seed, tmp_path)
        return found, Counted.asked

    pair = pair_at(off(TRUE, SIGMA / 2))
    first, asked = look(pair)
    assert asked
    again, asked = look(pair)
    assert not asked
    assert again.transform.has_scale is True
    for a, b in ((first, again), (first.transform, again.transform)):
        for name, value in vars(a).items():
            if name != "transform":
                assert np.array_equal(value, vars(b)[name]), name
    (file,) = tmp_path.rglob("*.json")
    file.write_text(file.read_text()[:100])
    assert look(pair)[1]
    assert look(pair, seed=1)[1]
    assert look(pair, version="2")[1]
    assert look(replace(pair, dt_a_b=0.01))[1]


def test_a_pair_that_can_not_be_read_is_tried_again(tmp_path):
    class Broken(Counted):
        def prepare(self, pair, options):
            super().prepare(pair, options)
            raise DataError("a.png is cut off")

    comparison = pairs.Comparison(Broken(), pair_at(TRUE))
    for _ in range(2):
        Counted.asked = 0
        found = refinement._estimate(comparison, comparison.metric.options(), 0, tmp_path)
        assert not found.converged
        assert "cut off" in found.note
        assert Counted.asked
    assert not [*tmp_path.rglob("*.json")]
