"""What users get wrong: every refusal is one sentence that names the thing, and nothing is written."""

import json
import subprocess
import sys

import numpy as np
import pytest
from click.testing import CliRunner
from scipy.spatial.transform import Rotation

from calib_toolkit import cli
from calib_toolkit_datasets import simulated

HEAD = "seconds = 40\nseed = 1\n"
VELO = "[sensors.velo]\npose = [0, 0, 1.7, 0, 0, 0]\n"
INS = "[sensors.ins]\npose = [-0.8, 0.3, 0.9, 0.8, -0.1, 1.0]\nrate = 20.0\ndt = -0.06\n"
CAM = "[sensors.cam0]\npose = [0.3, 0.1, 1.6, -90.0, 0.0, -90.0]\nhas_scale = false\n"
CAM1 = "[sensors.cam1]\npose = [0.3, -0.4, 1.6, -90.0, 0.0, -120.0]\nhas_scale = false\n"
RIG = '[sensors.a]\nkind = "odometry"\nposes = "a.txt"\nformat = "tum"\n' + (
    '[sensors.b]\nkind = "odometry"\nposes = "b.txt"\nformat = "tum"\n'
)
DEEP = "x = " + "[" * 5000 + "]" * 5000
READERS = ("kitti-360", "kitti-raw", "multi-array-calib", "rig", "simulated")
EPOCH = 1_317_000_000.0


@pytest.fixture(autouse=True)
def _own_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("CALIB_TOOLKIT_CACHE", str(tmp_path / "cache"))


@pytest.fixture
def run(tmp_path):
    """The command ``run`` on a drive, its result going to ``out``."""

    def run(drive, *arguments):
        command = ["run", drive, "-o", tmp_path / "out", "--jobs", 1, *arguments]
        return CliRunner().invoke(cli.main, [str(a) for a in command])

    return run


@pytest.fixture
def refused(run, tmp_path):
    """Runs what must be refused, and returns the sentence."""

    def refused(drive, *arguments, status=1):
        result = run(drive, *arguments)
        assert result.exit_code == status, result.output
        assert "Traceback" not in result.output
        assert not (tmp_path / "out/calibration.json").exists()
        said = [line for line in result.stderr.splitlines() if line.startswith(("calib-toolkit: ", "Error: "))]
        assert len(said) == 1, result.stderr
        assert result.stderr.splitlines()[-1] == said[0]
        assert not said[0].startswith("calib-toolkit: unexpected "), said[0]
        return said[0]

    return refused


@pytest.fixture
def written(tmp_path):
    """The calibration.json that was written, as strict JSON."""

    def written():
        def no(constant):
            raise AssertionError(f"{constant} is not JSON")

        return json.loads((tmp_path / "out/calibration.json").read_text(), parse_constant=no)

    return written


@pytest.fixture
def drive(tmp_path):
    """A simulated drive."""

    def drive(body=VELO + INS, head=HEAD):
        folder = tmp_path / "drive"
        folder.mkdir()
        (folder / "simulated.toml").write_text(head + body)
        return folder

    return drive


@pytest.fixture
def rig(tmp_path):
    """Two odometries of one drive as TUM files; ``change`` alters stamps, positions and quaternions of b."""

    def rig(change=lambda t, p, q: (t, p, q), form="%.6f"):
        folder = tmp_path / "rig"
        folder.mkdir()
        (folder / "rig.toml").write_text(RIG)
        true = simulated.path(30.0, 1, "rough")
        stamps = np.arange(300) / 10
        for name, lever in (("a", 0.0), ("b", 0.5)):
            T = true.at(stamps) @ np.block([[np.eye(3), np.full((3, 1), lever)], [np.zeros((1, 3)), 1.0]])
            noise = np.random.default_rng([7, ord(name)]).normal(scale=0.003, size=(300, 3))
            columns = (stamps + EPOCH, T[:, :3, 3] + noise, Rotation.from_matrix(T[:, :3, :3]).as_quat())
            t, p, q = change(*columns) if name == "b" else columns
            stamp = form if name == "b" else "%.6f"
            rows = (stamp % s + "".join(f" {x:.9f}" for x in (*a, *b)) for s, a, b in zip(t, p, q, strict=True))
            (folder / f"{name}.txt").write_text("\n".join(rows) + "\n")
        return folder

    return rig


