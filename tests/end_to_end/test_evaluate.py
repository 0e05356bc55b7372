"""``calib-toolkit evaluate``: what it writes, what it refuses, and what a kill leaves."""

import csv
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from scipy.spatial.transform import Rotation

from calib_toolkit import cli, open_log, se3
from calib_toolkit.config import METHODS
from calib_toolkit.result_file import calibration_dict
from calib_toolkit_datasets.simulation.vehicle import path

RIG = """
seconds = {seconds}
seed = {seed}
drive = "{drive}"
[sensors.cam0]
pose = [0.3, 0.1, 1.6, -90.0, 0.0, -90.0]
has_scale = false
sigma = [0.005, 0.005, 0.005, 2e-4, 2e-4, 2e-4]
[sensors.cam1]
pose = [0.2, 0.8, 1.1, -90.0, 0.0, -20.0]
dt = 0.025
has_scale = false
sigma = [0.005, 0.005, 0.005, 2e-4, 2e-4, 2e-4]
[sensors.velo]
pose = [0.0, 0.0, 1.7, 0.0, 0.0, 0.0]
sigma = [0.004, 0.004, 0.004, 2e-4, 2e-4, 2e-4]
[sensors.ins]
pose = [-0.8, 0.3, 0.9, 0.8, -0.1, 1.0]
dt = -0.060
rate = 20.0
sigma = [0.002, 0.002, 0.002, 1e-4, 1e-4, 1e-4]
"""


def simulated(folder, seconds=45, seed=5, drive="rough"):
    """A recording with four sensors and its truth."""
    folder.mkdir(parents=True)
    (folder / "simulated.toml").write_text(RIG.format(seconds=seconds, seed=seed, drive=drive))
    return folder


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    return simulated(tmp_path_factory.mktemp("drives") / "first")


def evaluate(*arguments, status=0):
    """What the command printed."""
    done = CliRunner().invoke(cli.main, ["evaluate", *(str(a) for a in arguments)])
    assert done.exit_code == status, done.output
    return done.output


def refused(*arguments):
    """The sentence."""
    text = evaluate(*arguments, status=1)
    (sentence,) = [line for line in text.splitlines() if line.startswith("calib-toolkit: ")]
    return sentence.removeprefix("calib-toolkit: ")


def rows_of(file):
    with file.open(newline="") as f:
        return list(csv.DictReader(f))


# ---- what it writes


@pytest.fixture(scope="module")
def timed(drive, tmp_path_factory):
    """One timing experiment over two drives: (folder, what was printed)."""
    second = simulated(tmp_path_factory.mktemp("more") / "second", seconds=25, seed=6)
    out = tmp_path_factory.mktemp("timing")
    arguments = ("timing", drive, second, "-o", out, "--repeats", 3, "--seconds", "15,30,60", "--jobs", 1)
    return out, evaluate(*arguments)


def test_one_row_for_each_camera_of_each_repeat_and_method(timed):
    rows = rows_of(timed[0] / "timing.csv")
    assert [(r["seconds"], r["spread"], r["repeat"], r["drive"], r["sensor"], r["estimator"]) for r in rows] == [
        (seconds, spread, str(k), "first" if seconds == "30" or k != 1 else "second", "cam1", method)
        for seconds in ("15", "30")
        for spread in ("0.1", "1")
        for k in range(3)
        for method in METHODS
    ]
    assert {r["status"] for r in rows} == {"found"}
    assert max(abs(float(r["dt_ms"])) for r in rows if r["seconds"] == "30") < 5


def test_what_is_too_long_is_said(timed):
    out, printed = timed
    for text in (printed, (out / "timing.md").read_text()):
        assert "30 s: longer than second (24." in text
        assert "60 s: longer than first, second (44." in text


@pytest.mark.parametrize("method", METHODS)
def test_the_summary_is_that_of_the_table(timed, method):
    out, printed = timed
    wanted = ("15", "1", method)
    rows = [r for r in rows_of(out / "timing.csv") if (r["seconds"], r["spread"], r["estimator"]) == wanted]
    e = np.abs([float(r["dt_ms"]) for r in rows])
    ratio = e / [float(r["sigma_dt_ms"]) for r in rows]
    start = f"| 15 | +-1 s | {method} |"
    lines = [line for line in (out / "timing.md").read_text().splitlines() if line.startswith(start)]
    (cells,) = [[c.strip() for c in line.strip("|").split("|")] for line in lines]
    numbers = [np.median(e), np.percentile(e, 95), e.max(), e.mean(), np.sqrt(np.mean(e**2))]
    assert cells[3:8] == [f"{v:.2f}" for v in numbers]
    assert cells[9] == "/".join(f"{100 * np.mean(ratio < k):.0f}" for k in (1, 2, 3))
    assert f"{np.median(e):.2f}" in printed
    assert "written: " in printed
    assert (out / "timing.png").read_bytes().startswith(b"\x89PNG")


