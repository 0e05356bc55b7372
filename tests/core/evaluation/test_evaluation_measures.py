"""One repeat of an experiment: what each method finds in a section, and whose failure is whose."""

from dataclasses import replace

import numpy as np
import pytest
from builders import INS, LIDAR, drive
from recorded_drives import FAST, a_drive, run, sensor

from calib_toolkit import config, paper, pipeline
from calib_toolkit.errors import DataError, NotObservableError
from calib_toolkit.evaluation import drives
from calib_toolkit.evaluation.measures import FORWARD_LEFT_UP, measure_pair, measure_panoramic, measure_timing
from calib_toolkit.evaluation.protocols import PROTOCOLS
from calib_toolkit.evaluation.sections import Draw, cut
from calib_toolkit_datasets.simulated import path, truth


def test_timing_finds_the_clocks_that_were_moved(ring, method):
    found = measure_timing(cut(Draw(0, 50.0, 1.0, 1), [ring], "timing", 0), [method], [])
    assert {f.estimator for f in found} == {method.method}
    assert [f.sensor for f in found] == ["cam1", "cam2"]
    for f in found:
        assert abs(f.error["dt"]) < 5
        assert 0 < f.sigma["dt"] < 5


def test_clocks_without_a_truth_have_no_error(ring):
    section = cut(Draw(0, 50.0, 1.0, 1), [ring], "timing", 0)
    section.truth.determined[2, 6] = False
    try:
        found = measure_timing(section, [FAST], [])
    finally:
        section.truth.determined[2, 6] = True
    assert [set(f.error) for f in found] == [{"dt"}, set()]


def test_a_pair_is_told_beside_least_squares(two, method):
    section = cut(Draw(0, 50.0, 0.0, 0), [two], "pair", 0)
    ours, plain = measure_pair(section, [method], ["least-squares"])
    assert (ours.estimator, plain.estimator) == (method.method, "least-squares")
    assert (ours.sensor, plain.sensor) == ("velo-ins", "velo-ins")
    assert ours.error["rotation"] < 0.5
    assert ours.error["translation"] < 0.3
    assert abs(ours.error["dt"]) < 5
    total = np.linalg.norm([ours.error[k] for k in "xyz"])
    assert ours.error["translation"] == pytest.approx(total)
    assert set(ours.sigma) == {"roll", "pitch", "yaw", "rx", "ry", "rz", "x", "y", "z", "dt"}
    assert plain.error["rotation"] < 2
    assert plain.sigma == {}
    assert "dt" not in plain.error


def test_what_is_not_determined_has_no_error():
    sensors = [sensor("velo", LIDAR), sensor("ins", INS)]
    planar = drives.Drive("planar", None, drive(path(40.0, 3, "planar"), sensors, 3), ("velo", "ins"), truth(sensors))
    (ours,) = measure_pair(cut(Draw(0, 35.0, 0.0, 0), [planar], "pair", 0), [FAST], [])
    # turning about one axis only: nothing tells the yaw of the other sensor, nor so where it sits
    assert {"yaw", "rz", "rotation", "z", "translation"} <= set(ours.undetermined)
    assert not set(ours.undetermined) & (set(ours.error) | set(ours.sigma))
    assert {"roll", "pitch", "dt"} <= set(ours.error)
    assert max(abs(ours.error["roll"]), abs(ours.error["pitch"])) < 1


def test_a_ring_of_cameras_is_told_together_and_apart(ring, method):
    methods = [f"{method.method}-together", f"{method.method}-separate", "least-squares"]
    found = measure_panoramic(cut(Draw(0, 50.0, 0.0, 0), [ring], "panoramic", 0), [method], methods[2:])
    pairs = ["cam0-cam1", "cam0-cam2", "cam1-cam2"]
    assert [(f.estimator, f.sensor) for f in found] == [(m, p) for m in methods for p in pairs]
    assert max(f.error["rotation"] for f in found) < 1.0
    assert [bool(f.sigma) for f in found] == [True] * 3 + [False] * 6
    together = np.array([[f.error[k] / f.sigma[k] for k in ("rx", "ry", "rz")] for f in found[:3]])
    assert np.sqrt(np.mean(together**2)) < 4


def test_a_refusal_is_of_the_method_that_refused():
    """The calibration takes twenty common steps; least squares takes what there is, on offsets of its own."""
    sensors = [sensor("velo", LIDAR, rate=1.0), sensor("ins", INS)]
    slow = a_drive(sensors, seconds=40.0)
    ours, plain = measure_pair(cut(Draw(0, 15.0, 0.0, 0), [slow], "pair", 0), [FAST], ["least-squares"])
    assert "share only" in ours.refused
    assert not plain.refused
    assert plain.error["rotation"] < 10
    gone = cut(Draw(0, 15.0, 0.0, 0), [slow], "pair", 0)
    gone = replace(gone, motions={**gone.motions, "ins": gone.motions["ins"][:0]})
    ours, plain = measure_pair(gone, [FAST], ["least-squares"])
    assert ours.refused.startswith("sensor ins has no motion")
    assert plain.refused == f"needs the clock offsets, which were not found: {ours.refused}"