def options(tmp_path, text):
    file = tmp_path / "options.toml"
    file.write_bytes(text if isinstance(text, bytes) else text.encode())
    return "--config", file


# ---- where the recording is


def test_a_path_that_does_not_exist(refused, tmp_path):
    assert f"{tmp_path / 'nowhere'} does not exist" in refused(tmp_path / "nowhere")


@pytest.mark.parametrize("kind", ["folder", "file", "empty file"])
def test_what_no_reader_knows_says_what_each_looks_for(refused, tmp_path, kind):
    path = tmp_path / "holiday"
    path.mkdir() if kind == "folder" else path.write_text("" if kind == "empty file" else "milk, eggs")
    sentence = refused(path)
    assert f"no reader knows {path}" in sentence
    assert all(f"{reader} looks for " in sentence for reader in READERS)


@pytest.mark.parametrize("reader", READERS)
@pytest.mark.parametrize("is_file", [False, True])
def test_a_reader_on_what_is_not_its_own_names_the_path(refused, tmp_path, reader, is_file):
    path = tmp_path / "other"
    path.write_text("milk") if is_file else path.mkdir()
    assert str(path) in refused(path, "--format", reader)


def test_a_reader_that_does_not_exist_is_told_those_that_do(refused, drive):
    sentence = refused(drive(), "--format", "kitty")
    assert "no reader is called 'kitty'" in sentence
    assert ", ".join(READERS) in sentence


def test_the_process_itself_exits_with_1_and_one_line(tmp_path):
    code = "from calib_toolkit.cli import main; main()"
    command = [sys.executable, "-c", code, "run", str(tmp_path / "nowhere")]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (1, "")
    assert done.stderr.strip().count("\n") == 0
    assert done.stderr.startswith("calib-toolkit: ")


# ---- which sensors, which part, which options


def test_an_unknown_sensor_is_told_those_there_are(refused, drive):
    sentence = refused(drive(), "--sensors", "velo,lidar")
    assert "no sensor named 'lidar'" in sentence
    assert "velo, ins" in sentence


def test_one_sensor_only(refused, drive):
    sentence = refused(drive(), "--sensors", "velo")
    assert "at least two sensors" in sentence
    assert "velo" in sentence


def test_a_sensor_named_twice(refused, drive):
    assert "sensor 'velo' is named twice" in refused(drive(), "--sensors", "velo,velo")


def test_no_sensor_named_is_wrong_usage(refused, drive):
    assert "--sensors" in refused(drive(), "--sensors", " , ", status=2)


def test_a_base_that_is_not_there(refused, drive):
    sentence = refused(drive(), "--base", "radar")
    assert "'radar'" in sentence
    assert "velo, ins" in sentence


def test_a_camera_can_not_be_the_base(refused, drive):
    sentence = refused(drive(VELO + CAM), "--base", "cam0")
    assert "'cam0'" in sentence
    assert sentence.endswith(": velo")


@pytest.mark.parametrize("start", ["1000", "inf", "nan"])
def test_a_start_beyond_the_end(refused, drive, start):
    assert "start" in refused(drive(), "--start", start)


def test_a_start_before_the_start(refused, drive):
    assert "start" in refused(drive(), "--start", "-10")


@pytest.mark.parametrize("duration", ["0", "-5", "nan", "inf"])
def test_a_duration_that_is_none(refused, drive, duration):
    assert "duration" in refused(drive(), "--duration", duration)


