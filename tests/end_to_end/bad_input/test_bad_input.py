"""What users get wrong before any reading is looked at: paths, sensors, parts, options, places for results."""

import subprocess
import sys

import pytest
from small_runs import CAM, DEEP, VELO

READERS = (
    *("argoverse2", "euroc", "folder", "kitti-360", "kitti-odometry", "kitti-raw", "mcap", "multi-array-calib"),
    *("nuscenes", "rig", "rosbag1", "rosbag2", "simulated", "tum"),
)


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
    assert all(reader in sentence for reader in READERS)


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