def test_one_camera_that_is_refused_spoils_its_own_pairs_only(ring):
    section = cut(Draw(0, 50.0, 0.0, 0), [ring], "panoramic", 0)
    section = replace(section, motions={**section.motions, "cam2": section.motions["cam2"][:0]})
    found = measure_panoramic(section, [FAST], ["least-squares"])
    assert [bool(f.refused) for f in found] == [True] * 3 + [False, True, True] * 2
    assert all("sensor cam2 has no motion" in f.refused for f in found if f.refused)
    assert all(f.error["rotation"] < 1 for f in found if not f.refused)


class Other:
    """A method beside the paper's: what it is asked for is noted, and it does as told or as the paper."""

    def __init__(self):
        self.asked, self.fails = [], None

    def calibrate(self, motions, *more):
        """The paper's calibration."""
        self.asked.append(tuple(motions))
        if self.fails:
            raise self.fails
        return paper.calibrate(motions, *more)

    def clock_offsets(self, motions, *more):
        """The paper's offsets."""
        if self.fails:
            raise self.fails
        return paper.clock_offsets(motions, *more)


@pytest.fixture
def other(monkeypatch):
    """Another method, installed."""
    there = Other()
    monkeypatch.setattr(config, "METHODS", ("other", "paper"))
    monkeypatch.setattr(pipeline, "METHODS", {"other": there, "paper": paper})
    return there


def both(first):
    """Configurations of the two methods, in that order."""
    return [replace(FAST, method=m) for m in (first, *{"other", "paper"} - {first})]


@pytest.mark.parametrize(
    ("name", "failure"),
    [
        ("timing", NotObservableError("it is too dark")),
        ("pair", np.linalg.LinAlgError("it broke")),
        ("panoramic", ZeroDivisionError("it fell")),
    ],
)
def test_a_method_that_fails_takes_no_other_with_it(name, failure, two, ring, other):
    section = cut(Draw(0, 20.0, 0.0, 0), [two if name == "pair" else ring], name, 0)
    beside = [] if name == "timing" else ["least-squares"]
    measure = PROTOCOLS[name].measure
    alone = measure(section, [FAST], beside)
    other.fails = failure
    found = measure(section, both("paper"), beside)
    assert [f for f in found if not f.estimator.startswith("other")] == alone
    failed = [f for f in found if f.estimator.startswith("other")]
    plain = [f for f in alone if f.estimator in beside]
    assert len(failed) == len(alone) - len(plain)
    unexpected = "" if isinstance(failure, NotObservableError) else f"unexpected {type(failure).__name__}: "
    assert {f.refused for f in failed} == {f"{unexpected}{failure}"}
    found = measure(section, both("other"), beside)
    assert [f for f in found if f.estimator.startswith("paper")] == alone[: len(alone) - len(plain)]
    # baselines stand on the first method's clock offsets
    assert all(str(failure) in f.refused for f in found if f.estimator in beside)


def test_rows_come_in_the_order_of_the_methods_named(two, other, tmp_path):
    for methods in (("other", "paper"), ("paper", "other")):
        rows = run(two, tmp_path / methods[0], repeats=1, methods=methods).rows
        assert [r["estimator"] for r in rows] == [*methods, "least-squares"]
        # the same draw, and here the same estimate
        assert rows[0]["start"] == rows[1]["start"]
        assert rows[0]["rotation_deg"] == rows[1]["rotation_deg"]
    with pytest.raises(DataError, match=r'begun with estimators = \["paper", "other", "least-squares"\], and'):
        run(two, tmp_path / "paper", repeats=1, methods=("other", "paper"))


def test_offsets_of_clocks_that_drift_are_told_in_the_middle_of_the_section(two, other):
    section = cut(Draw(0, 30.0, 0.0, 0), [two], "pair", 0)
    middle = two.span[0] + section.start + 15.0
    assert section.truth.t_ref == pytest.approx(middle)

    def drifting(c):
        """As much off at its own reference as it drifts until the middle."""
        dt, skew = c.dt_base_sensor - [0, 0.1], np.array([0, 1e-3])
        return replace(c, dt_base_sensor=dt, clock_skew=skew, t_ref=middle - 100)

    other.calibrate = lambda *more: replace(there := paper.calibrate(*more), calibration=drifting(there.calibration))
    other.clock_offsets = lambda *more: drifting(paper.clock_offsets(*more))
    theirs, ours, beside = measure_pair(section, both("other"), ["least-squares"])
    assert theirs.error["dt"] == pytest.approx(ours.error["dt"], abs=1e-6)
    _, plain = measure_pair(section, [FAST], ["least-squares"])
    assert beside.error["rotation"] == pytest.approx(plain.error["rotation"])
    (theirs,), (ours,) = (measure_timing(section, [c], []) for c in both("other"))
    assert theirs.error["dt"] == pytest.approx(ours.error["dt"], abs=1e-6)


def test_nothing_is_calibrated_twice(ring, other):
    section = cut(Draw(0, 20.0, 0.0, 0), [ring], "panoramic", 0)
    measure_panoramic(section, both("other"), ["least-squares"])
    assert sorted(other.asked) == [("cam0", "cam1"), ("cam0", "cam1", "cam2"), ("cam0", "cam2")]


def test_roll_of_a_camera_is_about_its_optical_axis():
    np.testing.assert_allclose(FORWARD_LEFT_UP @ [0, 0, 1], [1, 0, 0])  # ahead
    np.testing.assert_allclose(FORWARD_LEFT_UP @ [1, 0, 0], [0, -1, 0])  # right
    np.testing.assert_allclose(FORWARD_LEFT_UP @ [0, 1, 0], [0, 0, -1])  # down
