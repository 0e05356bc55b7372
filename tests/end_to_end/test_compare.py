"""``compare`` as a user meets it: a table, a verdict in words, an exit status; and ``run --prior``."""

from dataclasses import replace

import numpy as np
import pytest
from click.testing import CliRunner
from small_runs import STREET, recorded

from calib_toolkit import cli, se3
from calib_toolkit.result_file import write_calibration
from calib_toolkit.types import Calibration, Result

NAMES = ("velo", "ins", "cam0")
TRUE = se3.matrix([[0.0] * 6, [-0.8, 0.3, -0.8, 0.01, 0.02, 0.1], [0.3, 0.1, -0.1, -1.2, 1.2, -1.2]])
SIGMA = np.array([0.02, 0.02, 0.03, 1e-3, 1e-3, 1e-3, 5e-4])


def rig(moved=None, sigma=SIGMA, **changed):
    """A rig; moved: by sensor name, seven numbers that its pose and offset are off by."""
    poses, dt = TRUE.copy(), np.array([0.0, -0.06, 0.03])
    for name, off in (moved or {}).items():
        i, off = NAMES.index(name), np.asarray(off, dtype=float)
        poses[i] = se3.rigid(se3.exp_so3(off[3:6]) @ poses[i, :3, :3], poses[i, :3, 3] + off[:3])
        dt[i] += off[6]
    cov = np.diag(np.concatenate([np.zeros(7), sigma**2, sigma**2]))
    c = Calibration("velo", NAMES, poses, dt, cov, np.ones(3, dtype=bool), np.ones((3, 7), dtype=bool))
    return replace(c, **changed)


@pytest.fixture
def compare(tmp_path, monkeypatch):
    """Writes two calibrations and runs the command in a terminal of 100 columns."""
    monkeypatch.setenv("COLUMNS", "100")

    def compare(a, b):
        write_calibration(a, tmp_path / "may.json")
        write_calibration(b, tmp_path / "june.json")
        return CliRunner().invoke(cli.main, ["compare", str(tmp_path / "may.json"), str(tmp_path / "june.json")])

    return compare


def rows(printed, sensor):
    """The cells of a sensor's three lines."""
    lines = printed.splitlines()
    first = next(i for i, line in enumerate(lines) if line.split()[:2] == [sensor, "difference"])
    difference, sigma, times = (lines[first + k].split() for k in range(3))
    return difference[2:9], sigma[1:8], times[2:9]


def test_two_that_agree(compare):
    done = compare(rig(), rig({"cam0": [0.01, -0.01, 0.02, 0, 0, 0.0005, 0.0004]}))
    assert done.exit_code == 0, done.output
    assert "june.json minus" in done.output
    assert "each sensor in velo:" in done.output
    assert "the calibrations agree: chi-square 0.9 of 14, p = 1.00" in done.output
    assert "moved" not in done.output
    difference, sigma, times = rows(done.output, "cam0")
    assert [difference[k] for k in (0, 1, 2, 6)] == ["0.0100", "-0.0100", "0.0200", "0.400"]
    assert [sigma[k] for k in (0, 2, 6)] == ["0.0283", "0.0424", "0.707"]
    assert [times[k] for k in (0, 1, 2, 6)] == ["0.4", "-0.4", "0.5", "0.6"]
    assert max(map(len, done.output.splitlines()[2:])) <= 100


def test_one_that_moved_is_named_with_its_worst_number(compare):
    yaw = np.radians(0.5)
    done = compare(rig(), rig({"ins": [0, 0, 0, 0, 0, yaw, 0]}))
    assert done.exit_code == 3, done.output
    assert "\nins moved: yaw by 0.500 deg, 6.2 sigma\n" in done.output
    assert "cam0 moved" not in done.output
    assert "the calibrations differ: chi-square 38.1 of 14, p < 0.001" in done.output
    assert rows(done.output, "ins")[0][5] == "0.500"
    back = compare(rig({"ins": [0, 0, 0, 0, 0, yaw, 0]}), rig())
    assert "\nins moved: yaw by -0.500 deg, 6.2 sigma\n" in back.output


def test_a_sensor_of_which_no_number_stands_out_says_so(compare):
    done = compare(rig(), rig({"ins": 2.4 * np.sqrt(2) * SIGMA}))
    assert done.exit_code == 3, done.output
    assert "ins moved: all numbers together (p < 0.001), most of all " in done.output


def test_where_all_sensors_moved_alike_it_was_the_base(compare):
    base = se3.matrix(np.array([0.0, 0.0, 0.0, 0.0, 0.02, 0.0]))
    turned = rig(T_base_sensor=np.concatenate([TRUE[:1], se3.invert(base) @ TRUE[1:]]))
    done = compare(rig(), turned)
    assert done.exit_code == 3
    assert "it is velo itself that moved: ins, cam0 all differ from it, but not from each other" in done.output
    both = compare(rig(), rig({n: [0.3, 0, 0, 0, 0, k, 0] for n, k in (("ins", 0.1), ("cam0", -0.1))}))
    assert "itself" not in both.output