@pytest.mark.parametrize("duration", ["0.05", "0.5", "1.5"])
def test_a_part_too_short_to_tell_anything(refused, drive, duration):
    sentence = refused(drive(), "--duration", duration)
    assert "part" in sentence
    assert "clock" not in sentence or "long" in sentence


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("speed = 3", ("'speed'", "duration", "sensors")),
        ("[timing]\nspeed = 3", ("[timing]", "'speed'", "max_offset")),
        ("==", ("TOML",)),
        (b"\xff\xfe\x00", ("TOML",)),
        (DEEP, ("TOML",)),
        ("timing = 3", ("[timing]",)),
        ("sensors = [1]", ("[sensors]",)),
        ("[sensors]\nvelo = 1", ("[sensors.velo]",)),
        ("[sensors.velo]\nspeed = 1", ("[sensors.velo]", "'speed'", "motion_sigma")),
        ("[sensors.vello]\nmotion_sigma = [1, 1, 1, 1, 1, 1]", ("vello", "velo, ins")),
        ("start = 1979-05-27", ("start",)),
        ("base = 5", ("base",)),
        ("duration = 'long'", ("duration",)),
        ("duration = [1]", ("duration",)),
        ("duration = true", ("duration",)),
        ("duration = nan", ("duration",)),
        ("start = nan", ("start",)),
        ("jobs = 0", ("jobs",)),
        ("method = 'magic'", ("'magic'", "paper")),
        ("[timing]\nsteps = 0", ("timing.steps",)),
        ("[timing]\nsteps = -5", ("timing.steps",)),
        ("[timing]\nmax_offset = -1.0", ("timing.max_offset",)),
        ("[timing]\nmax_offset = nan", ("timing.max_offset",)),
        ("[timing]\ntrim = nan", ("timing.trim",)),
        ("[timing]\nstart = 'guess'", ("'guess'", "correlation")),
        ("[rotation]\ntrim = 1.0", ("rotation.trim",)),
        ("[rotation]\ntrim = true", ("trim", "True")),
        ("[translation]\ntrim = -0.1", ("translation.trim",)),
        ("[sync]\ngate = 0.0", ("sync.gate",)),
        ("[sync]\ngate = nan", ("sync.gate",)),
    ],
)
def test_options_that_make_no_sense(refused, drive, tmp_path, text, words):
    sentence = refused(drive(), *options(tmp_path, text))
    for word in words:
        assert word in sentence


def test_options_that_are_not_there(refused, drive, tmp_path):
    assert "none.toml" in refused(drive(), "--config", tmp_path / "none.toml")
    assert str(tmp_path) in refused(tmp_path / "drive", "--config", tmp_path)


def test_a_plugin_that_is_not_there(refused, drive, tmp_path):
    assert "none.py" in refused(drive(), "--plugin", tmp_path / "none.py")


@pytest.mark.parametrize(("option", "value"), [("--jobs", "0"), ("--method", "magic"), ("--start", "early")])
def test_wrong_usage_exits_with_2(refused, drive, option, value):
    assert option in refused(drive(), option, value, status=2)


# ---- where the result goes


def test_a_result_folder_that_is_a_file_is_wrong_usage(run, drive, tmp_path):
    (tmp_path / "out").write_text("mine")
    assert run(drive()).exit_code == 2
    assert (tmp_path / "out").read_text() == "mine"


def test_a_result_folder_that_can_not_be_made(refused, drive, tmp_path):
    (tmp_path / "note").write_text("")
    assert str(tmp_path / "note") in refused(drive(), "-o", tmp_path / "note/out")


def test_something_in_the_place_of_the_result(refused, drive, tmp_path):
    (tmp_path / "taken/calibration.json").mkdir(parents=True)
    assert str(tmp_path / "taken") in refused(drive(), "-o", tmp_path / "taken")


# ---- what the drive does not tell


BODIES = pytest.mark.parametrize(
    "body", [VELO + INS, VELO + INS + CAM, CAM + CAM1], ids=["scaled", "camera", "cameras"]
)


