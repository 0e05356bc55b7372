"""The experiments on what the sensors see: starts, and searches with and without the motion."""

from dataclasses import replace

import numpy as np
import pytest
from bowls import FAST, Bowl, Installed, a_drive, run, section_of
from numpy.testing import assert_allclose

from calib_toolkit import Config, se3
from calib_toolkit.appearance import search
from calib_toolkit.errors import ConfigError, DataError
from calib_toolkit.evaluation import drives, experiment, sections, sights
from calib_toolkit.evaluation.protocols import PROTOCOLS
from calib_toolkit.types import Trajectory


def test_a_section_holds_what_was_seen_in_it_and_no_more(seen):
    section = section_of(seen)
    first = seen.span[0] + section.start
    for name, stream in section.log.streams.items():
        there = seen.log.streams[name].stamps
        assert_allclose(stream.stamps, there[(there >= first) & (there <= first + 20.0)])
        assert_allclose(section.paths[name].start, section.motions[name].start)


def test_poses_are_cut_as_motions_are(seen):
    n = 300
    drift = np.tile(np.eye(6), (n, 1, 1))
    told = Trajectory(0.1 * np.arange(n), np.tile(np.eye(4), (n, 1, 1)), drift.copy(), drift)
    one = replace(seen, paths={**seen.motions, "velo": told})
    part = section_of(one, seconds=10.0).paths["velo"]
    assert 90 < len(part) <= 101
    assert not part.drift[0].any()
    assert part.drift[1:].any()
    assert told.drift.all(axis=0).any(), "the recording itself is left alone"


def test_drives_that_are_too_short_are_taken_whole_and_that_is_said(seen, tmp_path, bowl):
    done = run("full", seen, tmp_path, repeats=1)
    assert {r["seconds"] for r in done.rows} == {"24"}
    assert done.skipped == ["100 s: longer than every drive; sections of 24 s instead"]
    assert sections.fitting([seen], (20.0,)) == ((20.0,), [])


# ---- appearance


def test_starts_are_off_as_the_motion_says(seen):
    section = section_of(seen)
    motion = sights.calibrate_motions(section.motions, FAST, section.clocks).calibration
    wide = []
    for wider in (1.0, 3.0):
        errors = []
        for seed in range(200):
            start = sights.drawn(motion, replace(section, seed=seed, wider=wider))
            T, true = start.T_base_sensor[1], seen.truth.T_base_sensor[1]
            errors.append(np.concatenate([T[:3, 3] - true[:3, 3], se3.log_so3(T[:3, :3] @ true[:3, :3].T)]))
        sigma = np.sqrt(np.diag(start.covariance))[7:13]
        assert_allclose(np.std(errors, axis=0), sigma, rtol=0.25)
        wide.append(sigma)
    assert_allclose(wide[1], 3 * wide[0])
    assert_allclose(start.T_base_sensor[0], seen.truth.T_base_sensor[0])


def test_every_metric_is_told_alone_with_the_motion_and_without_its_sigma(seen, bowl):
    found = {f.estimator: f for f in sights.measure_appearance(section_of(seen), [FAST], [])}
    assert list(found) == PROTOCOLS["appearance"].estimators(["paper"], False, ["bowl"])
    for way in sights.WAYS:
        f = found[f"bowl{way}"]
        assert not f.refused
        assert f.error["translation"] < 0.02
        assert f.error["rotation"] < 0.2
        assert "dt" not in f.error
    assert found["bowl-alone"].sigma["x"] > 0
    assert found["bowl-constrained"].sigma["x"] <= found["bowl-alone"].sigma["x"]
    assert not found["bowl-unconstrained"].sigma


def test_a_search_without_the_motions_sigma_goes_further_than_one_with_it(seen, bowl):
    """A metric whose best pose is half a metre off is refused with the motion's sigma, and believed without it."""
    bowl.shift = np.array([0.5, 0.5, -0.5, 0.0, 0.0, 0.3])
    found = {f.estimator: f for f in sights.measure_appearance(section_of(seen), [FAST], [])}
    assert "further from the motion's than its sigma allows" in found["bowl-constrained"].refused
    assert found["bowl-unconstrained"].error["x"] == pytest.approx(0.5, abs=0.05)
    assert np.radians(found["bowl-unconstrained"].error["rotation"]) == pytest.approx(0.3, abs=0.02)