def test_sensors_that_differ_only_from_each_other_are_named(compare):
    """Both lean the same way on a base that each is known to only vaguely."""
    cov = np.diag(np.concatenate([np.zeros(7), SIGMA**2, SIGMA**2]))
    cov[9, 16] = cov[16, 9] = 0.99 * SIGMA[2] ** 2
    off = np.array([0, 0, 0.03, 0, 0, 0, 0])
    done = compare(rig(covariance=cov), rig({"ins": off, "cam0": -off}, covariance=cov))
    assert done.exit_code == 3, done.output
    assert "no sensor alone differs from velo, but all together do; " in done.output
    assert "most of all cam0 from ins: " in done.output


def test_one_sensor_alone_among_many_is_put_into_proportion(compare):
    done = compare(rig(), rig({"ins": [0, 0, 4.4 * np.sqrt(2) * 0.03, 0, 0, 0, 0]}))
    assert done.exit_code == 0, done.output
    assert "ins moved: z by 0.1867 m, 4.4 sigma" in done.output
    assert "all sensors together show no more than chance, by which one in 100 stands out alone" in done.output


def test_what_one_does_not_determine_is_a_dash(compare):
    known = np.ones((3, 7), dtype=bool)
    known[2, 2] = known[1, 6] = False
    done = compare(rig(determined=known), rig())
    assert done.exit_code == 0, done.output
    assert rows(done.output, "cam0")[0][2] == "-"
    assert rows(done.output, "ins")[2][6] == "-"
    assert "of 12," in done.output


@pytest.mark.parametrize(("shift", "status"), [(0.0, 0), (0.01, 3)])
def test_two_exact_ones(compare, shift, status):
    done = compare(rig(sigma=0 * SIGMA), rig({"cam0": [shift, 0, 0, 0, 0, 0, 0]}, sigma=0 * SIGMA))
    assert done.exit_code == status, done.output
    assert ("cam0 moved: x by 0.0100 m, where both are exact" in done.output) == bool(status)


def test_another_base_is_brought_to_the_first(compare):
    other = Calibration(
        "ins",
        NAMES,
        se3.invert(TRUE[1]) @ TRUE,
        np.array([0.06, 0.0, 0.09]),
        np.diag(np.concatenate([SIGMA**2, np.zeros(7), SIGMA**2])),
        np.ones(3, dtype=bool),
        np.ones((3, 7), dtype=bool),
    )
    done = compare(rig(), other)
    assert done.exit_code == 0, done.output
    assert "each sensor in velo:" in done.output
    assert "chi-square 0.0 of 14" in done.output


def test_names_are_shown_as_they_are(compare):
    named = ("velo", "[red]", "cam0")
    assert "[red]" in compare(rig(names=named), rig(names=named)).output


def test_nothing_in_common_is_refused_with_both_files(compare):
    done = compare(rig(), rig(names=("a", "b", "c"), base="a"))
    assert done.exit_code == 1
    assert "may.json and" in done.stderr
    assert "june.json can not be compared: they share no sensor" in done.stderr
    assert done.stderr.count("\n") == 1


def test_a_file_that_is_no_calibration_is_refused(tmp_path):
    (tmp_path / "a.json").write_text("{}")
    for second in ("a.json", "none.json"):
        done = CliRunner().invoke(cli.main, ["compare", str(tmp_path / "a.json"), str(tmp_path / second)])
        assert done.exit_code == 1
        assert "a.json is not a calibration" in done.stderr
        assert done.stderr.count("\n") == 1


def test_the_help_says_what_it_is_for():
    printed = CliRunner().invoke(cli.main, ["compare", "--help"]).output
    assert "drift" in printed
    assert "repeatability" in printed


# --- run --prior


@pytest.fixture
def run(tmp_path, monkeypatch):
    """The command with its estimator replaced; returns exit status, stderr and the configuration it was given."""
    recorded(tmp_path, STREET)
    given = []
    monkeypatch.setattr(
        "calib_toolkit.pipeline.calibrate",
        lambda log, config, *more, **others: given.append(config) or Result(rig(), {}),
    )

    def run(prior, *arguments):
        (tmp_path / "measured.toml").write_text(prior)
        command = ["run", str(tmp_path), "--prior", str(tmp_path / "measured.toml"), *arguments]
        done = CliRunner().invoke(cli.main, command)
        return done.exit_code, done.stderr, given

    return run


@pytest.mark.parametrize(
    ("said", "chosen", "base"),
    [("", (), None), ('base = "velo"\n', (), "velo"), ("", ("--base", "ins"), "ins")],
)
def test_a_prior_reaches_the_estimator_with_its_base(run, said, chosen, base):
    status, printed, given = run(said + "[cam0]\nz = [1.2, 0.02]\n", *chosen)
    assert status == 0, printed
    (config,) = given
    assert config.base == base
    assert [(m.sensor, m.parameter, m.value, m.sigma) for m in config.prior] == [("cam0", "z", 1.2, 0.02)]


def test_a_prior_in_another_base_is_refused(run):
    status, printed, given = run('base = "velo"\n[cam0]\nz = [1.2, 0.02]\n', "--base", "ins")
    assert (status, given) == (1, [])
    assert "measured.toml are given in velo, and the base of this run is ins" in printed
    assert printed.count("\n") == 1


def test_a_bad_prior_is_refused_before_the_drive_is_read(run):
    status, printed, given = run("[cam0]\nz = 1.2\n")
    assert (status, given) == (1, [])
    assert "z of cam0 is 1.2" in printed
