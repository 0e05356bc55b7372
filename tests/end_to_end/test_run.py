"""The whole way on a small simulated drive: the file that comes out, its numbers, and the choices of a run."""

import json

import numpy as np
import pytest
import small_runs
from click.testing import CliRunner
from scipy.spatial.transform import Rotation
from small_runs import SHARP_CAM, SHARP_INS, SHARP_VELO, as_array, recorded

from calib_toolkit import Config, calibrate, cli, open_log
from calib_toolkit.result_file import calibration_dict, read_calibration, result_dict, write_result
from calib_toolkit.types.calibration import PARAMETERS

DRIVE = 'seconds = 80\nseed = 5\ndrive = "rough"\n' + SHARP_VELO + SHARP_INS + SHARP_CAM + "dt = 0.025\n"
SIGMA_KEYS = ["x", "y", "z", "rx", "ry", "rz", "dt"]
CALIBRATION_KEYS = {"base", "sensors", "covariance", "undetermined"}
SENSOR_KEYS = {"T_base_sensor", "dt_base_sensor", "clock_skew", "t_ref", "sigma", "has_scale"}


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    return recorded(tmp_path_factory.mktemp("drive"), DRIVE)


@pytest.fixture(scope="module")
def run(drive, tmp_path_factory):
    """The command on the drive, each time into a folder of its own."""
    return lambda *arguments: small_runs.run(drive, tmp_path_factory.mktemp("out"), *arguments)


@pytest.fixture(scope="module")
def whole(run):
    """One run with nothing chosen: (what was printed, the file's content as text)."""
    status, printed, text = run()
    assert status == 0, printed
    return printed, text


@pytest.fixture(scope="module")
def found(whole):
    def no(constant):
        raise AssertionError(f"{constant} is not JSON")

    return json.loads(whole[1], parse_constant=no)


@pytest.fixture(scope="module")
def truth(drive):
    return open_log(drive).reference


# ---- the schema


def test_the_file_has_what_programs_rely_on(found):
    assert found.keys() >= {"base", "sensors", "covariance", "undetermined", "stages", "configuration", "versions"}
    assert found.keys() >= {"statistics", "warnings"}
    assert found["base"] == "velo"
    assert list(found["sensors"]) == ["velo", "ins", "cam0"]
    assert found["warnings"] == []
    assert found["undetermined"] == []


def test_each_sensor_has_its_pose_clock_and_sigma(found):
    for name, sensor in found["sensors"].items():
        assert set(sensor) == SENSOR_KEYS
        T = as_array(sensor["T_base_sensor"])
        np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-9)
        assert np.linalg.det(T[:3, :3]) > 0
        assert T[3].tolist() == [0, 0, 0, 1]
        assert list(sensor["sigma"]) == SIGMA_KEYS
        assert sensor["has_scale"] is (name != "cam0")
        assert sensor["clock_skew"] == 0.0
        assert sensor["t_ref"] == pytest.approx(40.0, abs=0.2)  # the middle of the drive
    assert set(found["sensors"]["velo"]["sigma"].values()) == {0.0}
    assert found["sensors"]["velo"]["dt_base_sensor"] == 0.0
    assert as_array(found["sensors"]["velo"]["T_base_sensor"]).tolist() == np.eye(4).tolist()


def test_the_covariance_is_that_of_the_named_order(found):
    names = list(found["sensors"])
    assert found["covariance"]["order"] == [f"{n}.{p}" for n in names for p in PARAMETERS]
    assert list(PARAMETERS) == SIGMA_KEYS
    C = as_array(found["covariance"]["matrix"])
    assert C.shape == (21, 21)
    np.testing.assert_allclose(C, C.T, atol=1e-15)
    assert np.linalg.eigvalsh(C).min() > -1e-12
    sigma = [found["sensors"][n]["sigma"][p] for n in names for p in PARAMETERS]
    np.testing.assert_allclose(np.sqrt(np.diag(C)), sigma, rtol=1e-9)
    assert not C[:7].any()  # the base is where it is
    assert all(s > 0 for s in sigma[7:])


