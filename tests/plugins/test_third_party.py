"""The third-party plugin of the documentation: installed as a stranger would, listed, and calibrated."""

import json
import os
import subprocess
import sys
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from calib_toolkit import DataError, SensorTable, Stream, se3
from calib_toolkit.testing import SensorCase, parametrize_with_sensor_checks

Array = NDArray[np.float64]

PROJECT = Path(__file__).parents[2] / "docs" / "wheel-odometry-plugin"
MODULE = PROJECT / "wheel_odometry.py"
CALIB_TOOLKIT = Path(sys.executable).with_name("calib-toolkit")

T_LIDAR_WHEELS = se3.matrix([-1.2, 0.1, -1.6, 0.02, 0.06, 0.3])
DT_LIDAR_WHEELS = 0.05

spec = spec_from_file_location("wheel_odometry", MODULE)
assert spec is not None
assert spec.loader is not None
wheel_odometry = sys.modules.setdefault("wheel_odometry", module_from_spec(spec))
spec.loader.exec_module(wheel_odometry)
(WHEELS,) = wheel_odometry.calib_register_sensors()


def rates(T_world_axle: Array, stamps: Array, seed: int) -> Stream:
    """What wheels measure along such poses: their speed ahead and the rate of their yaw."""
    rng = np.random.default_rng(seed)
    vec = se3.vector(se3.relative(T_world_axle[:-1], T_world_axle[1:])) / np.diff(stamps)[:, None]
    middle = (stamps[1:] + stamps[:-1]) / 2
    speed = np.interp(stamps, middle, vec[:, 0]) + 0.05 * rng.standard_normal(len(stamps))
    yaw_rate = np.interp(stamps, middle, vec[:, 5]) + 0.005 * rng.standard_normal(len(stamps))
    return Stream("wheels", "wheel_odometry", stamps, list(zip(speed, yaw_rate, strict=True)))


test_wheels = parametrize_with_sensor_checks([SensorCase(WHEELS, rates)])