@BODIES
@pytest.mark.parametrize(("kind", "method"), [("static", "joint"), ("static", "paper"), ("straight", "paper")])
def test_no_turning_at_all(refused, drive, kind, method, body):
    sentence = refused(drive(body, HEAD + f"drive = '{kind}'\n"), "--method", method)
    assert "turn" in sentence
    assert "overlap" not in sentence
    assert "drive" in sentence.partition("turn")[2]  # what to do about it


def test_cameras_on_a_straight_drive_are_refused(refused, drive):
    sentence = refused(drive(CAM + CAM1, HEAD + "drive = 'straight'\n"))
    assert "drive bends to both sides" in sentence


@pytest.mark.parametrize("body", [VELO + INS, VELO + INS + CAM], ids=["scaled", "camera"])
def test_a_straight_drive_leaves_open_what_it_can_not_tell(run, drive, written, body):
    result = run(drive(body, HEAD + "drive = 'straight'\n"))
    assert result.exit_code == 3, result.output
    found = written()
    for name in list(found["sensors"])[1:]:
        assert [found["sensors"][name]["sigma"][k] for k in ("x", "y", "z", "rx")] == [None] * 4
        assert all(found["sensors"][name]["sigma"][k] > 0 for k in ("ry", "rz"))
    said = " ".join(u["sentence"] for u in found["undetermined"])
    assert "the vehicle only drove straight ahead; drive bends to both sides" in said


def test_a_plane_tells_no_height(run, drive, written):
    result = run(drive(head=HEAD + "drive = 'planar'\n"))
    assert result.exit_code == 3
    found = written()
    assert found["sensors"]["ins"]["sigma"]["z"] is None
    assert found["sensors"]["ins"]["T_base_sensor"][2][3] is None
    assert any("ins" in u["sentence"] and u["direction"].get("ins.z", 0) for u in found["undetermined"])


def test_cameras_only_have_rotation_and_time_but_no_translation(run, drive, written):
    result = run(drive(CAM + CAM1))
    assert result.exit_code == 3, result.output
    found = written()
    cam1 = found["sensors"]["cam1"]
    T = np.array(cam1["T_base_sensor"], dtype=float)
    truth = Rotation.from_euler("ZYX", [[-90, 0, -90], [-120, 0, -90]], degrees=True)
    error = (truth[0].inv() * truth[1]).inv() * Rotation.from_matrix(T[:3, :3])
    assert np.degrees(error.magnitude()) < 1.5
    assert abs(cam1["dt_base_sensor"]) < 0.01
    assert np.isnan(T[:3, 3]).all()
    assert [cam1["sigma"][k] for k in "xyz"] == [None] * 3
    assert all(cam1["sigma"][k] > 0 for k in ("rx", "ry", "rz", "dt"))
    reasons = [u["sentence"] for u in found["undetermined"] if u["direction"].get("cam1.x")]
    assert reasons
    assert "no sensor knows distances" in reasons[0]


def test_no_overlap_in_time(refused, drive):
    sentence = refused(drive(VELO + INS.replace("-0.06", "100.0")))
    assert "velo" in sentence
    assert "ins" in sentence
    assert "epoch" in sentence


def test_clocks_that_are_far_apart_are_found(run, rig, written):
    result = run(rig(lambda t, p, q: (t + 15.0, p, q)))
    assert result.exit_code == 0, result.output
    b = written()["sensors"]["b"]
    assert b["dt_base_sensor"] == pytest.approx(-15.0, abs=2e-3)
    assert [row[3] for row in b["T_base_sensor"][:3]] == pytest.approx([0.5] * 3, abs=4 * b["sigma"]["z"])


def test_clocks_further_apart_than_the_papers_search_are_not_believed(run, rig, written):
    result = run(rig(lambda t, p, q: (t + 15.0, p, q)), "--method", "paper")
    if result.exit_code == 1:
        return
    assert result.exit_code == 3, result.output
    b = written()["sensors"]["b"]
    assert b["dt_base_sensor"] is None
    # what was made of readings that do not belong together must not pass as measured
    assert [b["sigma"][k] for k in ("x", "y", "z", "rx", "ry", "rz")] == [None] * 6