def test_every_stage_is_in_the_schema_of_the_whole(found):
    assert list(found["stages"]) == ["timing", "rotation", "motion"]
    for stage in found["stages"].values():
        assert set(stage) == CALIBRATION_KEYS
        assert list(stage["sensors"]) == list(found["sensors"])
        assert all(set(s) == SENSOR_KEYS for s in stage["sensors"].values())
    assert found["stages"]["motion"] == {key: found[key] for key in found["stages"]["motion"]}


def test_a_stage_gives_null_for_what_a_later_one_finds(found):
    timing, rotation = (found["stages"][s]["sensors"]["ins"] for s in ("timing", "rotation"))
    last = found["sensors"]["ins"]
    assert timing["dt_base_sensor"] == last["dt_base_sensor"]
    assert [timing["sigma"][k] for k in SIGMA_KEYS[:6]] == [None] * 6
    assert [rotation["sigma"][k] for k in "xyz"] == [None] * 3
    assert [row[3] for row in rotation["T_base_sensor"][:3]] == [None] * 3
    # travel tells of a rotation, too, so the last stage knows it better
    assert all(0 < last["sigma"][k] < 0.95 * rotation["sigma"][k] for k in ("ry", "rz"))
    apart = as_array(rotation["T_base_sensor"])[:3, :3].T @ as_array(last["T_base_sensor"])[:3, :3]
    assert Rotation.from_matrix(apart).magnitude() < 4 * max(rotation["sigma"][k] for k in ("rx", "ry", "rz"))


def test_the_configuration_is_resolved_and_the_versions_are_named(found):
    options = found["configuration"]
    assert options.keys() >= {"method", "base", "start", "duration", "jobs", "seed", "sync", "timing", "rotation"}
    assert (options["method"], options["seed"], options["start"]) == ("joint", 0, 0.0)
    assert options["timing"]["steps"] == 10_000
    assert options["rotation"]["trim"] == options["translation"]["trim"] == 0.25
    assert options["sync"]["gate"] == 10.0
    assert found["versions"].keys() >= {"calib-toolkit", "python", "numpy", "scipy"}


def test_the_statistics_count_what_was_used(found):
    counts = found["statistics"]
    assert counts["readings"] == {"velo": 799, "ins": 1599, "cam0": 799}
    assert 780 <= counts["common_steps"] + counts["steps_rejected"] <= 799
    assert counts["seconds"] == pytest.approx(80, abs=3)


def test_the_statistics_tell_of_noise_and_of_how_long_to_drive(found):
    counts = found["statistics"]
    names = set(found["sensors"])
    assert set(counts["rejected"]) == set(counts["noise_scale"]) == set(counts["bias_deg"]) == names
    assert set(counts["strength"]) == set(counts["driving"]) == names - {"velo"}
    assert counts["prior"] == []
    for name in ("ins", "cam0"):
        sigma, needs = found["sensors"][name]["sigma"], counts["driving"][name]
        assert needs["z"] == pytest.approx(counts["seconds"] * (sigma["z"] / 0.02) ** 2, abs=0.1)
        assert needs["ry"] == pytest.approx(counts["seconds"] * (sigma["ry"] / 1e-3) ** 2, abs=0.1)


def test_the_papers_method_is_one_option_away(run, found):
    status, printed, text = run("--method", "paper", "--sensors", "velo,ins")
    assert status == 0, printed
    paper = json.loads(text)
    assert list(paper["stages"]) == ["timing", "rotation", "translation"]
    assert paper["configuration"]["method"] == "paper"
    last, turned = paper["sensors"]["ins"], paper["stages"]["rotation"]["sensors"]["ins"]
    assert [turned["sigma"][k] for k in ("rx", "ry", "rz")] == [last["sigma"][k] for k in ("rx", "ry", "rz")]
    there = as_array(found["sensors"]["ins"]["T_base_sensor"])
    assert np.abs((as_array(last["T_base_sensor"]) - there)[:3, 3]).max() < 0.08


# ---- the numbers


