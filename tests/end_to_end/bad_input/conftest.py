"""Recordings that are whole until a test spoils them, and the command that must refuse them."""

import json

import numpy as np
import pytest
from click.testing import CliRunner
from scipy.spatial.transform import Rotation
from small_runs import EPOCH, HEAD, INS, VELO, recorded

from calib_toolkit import cli
from calib_toolkit_datasets import simulated

RIG = '[sensors.a]\nkind = "odometry"\nposes = "a.txt"\nformat = "tum"\n' + (
    '[sensors.b]\nkind = "odometry"\nposes = "b.txt"\nformat = "tum"\n'
)


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
        return recorded(tmp_path / "drive", head + body)

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
