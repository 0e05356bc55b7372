"""What ``run`` says of pictures: that there are some, and none where those in the folder are of an earlier run."""

import pytest
from click.testing import CliRunner

from calib_toolkit import cli

DRIVE = """
seconds = 40
seed = 1
drive = "street"
[sensors.velo]
pose = [0.0, 0.0, 1.7, 0.0, 0.0, 0.0]
[sensors.ins]
pose = [-0.8, 0.3, 0.9, 0.8, -0.1, 1.0]
"""
METRIC = """
from dataclasses import dataclass
from calib_toolkit import PairEstimate, hookimpl


@dataclass(frozen=True)
class Nothing:
    pass


class Draws:
    id = "draws"
    options = Nothing

    def accepts(self, kind_a, kind_b):
        return True

    def overlap(self, pair):
        return True

    def estimate(self, pair, options):
        return PairEstimate("draws", pair.prior, converged=False, note="nothing to say")

    def draw(self, pair, poses, folder):
        (folder / f"{pair.a.name}-{pair.b.name}.txt").write_text(", ".join(poses))


@hookimpl
def calib_register_metrics():
    return [Draws()]
"""


@pytest.fixture
def run(tmp_path):
    (tmp_path / "simulated.toml").write_text(DRIVE)
    (tmp_path / "draws.py").write_text(METRIC)

    def run(appearance):
        words = ["run", tmp_path, "-o", tmp_path / "out", "--plugin", tmp_path / "draws.py", "--jobs", 1]
        done = CliRunner().invoke(cli.main, [str(w) for w in (*words, "--appearance", appearance)])
        assert done.exit_code == 0, done.output
        return done.stdout

    return run


def test_pictures_are_named_where_this_run_drew_them(run, tmp_path):
    overlay = tmp_path / "out" / "overlay"
    assert f"written: {overlay}, pictures" in run("draws")
    assert (overlay / "velo-ins.txt").read_text() == "motion alone, refined"
    assert f"written: {overlay}" not in run("none")