def test_an_unconstrained_search_stays_within_a_metre(seen, bowl):
    bowl.shift = np.array([3.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    section = section_of(seen)
    start = sights.drawn(sights.calibrate_motions(section.motions, FAST, section.clocks).calibration, section)
    (c,) = sights.comparisons(section.log, section.paths, start, {"bowl": bowl}, 25, 0)
    T = search.unconstrained(bowl, c.pair, None, 0)
    assert T[0, 3] - c.pair.prior.T_a_b[0, 3] == pytest.approx(1.0, abs=0.02)


def test_what_sees_nothing_together_is_refused_by_name(seen, bowl):
    bowl.overlap = lambda pair: False
    initial, *others = sights.measure_appearance(section_of(seen), [FAST], [])
    assert not initial.refused
    assert [f.refused for f in others] == ["bowl: the two do not see the same where the start puts them"] * 3


def test_one_metric_that_fails_takes_no_other_with_it(seen, bowl, monkeypatch):
    class Broken(Bowl):
        id = "broken"

        def costs(self, T_a_b, moment):
            raise ZeroDivisionError("it fell")

    metrics = {"broken": Broken(bowl.best), "bowl": bowl}
    monkeypatch.setattr(sights, "registry", lambda: Installed(**metrics))
    config = replace(FAST, appearance=("broken", "bowl"))
    found = sights.measure_appearance(section_of(seen), [config], [])
    assert [f.refused for f in found if f.estimator.startswith("broken")] == [
        "unexpected ZeroDivisionError: it fell"
    ] * 3
    assert not any(f.refused for f in found if f.estimator.startswith("bowl"))


def test_metrics_are_those_that_search_and_take_the_two(seen, bowl):
    class Never(Bowl):
        def accepts(self, kind_a, kind_b):
            return False

    installed = Installed(bowl=bowl, never=Never(None), other=object())
    assert sights.metrics_of(seen.log, Config(), installed) == ("bowl",)
    assert sights.metrics_of(seen.log, FAST, installed) == ("bowl",)
    with pytest.raises(ConfigError, match="and never does not; choose others with --appearance"):
        sights.metrics_of(seen.log, replace(FAST, appearance=("bowl", "never")), installed)
    with pytest.raises(ConfigError, match="there is no metric 'sonar'"):
        sights.metrics_of(seen.log, replace(FAST, appearance=("sonar",)), installed)


def test_a_recording_without_a_lidar_and_a_camera_is_refused(seen):
    with pytest.raises(DataError, match=r"no lidar and camera .*\(it has: velo, \w+; cam0, \w+\); name two with"):
        drives.lidar_and_camera(seen.log)
    with pytest.raises(DataError, match=r"no two sensors that an installed .*\(it has: velo, \w+; cam0, \w+\); use"):
        drives.everyone(seen.log)


def test_a_truth_without_positions_is_refused(seen):
    known = seen.truth.determined.copy()
    known[1, 0] = False
    blind = replace(seen.truth, determined=known)
    with pytest.raises(DataError, match="does not say where the sensor is and how it is turned of cam0 against velo"):
        experiment.check(PROTOCOLS["appearance"], {"rough": blind})
    experiment.check(PROTOCOLS["full"], {"rough": blind})


# ---- full


def test_every_sensor_is_told_before_and_after(tmp_path, bowl):
    three = a_drive(cameras=2)
    found = sights.measure_full(section_of(three, "full"), [FAST], [])
    assert [(f.estimator, f.sensor) for f in found] == [
        (f"paper{way}", n) for way in ("-motion", "-combined") for n in ("cam0", "cam1")
    ]
    before, after = ({f.sensor: f for f in found if f.estimator.endswith(w)} for w in ("-motion", "-combined"))
    assert after["cam0"].sigma["z"] < before["cam0"].sigma["z"]
    assert after["cam0"].error["translation"] < 0.03


def test_nothing_that_overlaps_leaves_the_motion_and_refuses_the_rest(seen, bowl):
    bowl.overlap = lambda pair: False
    before, after = sights.measure_full(section_of(seen, "full"), [FAST], [])
    assert before.error
    assert not before.refused
    assert "no two sensors see the same" in after.refused