def test_a_pair_beside_least_squares_and_opencv(drive, tmp_path):
    from calib_toolkit.evaluation.baselines import OPENCV_METHODS, opencv_has_hand_eye

    arguments = ("pair", drive, "-o", tmp_path, "--repeats", 2, "--seconds", 30, "--jobs", 1, "--baseline")
    printed = evaluate(*arguments)
    there = opencv_has_hand_eye()
    expected = [*METHODS, "least-squares", *(OPENCV_METHODS if there else [])]
    rows = rows_of(tmp_path / "pair.csv")
    assert [r["estimator"] for r in rows] == expected * 2
    assert {r["sensor"] for r in rows} == {"velo-ins"}
    assert ("this OpenCV has no calibrateHandEye (4.x has)" in printed) is not there
    ours = [r for r in rows if r["estimator"] in METHODS]
    assert max(float(r["rotation_deg"]) for r in ours) < 1
    assert max(float(r["translation_m"]) for r in ours) < 0.5


def test_a_panoramic_rig_without_images_says_so(drive, tmp_path):
    printed = evaluate("panoramic", drive, "-o", tmp_path, "--repeats", 1, "--jobs", 1)
    assert "no panorama: first holds no images, only motions of cam0" in printed
    expected = [f"{method}-{way}" for method in METHODS for way in ("together", "separate")]
    assert [r["estimator"] for r in rows_of(tmp_path / "panoramic.csv")] == expected
    assert not (tmp_path / "panorama.png").exists()


def test_a_drive_that_tells_nothing_is_rows_of_refusals(tmp_path):
    still = simulated(tmp_path / "still", seconds=30, drive="static")
    printed = evaluate("pair", still, "-o", tmp_path / "out", "--repeats", 2, "--seconds", 20, "--jobs", 1)
    rows = rows_of(tmp_path / "out" / "pair.csv")
    n = 2 * (len(METHODS) + 1)
    assert [r["status"] for r in rows] == ["refused"] * n
    assert all(r["note"] for r in rows)
    assert f"{n} rows, {n} of them refused" in printed


def test_methods_are_chosen_by_name(drive, tmp_path):
    arguments = ("pair", drive, "--repeats", 1, "--seconds", 20, "--jobs", 1)
    evaluate(*arguments, "-o", tmp_path / "one", "--method", "paper", "--method", "paper")
    assert [r["estimator"] for r in rows_of(tmp_path / "one" / "pair.csv")] == ["paper", "least-squares"]
    sentence = refused(*arguments, "-o", tmp_path / "one", "--seed", 1)
    assert "give the same, or choose another folder with -o" in sentence
    wrong = evaluate(*arguments, "-o", tmp_path / "two", "--method", "paper", "--method", "papier", status=2)
    assert f"there is no method 'papier'; there are: {', '.join(METHODS)}" in " ".join(wrong.split())
    assert not (tmp_path / "two").exists()


@pytest.fixture
def posed(tmp_path):
    """Two sensors' poses at the same stamps, with a truth; one pose of the second is not a number."""
    true, mount = path(40.0, 5, "rough"), se3.rigid(np.eye(3), np.array([0.5, -0.3, 0.2]))
    stamps = np.arange(0.0, 40.0, 0.1)
    rng = np.random.default_rng(1)
    for name, T in (("a", np.eye(4)), ("b", mount)):
        poses = true.at(stamps) @ T
        xyz = poses[:, :3, 3] + rng.normal(scale=1e-3, size=(len(stamps), 3))
        rows = np.column_stack([stamps, xyz, Rotation.from_matrix(poses[:, :3, :3]).as_quat()])
        rows[100, 1] = np.nan if name == "b" else rows[100, 1]
        np.savetxt(tmp_path / f"{name}.txt", rows)
    table = '[sensors.{0}]\nkind = "odometry"\nposes = "{0}.txt"\nformat = "tum"\n'
    (tmp_path / "rig.toml").write_text(table.format("a") + table.format("b"))
    sensors = {n: {"T_base_sensor": T.tolist(), "dt_base_sensor": 0.0} for n, T in (("a", np.eye(4)), ("b", mount))}
    (tmp_path / "truth.json").write_text(json.dumps({"base": "a", "sensors": sensors}))
    return tmp_path