@pytest.fixture(scope="session")
def installed(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """The environment of a process in which the plugin is installed."""
    target = tmp_path_factory.mktemp("site")
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--disable-pip-version-check", "--no-cache-dir"]
    options = ["--no-deps", "--no-index", "--no-build-isolation", "--target", str(target)]
    done = subprocess.run([*pip, *options, str(PROJECT)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return os.environ | {"PYTHONPATH": str(target), "COLUMNS": "400"}


def calib_toolkit(environment: dict[str, str], *words: str | Path) -> subprocess.CompletedProcess[str]:
    command = [CALIB_TOOLKIT, *words]
    return subprocess.run(command, env=environment, capture_output=True, text=True, check=False)


def write_rig(folder: Path) -> None:
    """90 s of bends: the wheels' rates, on a clock 50 ms behind, and a lidar's poses as some odometry has them."""
    fine = np.arange(0.0, 90.0, 0.005)
    speed = 8.0 + 2.0 * np.sin(0.4 * fine)
    yaw_rate = 0.3 * np.sin(0.5 * fine) + 0.2 * np.sin(1.3 * fine + 1.0)
    yaw = np.cumsum(yaw_rate) * 0.005
    position = np.cumsum(speed[:, None] * np.stack([np.cos(yaw), np.sin(yaw), 0 * yaw], axis=1), axis=0) * 0.005
    T_world_wheels = se3.rigid(se3.exp_so3(yaw[:, None] * [0.0, 0.0, 1.0]), position)
    T = (T_world_wheels @ se3.invert(T_LIDAR_WHEELS))[::20]
    rng = np.random.default_rng(5)
    steps = se3.vector(se3.relative(T[:-1], T[1:]))
    steps += np.array([0.005, 0.005, 0.005, 3e-4, 3e-4, 3e-4]) * rng.standard_normal(steps.shape)
    poses = [np.eye(4)]
    for step in se3.matrix(steps):
        poses.append(poses[-1] @ step)
    q = Rotation.from_matrix(np.array(poses)[:, :3, :3]).as_quat()
    rows = np.column_stack([fine[::20], np.array(poses)[:, :3, 3], q])
    (folder / "lidar.txt").write_text(
        "".join(f"{1000 + r[0]:.6f} {' '.join(map(repr, r[1:].tolist()))}\n" for r in rows)
    )
    noise = [0.02, 0.002] * rng.standard_normal((len(fine), 2))
    wheels = np.column_stack([fine - DT_LIDAR_WHEELS, speed + noise[:, 0], yaw_rate + noise[:, 1]])[100::10]
    lines = "".join(f"{1000 + t:.6f},{v!r},{w!r}\n" for t, v, w in wheels.tolist())
    (folder / "wheels.csv").write_text("stamp,speed,yaw_rate\n" + lines)
    (folder / "rig.toml").write_text(
        '[sensors.lidar]\nkind = "odometry"\nposes = "lidar.txt"\nformat = "tum"\n'
        "motion_sigma = [0.005, 0.005, 0.005, 3e-4, 3e-4, 3e-4]\n\n"
        '[sensors.wheels]\nkind = "wheel_odometry"\nrates = "wheels.csv"\n'
    )


def test_the_module_is_small() -> None:
    assert len(MODULE.read_text().splitlines()) < 60


def test_once_installed_it_is_listed_with_its_distribution(installed: dict[str, str]) -> None:
    done = calib_toolkit(installed, "plugins")
    assert done.returncode == 0, done.stderr
    (line,) = [row for row in done.stdout.splitlines() if "wheel_odometry " in row]
    for word in ("sensor", "calib-toolkit-wheel-odometry", "1.0.0", f"{installed['PYTHONPATH']}/wheel_odometry.py"):
        assert word in line


def test_it_is_calibrated_against_an_odometry_like_any_sensor(installed: dict[str, str], tmp_path: Path) -> None:
    """On a flat drive the wheels tell a clock offset and a turning axis; what they do not tell is not given."""
    write_rig(tmp_path)
    done = calib_toolkit(installed, "run", tmp_path, "--sensors", "lidar,wheels", "-o", tmp_path / "out")
    assert done.returncode in (0, 3), done.stderr
    found = json.loads((tmp_path / "out" / "calibration.json").read_text())
    assert found["base"] == "lidar"
    wheels = found["sensors"]["wheels"]
    assert wheels["dt_base_sensor"] == pytest.approx(DT_LIDAR_WHEELS, abs=0.01)
    axis = np.array(wheels["T_base_sensor"], dtype=float)[:3, 2]
    assert np.degrees(np.arccos(axis @ T_LIDAR_WHEELS[:3, 2])) < 1.0


def test_without_it_the_rig_is_refused_with_the_kinds_there_are(tmp_path: Path) -> None:
    write_rig(tmp_path)
    done = calib_toolkit(dict(os.environ), "inspect", tmp_path)
    assert done.returncode == 1
    assert "wheel_odometry" in done.stderr
    assert "odometry, " in done.stderr or ", odometry" in done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("1,2\n", "line 2: 2 columns where 3 belong"),
        ("1,fast,0\n", "line 2: could not convert string to float: 'fast'"),
        ("now,1,0\n", "line 2: 'now' is not a stamp"),
        ("", "holds no rows below its titles"),
        ("1,2,0\n1,2,0\n1,2,0\n", "2 of 3 rows have a stamp that goes back or repeats"),
    ],
)
def test_what_is_not_a_table_of_rates_is_refused(tmp_path: Path, text: str, sentence: str) -> None:
    (tmp_path / "wheels.csv").write_text("stamp,speed,yaw_rate\n" + text)
    with pytest.raises(DataError, match=rf"wheels\.csv.* {sentence}"):
        WHEELS.open_table(SensorTable("wheels", tmp_path, {"rates": "wheels.csv"}))


def test_rates_that_are_not_numbers_are_left_out_of_a_table_and_refused_elsewhere(tmp_path: Path) -> None:
    (tmp_path / "wheels.csv").write_text("stamp,speed,yaw_rate\n1,2,0\n1.5,nan,0\n2,2,0\n")
    stream = WHEELS.open_table(SensorTable("wheels", tmp_path, {"rates": "wheels.csv"})).streams["wheels"]
    assert stream.stamps.tolist() == [0.0, 1.0]
    assert "1 of 3 rows hold nan or nothing, the first in line 3" in stream.notes[0]
    stream = Stream("wheels", "wheel_odometry", np.array([0.0, 0.5, 1.0]), [(2, 0), (np.nan, 0), (2, 0)])
    with pytest.raises(DataError, match=r"sensor wheels: its rates at 0\.500 s are not numbers"):
        WHEELS.estimate(stream, WHEELS.options())
