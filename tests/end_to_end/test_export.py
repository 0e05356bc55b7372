"""``export`` and ``import`` as a user meets them: files that say what they mean, and the way back."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from small_runs import STREET, recorded

from calib_toolkit import cli, se3
from calib_toolkit.result_file import read_calibration, write_calibration
from calib_toolkit.types import Calibration, Result

NAMES = ("velo", "ins", "cam0")
TRUE = se3.matrix([[0.0] * 6, [-0.8, 0.3, -0.8, 0.01, 0.02, 0.1], [0.3, 0.1, -0.1, -1.2, 1.2, -1.2]])
SIGMA = np.array([0.02, 0.02, 0.03, 1e-3, 1e-3, 1e-3, 5e-4])
FORMATS = ("autoware", "csv", "kitti", "nuscenes", "ros2", "urdf", "yaml")


def rig(**changed):
    cov = np.diag(np.concatenate([np.zeros(7), SIGMA**2, SIGMA**2]))
    scaled, known = np.array([True, True, False]), np.ones((3, 7), dtype=bool)
    return replace(Calibration("velo", NAMES, TRUE, np.array([0.0, -0.06, 0.03]), cov, scaled, known), **changed)


@pytest.fixture
def do(tmp_path, monkeypatch):
    """Runs a command in a folder where calibration.json lies."""
    monkeypatch.chdir(tmp_path)
    write_calibration(rig(), Path("calibration.json"))
    return lambda *words: CliRunner().invoke(cli.main, [str(w) for w in words])


@pytest.mark.parametrize("format_id", FORMATS)
def test_out_and_back_in_the_calibrations_agree(do, format_id):
    done = do("export", "calibration.json", "--to", format_id, "-o", "out/rig")
    assert done.exit_code == 1
    assert "can not be written" in done.stderr
    done = do("export", "calibration.json", "--to", format_id, "-o", "rig")
    assert done.exit_code == 0, done.output
    assert "written: " in done.output
    assert f"not kept by {format_id}: " in done.output
    done = do("import", "rig", "-o", "back.json")
    assert done.exit_code == 0, done.output
    assert f"read as {format_id}: " in done.output
    done = do("compare", "calibration.json", "back.json")
    assert done.exit_code == 0, done.output
    assert "the calibrations agree: chi-square 0.0 of 14, p = 1.00" in done.output
    assert ("back.json: no sigma is stated" in done.output) == (format_id not in ("csv", "yaml"))


def test_a_sensor_that_moved_is_found_against_an_imported_file(do):
    moved = TRUE.copy()
    moved[2, 0, 3] += 0.5
    write_calibration(rig(T_base_sensor=moved), Path("moved.json"))
    assert do("export", "moved.json", "--to", "urdf", "-o", "rig.urdf").exit_code == 0
    assert do("import", "rig.urdf", "-o", "back.json").exit_code == 0
    done = do("compare", "calibration.json", "back.json")
    assert done.exit_code == 3
    assert "cam0 moved: x by 0.5000 m" in done.output


def test_an_import_states_no_sigma_unless_it_is_told(do):
    do("export", "calibration.json", "--to", "urdf", "-o", "rig.urdf")
    do("import", "rig.urdf", "-o", "back.json")
    content = json.loads(Path("back.json").read_text())
    assert "covariance" not in content
    assert not any("sigma" in s for s in content["sensors"].values())
    do("import", "rig.urdf", "-o", "back.json", "--sigma", "0.05,1,10")
    sure = read_calibration(Path("back.json")).sigma
    assert np.allclose(sure[1], [0.05] * 3 + [np.radians(1)] * 3 + [0.01])
    assert not sure[0].any()
    for wrong in ("0.05", "0.05,1,0", "a,b,c", "nan,1,1"):
        assert do("import", "rig.urdf", "-o", "back.json", "--sigma", wrong).exit_code == 2


def test_a_prior_may_be_an_import_that_says_how_sure_it_is(do, tmp_path, monkeypatch):
    recorded(tmp_path, STREET)
    given = []
    monkeypatch.setattr(
        "calib_toolkit.pipeline.calibrate", lambda log, config, *more, **o: given.append(config) or Result(rig(), {})
    )
    do("export", "calibration.json", "--to", "urdf", "-o", "rig.urdf", "--sensors", "velo,ins")
    do("import", "rig.urdf", "-o", "back.json")
    done = do("run", tmp_path, "--prior", "back.json")
    assert (done.exit_code, given) == (1, [])
    assert "does not say how sure its numbers are" in done.stderr
    do("import", "rig.urdf", "-o", "back.json", "--sigma", "0.05,1,10")
    done = do("run", tmp_path, "--prior", "back.json")
    assert done.exit_code == 0, done.output
    (config,) = given
    assert config.base == "velo"
    told = {m.parameter: (m.value, m.sigma) for m in config.prior if m.sensor == "ins"}
    assert list(told) == ["x", "y", "z", "roll", "pitch", "yaw", "dt"]
    assert np.allclose([told[k][0] for k in "xyz"], TRUE[1, :3, 3])
    assert np.allclose(told["x"][1], 0.05)
    assert np.allclose(told["dt"], (-0.06, 0.01))
    assert np.allclose(told["yaw"], (np.arctan2(TRUE[1, 1, 0], TRUE[1, 0, 0]), np.radians(1)), rtol=1e-3)


def test_some_sensors_in_the_frame_and_clock_of_the_first(do):
    done = do("export", "calibration.json", "--to", "kalibr", "-o", "chain.yaml", "--sensors", "cam0,ins")
    assert done.exit_code == 0, done.output
    assert do("import", "chain.yaml", "-o", "back.json").exit_code == 0
    back = read_calibration(Path("back.json"))
    assert back.base == "ins"
    assert np.allclose(back.between("ins", "cam0").T_a_b, rig().between("ins", "cam0").T_a_b, atol=1e-9)
    assert abs(back.dt_between("ins", "cam0")[0] - 0.09) < 1e-12


def test_nothing_is_replaced_unasked(do):
    Path("rig.urdf").write_text("mine")
    done = do("export", "calibration.json", "--to", "urdf", "-o", "rig.urdf")
    assert done.exit_code == 1
    assert "rig.urdf is there already" in done.stderr
    assert Path("rig.urdf").read_text() == "mine"
    assert sorted(f.name for f in Path().iterdir()) == ["calibration.json", "rig.urdf"]
    assert do("export", "calibration.json", "--to", "urdf", "-o", "rig.urdf", "--overwrite").exit_code == 0
    assert "<robot" in Path("rig.urdf").read_text()


def test_what_the_drive_left_open_is_refused_or_null(do):
    known = np.ones((3, 7), dtype=bool)
    known[2, 2] = False
    write_calibration(rig(determined=known), Path("open.json"))
    done = do("export", "open.json", "--to", "ros2", "-o", "rig.yaml")
    assert done.exit_code == 1
    assert "did not determine z of cam0, which ros2 can not say" in done.stderr
    assert "--sensors velo,ins" in done.stderr
    assert done.stderr.count("\n") == 1
    assert do("export", "open.json", "--to", "ros2", "-o", "rig.yaml", "--sensors", "velo,ins").exit_code == 0
    assert do("export", "open.json", "--to", "yaml", "-o", "plain.yaml").exit_code == 0
    assert do("import", "plain.yaml", "-o", "back.json").exit_code == 0
    assert np.array_equal(read_calibration(Path("back.json")).determined, known)


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (
            ["export", "calibration.json", "--to", "vhs", "-o", "x"],
            "no exporter is called 'vhs'; there are: ",
        ),
        (["export", "none.json", "--to", "urdf", "-o", "x"], "none.json is not a calibration"),
        (["export", "calibration.json", "--to", "urdf", "-o", "x", "--sensors", "a"], "there is no sensor 'a'"),
        (["export", "calibration.json", "--to", "urdf", "-o", "x", "--sensors", "ins"], "ins alone has no pose"),
        (["export", "calibration.json", "--to", "urdf", "-o", "x", "--intrinsics", "none"], "none does not exist"),
        (["import", "none.urdf", "-o", "x"], "none.urdf does not exist"),
        (["import", "calibration.json", "-o", "x"], "no exporter knows calibration.json"),
        (["import", "calibration.json", "-o", "x", "--from", "vhs"], "no exporter is called 'vhs'"),
        (["import", "calibration.json", "-o", "x", "--from", "colmap"], "is no list of one rig"),
    ],
)
def test_mistakes_are_one_sentence(do, words, sentence):
    done = do(*words)
    assert done.exit_code == 1
    assert sentence in done.stderr
    assert done.stderr.count("\n") == 1
    assert sorted(f.name for f in Path().iterdir()) == ["calibration.json"]


def test_the_help_says_where_clocks_go():
    runner = CliRunner()
    printed = " ".join(runner.invoke(cli.main, ["export", "--help"]).output.split())
    assert "clocks.yaml" in printed
    assert all(f in printed for f in FORMATS)
    assert "--sigma" in runner.invoke(cli.main, ["import", "--help"]).output
    assert "import " in runner.invoke(cli.main, ["--help"]).output
