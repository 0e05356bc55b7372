"""The whole way on a small simulated drive: the file that comes out, its numbers, and the choices of a run."""

import json
from io import StringIO

import numpy as np
import pytest
from click.testing import CliRunner
from rich.console import Console
from scipy.spatial.transform import Rotation

from calib_toolkit import Calibration, Config, Result, calibrate, cli, open_log
from calib_toolkit.cli.tables import show_result
from calib_toolkit.result_file import calibration_dict, read_calibration, result_dict, write_result
from calib_toolkit.types.calibration import PARAMETERS

DRIVE = """
seconds = 80
seed = 5
drive = "rough"
[sensors.velo]
pose = [0.0, 0.0, 1.7, 0.0, 0.0, 0.0]
sigma = [0.004, 0.004, 0.004, 2e-4, 2e-4, 2e-4]
[sensors.ins]
pose = [-0.8, 0.3, 0.9, 0.8, -0.1, 1.0]
dt = -0.060
rate = 20.0
sigma = [0.002, 0.002, 0.002, 1e-4, 1e-4, 1e-4]
[sensors.cam0]
pose = [0.3, 0.1, 1.6, -90.0, 0.0, -90.0]
dt = 0.025
has_scale = false
sigma = [0.005, 0.005, 0.005, 2e-4, 2e-4, 2e-4]
"""
SIGMA_KEYS = ["x", "y", "z", "rx", "ry", "rz", "dt"]
CALIBRATION_KEYS = {"base", "sensors", "covariance", "undetermined"}
SENSOR_KEYS = {"T_base_sensor", "dt_base_sensor", "clock_skew", "t_ref", "sigma", "has_scale"}


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    folder = tmp_path_factory.mktemp("drive")
    (folder / "simulated.toml").write_text(DRIVE)
    return folder


@pytest.fixture(scope="module")
def run(drive, tmp_path_factory):
    """The command; returns exit status, what was printed, and the file as text."""

    def run(*arguments, drive=drive, jobs=1):
        out = tmp_path_factory.mktemp("out")
        command = ["run", drive, "-o", out, "--jobs", jobs, *arguments]
        done = CliRunner().invoke(cli.main, [str(a) for a in command])
        file = out / "calibration.json"
        return done.exit_code, done.output, file.read_text() if file.exists() else ""

    return run


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


def as_array(rows):
    return np.array(rows, dtype=float)


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


# ---- what a plane does not tell


@pytest.fixture(scope="module")
def planar(run, tmp_path_factory):
    """A drive on a plane: (what was printed, the file's content as text)."""
    folder = tmp_path_factory.mktemp("planar")
    (folder / "simulated.toml").write_text(DRIVE.replace('"rough"', '"planar"'))
    status, printed, text = run(drive=folder)
    assert status == 3, printed
    return printed, text


def test_what_was_not_determined_is_null_with_a_direction_and_a_sentence(planar):
    printed, found = planar[0], json.loads(planar[1])
    assert found["undetermined"]
    order = found["covariance"]["order"]
    matrix = as_array(found["covariance"]["matrix"])
    for u in found["undetermined"]:
        assert set(u) == {"direction", "sentence"}
        assert set(u["direction"]) <= set(order)
        assert np.linalg.norm(list(u["direction"].values())) == pytest.approx(1)
        assert f"not determined: {u['sentence']}" in printed
    for name in ("ins", "cam0"):
        sensor = found["sensors"][name]
        assert sensor["sigma"]["z"] is None
        assert sensor["T_base_sensor"][2][3] is None
        assert np.isnan(matrix[order.index(f"{name}.z")]).all()
        assert sensor["sigma"]["dt"] > 0
    assert np.isfinite(matrix[order.index("ins.dt"), order.index("ins.dt")])


def test_only_the_height_of_a_planar_drive_is_open(planar):
    """A camera, which knows no distances, hardly tells how far to the side it sits either; that is said apart."""
    undetermined = [u for u in json.loads(planar[1])["undetermined"] if "found only to" not in u["sentence"]]
    assert [u["direction"] for u in undetermined] == [{"ins.z": 1.0}, {"cam0.z": 1.0}]
    assert all("or give a measured value with --prior" in u["sentence"] for u in undetermined)