def test_readings_that_were_left_out_are_told(posed):
    out = posed / "out"
    printed = evaluate("pair", posed, "-o", out, "--repeats", 1, "--seconds", 20, "--jobs", 1)
    summary = (out / "pair.md").read_text()
    for text in (printed, summary[summary.index("## Left out") :]):
        assert f"{posed.name}: " in text
        assert "b.txt" in text


def test_equal_stamps_are_no_reason_to_share_a_clock(posed):
    """The offset is estimated, as ``run`` does; only a reader knows which sensors are triggered together."""
    rows = np.loadtxt(posed / "b.txt")
    rows[100, 1] = rows[99:102:2, 1].mean()
    np.savetxt(posed / "b.txt", rows)
    out = posed / "out"
    evaluate("pair", posed, "-o", out, "--repeats", 1, "--seconds", 20, "--jobs", 1)
    assert float(rows_of(out / "pair.csv")[0]["sigma_dt_ms"]) > 0


# ---- once, and the same whatever happens


def test_the_number_of_processes_changes_nothing(drive, tmp_path):
    out = [tmp_path / "one", tmp_path / "two"]
    for folder, jobs in zip(out, (1, 2), strict=True):
        evaluate("pair", drive, "-o", folder, "--repeats", 2, "--seconds", "15", "--jobs", jobs)
    one, two = ((folder / "pair.csv").read_bytes() for folder in out)
    assert one == two
    assert (out[0] / "pair.md").read_bytes() == (out[1] / "pair.md").read_bytes()


def test_a_kill_loses_only_what_was_running(drive, tmp_path):
    arguments = ["pair", drive, "--repeats", 20, "--seconds", "12", "--jobs", 1, "--method", "paper"]
    evaluate(*arguments, "-o", tmp_path / "whole")
    whole = (tmp_path / "whole" / "pair.csv").read_bytes()

    out = tmp_path / "killed"
    code = "from calib_toolkit.cli import main; main()"
    command = [sys.executable, "-c", code, "evaluate", *map(str, arguments), "-o", str(out)]
    process = subprocess.Popen(command, stderr=subprocess.DEVNULL, env={**os.environ, "OMP_NUM_THREADS": "1"})
    table = out / "pair.csv"
    deadline = time.monotonic() + 60
    while not (table.exists() and table.read_bytes().count(b"\n") >= 9) and time.monotonic() < deadline:
        time.sleep(0.01)
    process.send_signal(signal.SIGKILL)
    process.wait()
    left = table.read_bytes()
    assert 9 <= left.count(b"\n") < 41, "killed too late to tell"
    evaluate(*arguments, "-o", out)
    assert table.read_bytes() == whole


def test_other_settings_in_the_same_folder_are_refused(drive, tmp_path):
    arguments = ("pair", drive, "-o", tmp_path, "--seconds", 20, "--jobs", 1)
    evaluate(*arguments, "--repeats", 1)
    sentence = refused(*arguments, "--repeats", 2)
    assert sentence.endswith(
        "pair.csv was begun with repeats = 1, and this is 2; give the same, or choose another folder with -o"
    )


# ---- what it refuses


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


# ---- the recordings


@pytest.fixture(scope="module")
def folders(recordings, tmp_path_factory):
    """docs/results/recordings.py on the real recordings."""
    out = tmp_path_factory.mktemp("recordings")
    script = Path(__file__).parents[2] / "docs" / "results" / "recordings.py"
    subprocess.run([sys.executable, script, recordings, out], check=True)
    return out


def test_the_recordings_become_folders_with_a_truth(folders):
    assert sorted(f.name for f in folders.iterdir()) == ["kitti", "kitti-ins", "kitti-kiss", "ladybug", "shrimp"]
    log = open_log(folders / "kitti")
    c = log.reference
    np.testing.assert_allclose([c.dt_between("cam0", f"cam{k}")[0] for k in range(4)], [0, 0, 6.14e-3, 6.70e-3])
    assert not c.determined[c.index("velo"), 6]
    # the baseline of KITTI's grey stereo pair
    assert c.between("cam0", "cam1").T_a_b[0, 3] == pytest.approx(0.54, abs=0.01)


@pytest.mark.long
@pytest.mark.parametrize(("name", "at_most"), [("kitti", 0.6), ("ladybug", 0.7)])
def test_clocks_of_the_recordings_are_found_within_a_millisecond(folders, tmp_path, name, at_most):
    evaluate("timing", folders / name, "-o", tmp_path, "--repeats", 5, "--seconds", "100", "--jobs", 2)
    rows = rows_of(tmp_path / "timing.csv")
    for method in METHODS:
        e = np.abs([float(r["dt_ms"]) for r in rows if r["estimator"] == method])
        assert len(e) == (30 if name == "kitti" else 40)
        assert np.median(e) < at_most
        assert e.max() < 3
