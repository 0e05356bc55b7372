"""The command as a user meets it: instant help, one sentence for every error, honest exit statuses."""

import subprocess
import sys
from types import ModuleType

import click
import pytest
from click.testing import CliRunner

from calib_toolkit import cli
from calib_toolkit.errors import DataError

READER = '''
"""A reader of .toy files: the first line names the sensors, the second the seconds they recorded."""
import numpy as np
from calib_toolkit import Dataset, Log, Stream, hookimpl

def open_toy(path, context):
    names, seconds = path.read_text().split("\\n")[:2]
    stamps = np.arange(0, float(seconds), 0.1)
    return Log(path, {n: Stream(n, "odometry", stamps, range(len(stamps))) for n in names.split()}, epoch_ns=10**18)

@hookimpl
def calib_register_datasets():
    return [Dataset("toy", "a file that ends in .toy", lambda path: path.suffix == ".toy", open_toy)]
'''


@pytest.fixture
def run():
    def run(*arguments):
        return CliRunner().invoke(cli.main, [str(a) for a in arguments])

    return run


@pytest.fixture
def command(monkeypatch):
    """Adds a command ``boom`` that does what it is told."""

    def add(action):
        module = ModuleType("calib_toolkit.cli.boom")
        module.boom = click.command("boom")(action)
        monkeypatch.setitem(sys.modules, module.__name__, module)
        monkeypatch.setitem(cli.COMMANDS, "boom", "Fail.")

    return add


def failing(error):
    def action():
        raise error

    return action


@pytest.fixture
def toy(tmp_path):
    """A drive of two sensors and the plugin that reads it, as arguments."""

    def make(seconds=60, names="velo ins"):
        (tmp_path / "drive.toy").write_text(f"{names}\n{seconds}\n")
        (tmp_path / "reader.py").write_text(READER)
        return tmp_path / "drive.toy", "--plugin", tmp_path / "reader.py"

    return make