def test_a_measured_height_fills_the_null(run, tmp_path):
    (tmp_path / "simulated.toml").write_text(DRIVE.replace('"rough"', '"planar"'))
    (tmp_path / "tape.toml").write_text("base = 'velo'\n[ins]\nz = [-0.80, 0.02]\n")
    status, printed, text = run("--prior", tmp_path / "tape.toml", "--sensors", "velo,ins", drive=tmp_path)
    assert status == 0, printed
    found = json.loads(text)
    assert found["sensors"]["ins"]["T_base_sensor"][2][3] == pytest.approx(-0.8, abs=1e-3)
    assert found["sensors"]["ins"]["sigma"]["z"] == pytest.approx(0.02, rel=0.02)
    assert found["statistics"]["prior"] == ["ins.z"]
    assert "note: held by measured values: ins.z" in printed


def test_a_null_stays_a_null_when_read_back(planar, tmp_path):
    (tmp_path / "calibration.json").write_text(planar[1])
    c = read_calibration(tmp_path / "calibration.json")
    assert not c.determined[c.index("ins"), 2]
    assert np.isnan(c.sigma[c.index("ins"), 2])
    assert not c.between("velo", "ins").has_scale
    assert [u.sentence for u in c.undetermined]


# ---- what the table says beside the numbers


def said(**statistics):
    """The notes below the table of a rig of two, as lines."""
    rig = Calibration(
        "velo", ("velo", "cam0"), np.tile(np.eye(4), (2, 1, 1)), np.zeros(2), np.eye(14), np.ones(2, bool),
        np.ones((2, 7), bool),
    )  # fmt: skip
    console = Console(file=StringIO(), width=100, highlight=False)
    show_result(Result(rig, {}, statistics=statistics), console)
    return [line.removeprefix("note: ") for line in console.file.getvalue().splitlines() if line.startswith("note")]


def scale(turns=1.0, shifts=1.0, kind="own", kind_of_shifts="own"):
    return {"turns": turns, "kind": kind, "shifts": shifts, "kind_of_shifts": kind_of_shifts}


def test_nothing_is_noted_where_all_is_well():
    assert said() == []
    assert said(
        noise_scale={"velo": scale(3.9, 0.26), "cam0": {"turns": 1.0, "kind": "own"}},
        rejected={"velo": 0.05, "cam0": 0.0},
        bias_deg={"velo": 0.0, "cam0": 0.2},
        driving={"cam0": {"x": 599.0, "rz": 600.0, "dt": 1e6}},
        seconds=600.0,
        prior=[],
    ) == []  # fmt: skip
    assert said(bias_deg=None) == []


def test_a_stated_noise_that_is_off_is_noted_with_what_it_was_told_for():
    assert said(noise_scale={"velo": scale(32.5, 0.04), "cam0": scale(9.0, 1.0)}) == [
        "turns are noisier than stated: velo 5.7 times, cam0 3.0 times (told for each alone)",
        "shifts are less noisy than stated: velo 5.0 times (told for each alone)",
    ]
    assert said(noise_scale={n: scale(1.0, 6.25, kind_of_shifts="pair") for n in ("velo", "cam0")}) == [
        "shifts are noisier than stated: velo 2.5 times, cam0 2.5 times (told for the pair, not for each)"
    ]


def test_rejected_readings_and_turned_travel_are_noted():
    assert said(rejected={"velo": 0.04, "cam0": 0.213}) == ["readings rejected because they do not fit: 21% of cam0"]
    (note,) = said(bias_deg={"velo": 0.0, "cam0": 0.51})
    assert note.startswith("travel is turned against turns: cam0 by 0.5 deg; a fault of that sensor's own motion")
    assert "velo's if all have it" in note
    assert said(prior=["cam0.z", "cam0.dt"]) == ["held by measured values: cam0.z, cam0.dt"]


@pytest.mark.parametrize(
    ("needs", "words"),
    [
        ({"x": 10, "z": 700, "rx": 5}, "12 min to know every position above to 2 cm (cam0 z needs most)"),
        ({"z": 5, "ry": 90000}, "25 h to know every angle above to 0.06 deg (cam0 about y needs most)"),
        (
            {"y": 90, "rz": 300},
            "90 s to know every position above to 2 cm (cam0 y needs most), and "
            "5 min to know every angle above to 0.06 deg (cam0 about z needs most)",
        ),
    ],
)
def test_how_long_to_drive_is_noted_where_it_is_longer_than_was_driven(needs, words):
    assert said(driving={"cam0": needs}, seconds=60.0) == [f"drive like this, in all, {words}"]
    assert said(driving={"cam0": needs}, seconds=60.0, pairs=[{"metric": "im"}]) == []