@pytest.mark.parametrize("name", ["ins", "cam0"])
def test_the_truth_is_found(found, truth, name):
    sensor = found["sensors"][name]
    T, expected = as_array(sensor["T_base_sensor"]), truth.between("velo", name).T_a_b
    turn = Rotation.from_matrix(expected[:3, :3] @ T[:3, :3].T).as_rotvec()
    error = np.concatenate([expected[:3, 3] - T[:3, 3], turn, [truth.dt_between("velo", name)[0]]])
    error[6] -= sensor["dt_base_sensor"]
    # measured: at most 0.04 m, 0.08 deg and 0.4 ms
    assert np.abs(error[:3]).max() < 0.08
    assert np.degrees(np.abs(error[3:6]).max()) < 0.15
    assert abs(error[6]) < 1e-3
    assert np.all(np.abs(error) < 5 * as_array([sensor["sigma"][k] for k in SIGMA_KEYS]))


def test_the_table_says_what_the_file_says(whole, found):
    row = next(line.split() for line in whole[0].splitlines() if line.split()[:2] == ["ins", "estimate"])
    assert [float(x) for x in row[2:5]] == [round(r[3], 3) for r in found["sensors"]["ins"]["T_base_sensor"][:3]]
    assert float(row[8]) == round(1e3 * found["sensors"]["ins"]["dt_base_sensor"], 2)
    assert "reference" in whole[0]


# ---- back in, again, and in Python


def test_what_is_read_back_is_what_was_written(whole, found, tmp_path):
    (tmp_path / "calibration.json").write_text(whole[1])
    back = calibration_dict(read_calibration(tmp_path / "calibration.json"))
    assert back == {key: found[key] for key in back}


def test_two_runs_say_the_same_byte_for_byte(run, whole):
    assert run()[2] == whole[1]


def test_three_lines_of_python_say_what_the_command_says(drive, whole, tmp_path):
    log = open_log(drive)
    result = calibrate(log, Config(jobs=1))
    write_result(result, tmp_path / "calibration.json")
    assert (tmp_path / "calibration.json").read_text() == whole[1]
    assert result_dict(result) == json.loads(whole[1])


# ---- the choices


def test_sensors_are_those_named_in_that_order(run):
    status, printed, text = run("--sensors", "cam0,ins")
    assert status == 0, printed
    found = json.loads(text)
    assert found["base"] == "ins"  # the first named that has scale
    assert list(found["sensors"]) == ["ins", "cam0"]


def test_another_base_describes_the_same_rig(run, found):
    status, printed, text = run("--base", "ins")
    assert status == 0, printed
    other = json.loads(text)
    assert (other["base"], other["configuration"]["base"]) == ("ins", "ins")
    assert list(other["sensors"]) == ["ins", "velo", "cam0"]
    there, back = as_array(found["sensors"]["ins"]["T_base_sensor"]), other["sensors"]["velo"]
    together = there @ as_array(back["T_base_sensor"])
    assert np.abs(together[:3, 3]).max() < 0.05
    assert np.degrees(Rotation.from_matrix(together[:3, :3]).magnitude()) < 0.1
    assert back["dt_base_sensor"] == pytest.approx(-found["sensors"]["ins"]["dt_base_sensor"], abs=1e-3)


def test_a_part_of_the_drive(run):
    status, printed, text = run("--start", "20", "--duration", "30")
    assert status in (0, 3), printed
    found = json.loads(text)
    assert found["statistics"]["readings"]["velo"] == pytest.approx(300, abs=1)
    assert (found["configuration"]["start"], found["configuration"]["duration"]) == (20.0, 30.0)


def test_options_come_from_the_file_and_the_command_line_goes_before_it(run, tmp_path):
    (tmp_path / "o.toml").write_text(
        'duration = 50\nseed = 4\nbase = "ins"\n[timing]\nsteps = 4000\n[sensors.odometry]\nhas_scale = true\n'
    )
    status, printed, text = run("--config", tmp_path / "o.toml", "--seed", "9", "--sensors", "velo,ins")
    assert status in (0, 3), printed
    used = json.loads(text)["configuration"]
    assert (used["duration"], used["seed"], used["base"], used["timing"]["steps"]) == (50, 9, "ins", 4000)
    assert used["sensors"] == {"odometry": {"has_scale": True}}
    assert json.loads(text)["base"] == "ins"


def test_no_folder_is_written_unless_asked_for(drive, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    done = CliRunner().invoke(cli.main, ["run", str(drive), "--jobs", "1", "--duration", "40"])
    assert done.exit_code in (0, 3), done.output
    assert list(tmp_path.iterdir()) == []
