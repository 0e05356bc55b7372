"""``calib-toolkit evaluate``: what it writes, and what a kill leaves."""

import json

import numpy as np
import pytest
from evaluated import evaluate, refused, rows_of, simulated
from scipy.spatial.transform import Rotation
from small_runs import killed_when

from calib_toolkit import se3
from calib_toolkit.config import METHODS
from calib_toolkit_datasets.simulation.vehicle import path

ONCE = ("--repeats", 1, "--seconds", 20, "--jobs", 1, "--method", "joint")


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    return simulated(tmp_path_factory.mktemp("drives") / "first")


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
    printed = evaluate("pair", posed, "-o", out, *ONCE)
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
    evaluate("pair", posed, "-o", out, *ONCE)
    assert float(rows_of(out / "pair.csv")[0]["sigma_dt_ms"]) > 0


# ---- once, and the same whatever happens


def test_the_number_of_processes_changes_nothing(drive, tmp_path):
    out = [tmp_path / "one", tmp_path / "two"]
    for folder, jobs in zip(out, (1, 2), strict=True):
        evaluate("pair", drive, "-o", folder, "--repeats", 2, "--seconds", 15, "--jobs", jobs, "--method", "paper")
    one, two = ((folder / "pair.csv").read_bytes() for folder in out)
    assert one == two
    assert (out[0] / "pair.md").read_bytes() == (out[1] / "pair.md").read_bytes()


def test_a_kill_loses_only_what_was_running(drive, tmp_path):
    arguments = ["pair", drive, "--repeats", 9, "--seconds", "12", "--jobs", 1, "--method", "paper"]
    evaluate(*arguments, "-o", tmp_path / "whole")
    whole = (tmp_path / "whole" / "pair.csv").read_bytes()

    out = tmp_path / "killed"
    table = out / "pair.csv"

    def begun():
        return table.exists() and table.read_bytes().count(b"\n") >= 5

    killed_when(begun, "evaluate", *arguments, "-o", out, OMP_NUM_THREADS="1")
    left = table.read_bytes()
    assert 5 <= left.count(b"\n") < 19, "killed too late to tell"
    evaluate(*arguments, "-o", out)
    assert table.read_bytes() == whole


def test_other_settings_in_the_same_folder_are_refused(drive, tmp_path):
    arguments = ("pair", drive, "-o", tmp_path, "--seconds", 20, "--jobs", 1, "--method", "paper")
    evaluate(*arguments, "--repeats", 1)
    sentence = refused(*arguments, "--repeats", 2)
    assert sentence.endswith(
        "pair.csv was begun with repeats = 1, and this is 2; give the same, or choose another folder with -o"
    )
