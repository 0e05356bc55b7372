"""What ``calib-toolkit evaluate`` refuses, and how early."""

import json

import pytest
from evaluated import evaluate, refused, rows_of, simulated

from calib_toolkit import open_log
from calib_toolkit.config import METHODS
from calib_toolkit.result_file import calibration_dict


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    return simulated(tmp_path_factory.mktemp("drives") / "first")


@pytest.fixture
def no_truth(tmp_path):
    """The drive's two scaled sensors through a rig.toml, which brings no truth."""
    origin = simulated(tmp_path / "origin")
    rig = tmp_path / "rig"
    rig.mkdir()
    tables = [f'[sensors.{n}]\nlog = "{origin}"\nsensor = "{n}"\n' for n in ("velo", "ins")]
    (rig / "rig.toml").write_text("\n".join(tables))
    return rig, open_log(origin).reference


def test_a_drive_without_truth_is_refused_and_a_given_one_taken(no_truth, tmp_path):
    rig, truth = no_truth
    arguments = ("pair", rig, "-o", tmp_path / "out", "--repeats", 1, "--seconds", 20, "--jobs", 1)
    assert refused(*arguments) == (
        f"{rig} comes without a truth to compare with; give one with --truth FILE, in the form of a calibration.json"
    )
    (tmp_path / "t.json").write_text(json.dumps(calibration_dict(truth)))
    evaluate(*arguments, "--truth", tmp_path / "t.json")
    assert max(float(row["rotation_deg"]) for row in rows_of(tmp_path / "out" / "pair.csv")) < 1


@pytest.mark.parametrize(("name", "what"), [("appearance", "lidar and camera"), ("full", "two sensors")])
def test_experiments_on_appearance_are_refused_where_nothing_can_be_compared(drive, tmp_path, name, what):
    sentence = refused(name, drive, "-o", tmp_path / "out")
    assert f"no {what} that an installed appearance metric compares" in sentence
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (
            ("pair", "--sensors", "velo,ins,cam0"),
            "'pair' compares two sensors, and these are velo, ins, cam0; name two",
        ),
        (("pair", "--sensors", "velo"), "comparing takes at least two sensors, and this is velo"),
        (("pair", "--sensors", "velo,sonar"), "has no sensor named 'sonar'; it has: cam0, cam1, velo, ins"),
        (("timing", "--baseline"), "--baseline does not go with 'timing'"),
        (("pair", "--seconds", "500"), "no recording lasts long enough: 500 s: longer than first (44."),
        (("pair", "--truth", "nowhere.json"), "nowhere.json"),
    ],
)
def test_what_can_not_be_done_is_one_sentence(drive, tmp_path, arguments, sentence):
    assert sentence in refused(*arguments, drive, "-o", tmp_path / "out", "--repeats", 1, "--jobs", 1)


def test_one_drive_twice_is_refused(drive, tmp_path):
    assert "is named twice" in refused("pair", drive, drive, "-o", tmp_path / "out")


@pytest.mark.parametrize("seconds", ["a", "10,10", "20.00001,20.00002", "0.5", "nan", "inf"])
def test_lengths_are_numbers(drive, tmp_path, seconds):
    assert "--seconds" in evaluate("pair", drive, "-o", tmp_path / "out", "--seconds", seconds, status=2)


def test_no_sensor_is_wrong_usage(drive, tmp_path):
    assert "no sensor is named" in evaluate("pair", drive, "-o", tmp_path / "out", "--sensors", ",", status=2)


@pytest.fixture
def nothing_dear(monkeypatch):
    """Fails as soon as a sensor's motion is estimated."""
    from calib_toolkit.evaluation import drives

    monkeypatch.setattr(drives, "sensor_motions", lambda *_: pytest.fail("estimated before it was refused"))


@pytest.mark.parametrize("arguments", [("pair", "--sensors", "velo,ins,cam0"), ("timing", "--baseline"), ("pair",)])
def test_what_is_cheap_is_refused_before_anything_dear(drive, tmp_path, arguments, nothing_dear):
    (tmp_path / "file").write_text("")
    assert refused(*arguments, drive, "-o", tmp_path / "file" / "out")


def test_drives_of_other_sensors_are_refused_before_anything_dear(drive, no_truth, tmp_path, nothing_dear):
    rig, truth = no_truth
    (tmp_path / "t.json").write_text(json.dumps(calibration_dict(truth)))
    arguments = ("timing", drive, rig, "-o", tmp_path / "out", "--truth", tmp_path / "t.json")
    assert "has no camera" in refused(*arguments)
    assert not (tmp_path / "out").exists()


def test_what_failed_unexpectedly_is_told_by_the_exit_status(drive, tmp_path, monkeypatch):
    from calib_toolkit.evaluation import measures

    def failing(*_):
        raise ValueError("array must not contain infs")

    monkeypatch.setattr(measures, "calibrate_motions", failing)
    arguments = ("pair", drive, "-o", tmp_path, "--repeats", 1, "--seconds", 20, "--jobs", 1)
    assert f"{len(METHODS)} row{'s' * (len(METHODS) > 1)} failed unexpectedly" in evaluate(*arguments, status=3)
    summary = (tmp_path / "pair.md").read_text()
    for method in METHODS:
        assert f"1 x {method}: unexpected ValueError: array must not contain infs" in summary


def test_a_folder_that_takes_nothing_is_refused(drive, tmp_path):
    (tmp_path / "file").write_text("")
    sentence = refused("pair", drive, "-o", tmp_path / "file" / "out", "--repeats", 1, "--seconds", 20, "--jobs", 1)
    assert "can not take the results" in sentence