def test_help_lists_every_command_without_importing_it():
    code = (
        "import sys; from calib_toolkit.cli import main; main(['--help'], standalone_mode=False); "
        "print(*(m for m in sys.modules if m.split('.')[0] in {'numpy', 'scipy', 'rich', 'pluggy'} "
        "or m.startswith('calib_toolkit.cli.')), file=sys.stderr)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stderr.strip() == ""
    for name, what in cli.COMMANDS.items():
        assert f"{name} " in done.stdout
        assert what in done.stdout


@pytest.mark.parametrize("name", cli.COMMANDS)
def test_every_command_has_help(run, name):
    result = run(name, "--help")
    assert result.exit_code == 0, result.output
    assert f"calib-toolkit {name}" in result.output.replace("main", "calib-toolkit")


def test_version(run):
    assert run("--version").output.split()[-1].count(".") == 2


@pytest.mark.parametrize("arguments", [["fly"], ["inspect"], ["inspect", "x", "--colour"], ["--loud"]])
def test_wrong_usage_exits_with_2(run, arguments):
    result = run(*arguments)
    assert result.exit_code == 2
    assert "Traceback" not in result.stderr
    assert "Usage:" in result.stderr


def test_a_refusal_is_its_sentence_on_stderr_and_status_1(run, command):
    command(failing(DataError("velo: scan 7 is empty; leave it out")))
    result = run("boom")
    assert (result.exit_code, result.stdout) == (1, "")
    assert result.stderr == "calib-toolkit: velo: scan 7 is empty; leave it out\n"


def test_the_unexpected_is_one_line_that_names_its_kind(run, command):
    command(failing(ZeroDivisionError("division\nby zero")))
    result = run("boom")
    assert result.exit_code == 1
    assert result.stderr == (
        "calib-toolkit: unexpected ZeroDivisionError: division by zero (calib-toolkit --debug boom ... shows where)\n"
    )


@pytest.mark.parametrize("error", [ZeroDivisionError(), DataError("no")])
def test_debug_lets_the_traceback_through(run, command, error):
    command(failing(error))
    assert run("--debug", "boom").exception is error


def test_an_interrupt_is_one_line_and_status_130(run, command):
    command(failing(KeyboardInterrupt()))
    result = run("boom")
    assert result.exit_code == 130
    assert result.stderr.startswith("calib-toolkit: interrupted")
    assert result.stderr.count("\n") == 1


def test_a_command_chooses_its_own_status(run, command):
    command(lambda: click.get_current_context().exit(3))
    assert run("boom").exit_code == 3


def test_inspect_a_clean_drive(run, toy):
    result = run("inspect", *toy())
    assert result.exit_code == 0, result.output
    assert "drive.toy: 59.9 s, from 2001-09-09 01:46:40 UTC" in result.output
    assert "nothing wrong was found" in result.output
    row = next(line for line in result.output.splitlines() if " ins " in line)
    assert row.split() == ["ins", "odometry", "600", "10.000", "0.000", "59.900", "0", "0.1000"]


def test_stamps_that_count_from_a_start_of_their_own_have_no_date(run, toy, tmp_path):
    arguments = toy()
    (tmp_path / "reader.py").write_text(READER.replace("10**18", "313_800_000_000"))
    assert "drive.toy: 59.9 s\n" in run("inspect", *arguments).output


def test_inspect_exits_with_3_when_something_is_wrong(run, toy):
    result = run("inspect", *toy(seconds=5))
    assert result.exit_code == 3
    assert "- the drive lasts only 4.9 s" in result.output


def test_inspect_shows_names_as_they_are(run, toy):
    assert "[red]" in run("inspect", *toy(names="velo [red]")).output


def test_inspect_with_a_reader_by_name(run, toy):
    drive, *plugin = toy()
    assert run("inspect", drive, "--format", "toy", *plugin).exit_code == 0
    result = run("inspect", drive, "--format", "tyo", *plugin)
    assert result.exit_code == 1
    assert "no reader is called 'tyo'; there are: " in result.stderr


def test_inspect_what_no_reader_knows_says_what_each_looks_for(run, toy, tmp_path):
    (tmp_path / "notes.txt").write_text("milk")
    _, *plugin = toy()
    result = run("inspect", tmp_path / "notes.txt", *plugin)
    assert result.exit_code == 1
    assert "toy looks for a file that ends in .toy" in result.stderr
    assert result.stderr.count("\n") == 1


def test_inspect_what_does_not_exist(run, tmp_path):
    result = run("inspect", tmp_path / "nowhere")
    assert result.exit_code == 1
    assert "nowhere does not exist" in result.stderr


def test_plugins_lists_built_ins_and_files_alike(run, toy):
    _, *plugin = toy()
    result = run("plugins", *plugin)
    assert result.exit_code == 0, result.output
    rows = [line.split() for line in result.output.splitlines()]
    assert ["toy", "dataset", "(file)", "-"] in [row[:4] for row in rows]
    assert ["velodyne", "sensor", "calib-toolkit"] in [row[:3] for row in rows]


def test_plugins_refuses_what_is_broken(run, tmp_path):
    (tmp_path / "broken.py").write_text("def calib_register_radars(): return []")
    result = run("plugins", "--plugin", tmp_path / "broken.py")
    assert result.exit_code == 1
    assert "a hook that does not exist, calib_register_radars" in result.stderr


@pytest.fixture
def added(monkeypatch):
    """Adds a plugin's command ``extra``, or one that can not be loaded."""

    def add(load):
        class Point:
            name, value = "extra", "their.module:extra"

            def load(self):
                return load()

        class Points(list):
            names = frozenset({"extra"})

        monkeypatch.setattr(cli, "entry_points", lambda group, name=None: Points([Point()]))

    return add


def test_a_plugin_adds_a_command(run, added):
    added(lambda: click.Command("extra", callback=lambda: click.echo("done"), help="Do more."))
    assert "extra" in run("--help").output
    assert "Do more." in run("--help").output
    assert run("extra").output == "done\n"


def test_a_plugins_command_that_can_not_be_loaded_is_refused_and_harms_no_other(run, added):
    def fail():
        raise ImportError("no module called 'their'")

    added(fail)
    assert run("--help").exit_code == 0
    result = run("extra")
    assert result.exit_code == 1
    assert "'extra' (their.module:extra) could not be loaded (ImportError: no module called 'their')" in result.output