# ---- readings


def test_rows_that_are_nan_are_left_out_and_said(run, rig, written):
    def change(t, p, q):
        return t, np.where(np.isin(np.arange(300), range(100, 105))[:, None], np.nan, p), q

    assert run(rig(change)).exit_code == 3
    found = written()
    (warning,) = found["warnings"]
    assert "b.txt: 5 of 300 rows hold nan" in warning
    assert "line 101" in warning
    assert found["statistics"]["readings"] == {"a": 299, "b": 294}


def test_stamps_that_go_back_or_repeat_are_left_out_and_said(run, rig, written):
    def change(t, p, q):
        t = t.copy()
        t[50] -= 3.0
        t[60] = t[59]
        return t, p, q

    assert run(rig(change)).exit_code == 3
    (warning,) = written()["warnings"]
    assert "b.txt: 2 of 300 rows have a stamp that goes back or repeats" in warning
    assert "line 51" in warning


def test_mostly_nan_is_refused(refused, rig):
    folder = rig(lambda t, p, q: (t, np.where(np.arange(300)[:, None] % 3 == 0, p, np.nan), q))
    assert "b.txt: 200 of 300 rows hold nan" in refused(folder)


@pytest.mark.parametrize("factor", [1e3, 1e9])
def test_an_epoch_in_another_unit(refused, rig, factor):
    sentence = refused(rig(lambda t, p, q: (t * factor, p, q), form="%.0f"))
    assert "b.txt, line 1" in sentence
    assert "unit" in sentence


def test_milliseconds_since_the_start_for_seconds(refused, rig):
    sentence = refused(rig(lambda t, p, q: (EPOCH + (t - EPOCH) * 1e3, p, q)))
    assert "clocks" in sentence


@pytest.mark.parametrize("factor", [1e3, 1e-3])
def test_another_unit_of_length_is_not_taken_for_metres(run, rig, factor):
    result = run(rig(lambda t, p, q: (t, p * factor, q)))
    assert result.exit_code in (1, 3), result.output
    assert any(word in result.output for word in ("distance", "metres", "scale", "unit", "far"))


def test_a_sensor_whose_poses_never_change(refused, rig):
    sentence = refused(rig(lambda t, p, q: (t, 0 * p, np.tile([0.0, 0.0, 0.0, 1.0], (300, 1)))))
    assert "turn" in sentence


def test_quaternions_that_are_none(refused, rig):
    assert "b.txt, line 1: the quaternion" in refused(rig(lambda t, p, q: (t, p, 3 * q)))


def shortened(folder, rows, tail=""):
    file = folder / "b.txt"
    file.write_text("".join(file.read_text().splitlines(keepends=True)[:rows]) + tail)
    return folder


@pytest.mark.parametrize(
    ("rows", "tail", "words"),
    [
        (0, "", "b.txt holds no rows"),
        (1, "", "b.txt has one row"),
        (5, "", "sensor b: its 4 steps are too few"),
        (150, "1317000015.0 0.5 0.1", "b.txt, line 151: 3 columns"),
        (150, "1317000015.0 0.5 0.1 x 0 0 0 1", "b.txt, line 151"),
    ],
)
def test_files_cut_short(refused, rig, rows, tail, words):
    assert words in refused(shortened(rig(), rows, tail))


def test_a_file_that_is_missing(refused, rig):
    folder = rig()
    (folder / "b.txt").unlink()
    sentence = refused(folder)
    assert "sensor b" in sentence
    assert str(folder / "b.txt") in sentence


@pytest.mark.parametrize(
    "text", ["", "[sensors.a\n", DEEP, "[sensors]\n", "sensors = 3\n", "[sensors.a]\nkind = 3\n"]
)
def test_a_rig_that_makes_no_sense(refused, rig, text):
    folder = rig()
    (folder / "rig.toml").write_text(text)
    assert "rig.toml" in refused(folder)


