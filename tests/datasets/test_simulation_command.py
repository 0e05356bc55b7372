"""The command ``simulate``: what may be asked for, what it says, what it refuses."""

from dataclasses import replace

import pytest
from click.testing import CliRunner
from simulated_files import wish

from calib_toolkit import DataError
from calib_toolkit.cli import main
from calib_toolkit_datasets.simulation import command, rigs, scene, vehicle, writing


@pytest.mark.parametrize(
    ("other", "sentence"),
    [
        ({"rig": "truck"}, "there is no rig called 'truck'"),
        ({"drive": "moon"}, "there is no drive called 'moon'"),
        ({"scene": "moon"}, "there is no scene called 'moon'"),
        ({"layout": "folders"}, "there is no layout of a kitti called 'folders'"),
        ({"seconds": 0.1}, "from 1 to 1800 seconds"),
        ({"seconds": float("nan")}, "from 1 to 1800 seconds"),
        ({"seed": -1}, "a seed is 0 or more"),
    ],
)
def test_a_wish_that_can_not_be_met_is_refused(other, sentence):
    with pytest.raises(DataError, match=sentence):
        replace(wish(), **other)


def test_the_command_knows_what_there_is():
    assert set(command.RIGS) == set(rigs.RIGS)
    assert set(command.SCENES) == set(scene.LAYOUTS)
    assert set(command.DRIVES) == set(vehicle.DRIVES)
    assert set(command.LAYOUTS) == set(writing.LAYOUTS)


def test_the_command_says_what_it_wrote_and_what_comes_next(quick, tmp_path):
    options = [
        "--rig",
        "shrimp",
        "--seconds",
        "1",
        "--seed",
        "3",
        "--drive",
        "street",
        "--scene",
        "open",
        "--jobs",
        "1",
    ]
    done = CliRunner().invoke(command.simulate, [str(tmp_path / "dst"), *options])
    assert done.exit_code == 0, done.output
    assert "1 s of street with the shrimp rig, scene open, seed 3" in done.output
    assert "ladybug5" in done.output
    assert f"calib-toolkit run {tmp_path / 'dst'}" in done.output
    again = CliRunner().invoke(command.simulate, [str(tmp_path / "dst"), *options])
    assert "all there already" in again.output


def test_the_command_refuses_in_one_sentence(tmp_path):
    done = CliRunner().invoke(main, ["simulate", str(tmp_path), "--rig", "shrimp", "--layout", "sync"])
    assert done.exit_code == 1
    assert done.output.count("\n") == 1
    assert "layout of a shrimp" in done.output