@pytest.mark.parametrize(
    ("head", "body"),
    [
        ("", DEEP),
        ("\x00", ""),
        (HEAD, ""),
        (HEAD, "sensors = []\n"),
        (HEAD, "sensors = {}\n"),
        (HEAD, "[sensors]\nvelo = 1\n"),
        (HEAD, VELO + INS.replace("20.0", "0")),
        (HEAD, VELO + INS.replace("20.0", "nan")),
        (HEAD, VELO + INS.replace("20.0", "'x'")),
        (HEAD, VELO.replace("1.7", "nan") + INS),
        (HEAD, VELO.replace(", 0]", "]") + INS),
        (HEAD, VELO + "sigma = [1, 1]\n" + INS),
        (HEAD, VELO + "speed = 1\n" + INS),
        (HEAD + "drive = 'strait'\n", VELO + INS),
        ("seconds = 0\nseed = 1\n", VELO + INS),
        ("seconds = -9\nseed = 1\n", VELO + INS),
        ("seconds = nan\nseed = 1\n", VELO + INS),
        ("seconds = 1e12\nseed = 1\n", VELO + INS),
        ("seconds = 40\nseed = -1\n", VELO + INS),
    ],
)
def test_a_simulation_that_makes_no_sense(refused, drive, head, body):
    assert "simulated.toml" in refused(drive(body, head))


def test_stored_motions_that_are_damaged(refused, tmp_path):
    (tmp_path / "KittiVelData.mat").write_bytes(b"MATLAB 5.0 MAT-file" + bytes(200))
    (tmp_path / "KittiNavData.mat").write_bytes(b"")
    sentence = refused(tmp_path)
    assert "Data.mat: sensor " in sentence
    assert "fetch it again" in sentence


@pytest.fixture
def kitti(tmp_path):
    """Three seconds of KITTI raw: OXTS packets that are whole, and scans that hold the bytes given."""

    def kitti(scan, packet=lambda k: f"49.0 {8.4 + 1e-5 * k} 110 0 0 {0.05 * k}" + " 0" * 24):
        folder = tmp_path / "2011_09_26/2011_09_26_drive_0001_sync"
        for name, suffix, content in (
            ("oxts", "txt", lambda k: packet(k).encode()),
            ("velodyne_points", "bin", scan),
        ):
            (folder / name / "data").mkdir(parents=True)
            stamps = (f"2011-09-26 13:02:{25 + k / 10:012.9f}" for k in range(30))
            (folder / name / "timestamps.txt").write_text("\n".join(stamps) + "\n")
            for k in range(30):
                (folder / name / f"data/{k:010d}.{suffix}").write_bytes(content(k))
        return folder

    return kitti


@pytest.mark.parametrize("scan", [b"", b"\0" * 17, np.full(8, np.nan, dtype=np.float32).tobytes()])
def test_scans_that_are_empty_cut_short_or_nan(refused, kitti, scan):
    sentence = refused(kitti(lambda k: scan))
    assert "sensor velo: 30 of 30 readings can not be read" in sentence
    assert "0000000000.bin" in sentence
    assert "frame 0" in sentence


def test_fixes_that_are_cut_short(refused, kitti):
    points = np.random.default_rng(1).normal(size=(50, 4)).astype(np.float32).tobytes()
    sentence = refused(kitti(lambda k: points, packet=lambda k: "49.0 8.4 110"), "--sensors", "ins,velo")
    assert "sensor ins: 30 of 30 readings can not be read" in sentence
    assert "0000000000.txt" in sentence


def test_a_drive_without_any_reading(refused, kitti):
    folder = kitti(lambda k: b"")
    for file in folder.glob("*/data/*"):
        file.unlink()
    sentence = refused(folder)
    assert str(folder) in sentence
    assert "ins is left out" in sentence
