"""``calib-toolkit convert`` and ``inspect`` of what it wrote; the same calibration from every format."""

from dataclasses import replace

import numpy as np
import pytest
from click.testing import CliRunner
from small_runs import killed_when

from calib_toolkit import Config, calibrate, open_log
from calib_toolkit.cli import main
from calib_toolkit.plugins import registry
from calib_toolkit.progress import Silent

FORMATS = {"rig": "r", "rosbag1": "a.bag", "rosbag2": "b", "mcap": "c.mcap", "kitti-raw": "d", "nuscenes": "e"}


def call(*arguments):
    return CliRunner().invoke(main, list(map(str, arguments)))


@pytest.fixture
def rig(tmp_path):
    """Two odometries of one small drive."""
    turned = [(k / 10, np.sin(k / 20), np.sin(k / 200), np.cos(k / 200)) for k in range(40)]
    rows = [f"{1700000000 + x:.9f} {x} {y} 0 0 0 {s} {c}" for x, y, s, c in turned]
    (tmp_path / "rig").mkdir()
    (tmp_path / "rig/poses.txt").write_text("\n".join(rows) + "\n")
    table = '[sensors.{}]\nkind = "odometry"\nposes = "poses.txt"\nformat = "tum"\n'
    (tmp_path / "rig/rig.toml").write_text(table.format("a") + table.format("b"))
    return tmp_path / "rig"


def test_what_was_read_written_and_skipped_is_counted(rig, tmp_path):
    done = call("convert", rig, tmp_path / "a.bag", "--to", "rosbag1")
    assert done.exit_code == 0, done.output
    assert done.output.splitlines()[-1].endswith("80 readings read, 80 written (a 40, b 40), 0 skipped")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.bag", "rig"]


def test_topics_are_shown_and_named(rig, tmp_path):
    call("convert", rig, tmp_path / "a.bag", "--to", "rosbag1", "--sensors", "lidar=a,b")
    seen = call("inspect", tmp_path / "a.bag").output
    assert "nav_msgs/Odometry" in seen
    assert "--sensors b=/b/odom,lidar=/lidar/odom" in seen
    log = open_log(tmp_path / "a.bag").select(["one=/lidar/odom", "two=b"])
    assert list(log.streams) == ["one", "two"]
    assert [s.clock for s in log.streams.values()] == ["one", "two"]


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--to", "betamax"], "no plugin writes that; there are:"),
        (["--to", "rosbag1", "--sensors", "z"], "no sensor named 'z'"),
        (["--to", "kitti-raw"], "no sensor that KITTI raw has a place for"),
    ],
)
def test_refusals_leave_nothing(rig, tmp_path, arguments, said):
    done = call("convert", rig, tmp_path / "x", *arguments)
    assert done.exit_code == 1
    assert said in done.output
    assert [p.name for p in tmp_path.iterdir()] == ["rig"]


def test_what_is_there_is_not_overwritten(rig, tmp_path):
    (tmp_path / "a.bag").write_text("mine")
    done = call("convert", rig, tmp_path / "a.bag", "--to", "rosbag1")
    assert (done.exit_code, (tmp_path / "a.bag").read_text()) == (1, "mine")


def test_a_killed_conversion_leaves_nothing_that_looks_whole(rig, tmp_path):
    slow = tmp_path / "slow.py"
    slow.write_text(
        "import time\nfrom calib_toolkit import Dataset, Written, hookimpl\n"
        "def write(log, path, progress):\n    path.write_text('half')\n    time.sleep(60)\n    return Written({})\n"
        "@hookimpl\ndef calib_register_datasets():\n"
        "    return [Dataset('slow', 'nothing', lambda p: False, None, write)]\n"
    )
    command = ["convert", rig, tmp_path / "x", "--to", "slow", "--plugin", slow]
    killed_when((tmp_path / ".x.part/x").exists, *command)
    assert not (tmp_path / "x").exists()
    done = call("convert", rig, tmp_path / "x", "--to", "rosbag2")
    assert done.exit_code == 0
    assert not (tmp_path / ".x.part").exists()


def slow_drive(tmp_path, seconds):
    """A rig of one scanner whose readings take so long each, and the plugin that reads it."""
    plugin = tmp_path / "slow.py"
    plugin.write_text(
        "import time\nimport numpy as np\n"
        "from calib_toolkit import Dataset, LazyReadings, Log, Scan, Stream, hookimpl\n"
        f"def load(k):\n    time.sleep({seconds})\n    return Scan(np.full((5, 3), k, 'f4'))\n"
        "def read(path, context):\n    scans = LazyReadings(load, range(40))\n"
        "    return Log(path, {'velo': Stream('velo', 'velodyne', np.arange(40.0), scans)})\n"
        "@hookimpl\ndef calib_register_datasets():\n"
        "    return [Dataset('sleepy', 'a .sleepy', lambda p: p.suffix == '.sleepy', read)]\n"
    )
    (tmp_path / "a.sleepy").touch()
    return plugin


def test_a_killed_conversion_to_a_folder_goes_on(tmp_path):
    plugin = slow_drive(tmp_path, 0.1)
    command = ["convert", tmp_path / "a.sleepy", tmp_path / "x", "--to", "rig", "--plugin", plugin]
    scans = tmp_path / ".x.part/x/velo/scans"
    killed_when((scans / "000002.npy").exists, *command)
    assert not (tmp_path / "x").exists()
    first = (scans / "000001.npy").stat().st_mtime_ns
    slow_drive(tmp_path, 0.0)
    done = call(*command)
    assert done.exit_code == 0, done.output
    assert done.output.splitlines()[-1].endswith("40 readings read, 40 written (velo 40), 0 skipped")
    assert (tmp_path / "x/velo/scans/000001.npy").stat().st_mtime_ns == first
    assert not (tmp_path / ".x.part").exists()
    assert len(open_log(tmp_path / "x").streams["velo"]) == 40


def test_what_a_kill_left_of_another_conversion_is_removed(rig, tmp_path):
    (tmp_path / ".x.part/x").mkdir(parents=True)
    (tmp_path / ".x.part/plan").write_text("of another")
    (tmp_path / ".x.part/x/stray").touch()
    assert call("convert", rig, tmp_path / "x", "--to", "rig").exit_code == 0
    assert sorted(p.name for p in (tmp_path / "x").iterdir()) == ["a", "b", "rig.toml"]


def test_trajectories_are_read_as_a_folder(rig, tmp_path):
    done = call("convert", rig, tmp_path / "t", "--to", "tum")
    assert done.exit_code == 0, done.output
    a, b = open_log(rig).streams["a"], open_log(tmp_path / "t").streams["a"]
    np.testing.assert_allclose(b.stamps, a.stamps, atol=1e-9)
    np.testing.assert_allclose(b.readings[30].T_world_sensor, a.readings[30].T_world_sensor, atol=1e-12)


@pytest.mark.long
def test_the_same_calibration_from_every_format(tmp_path):
    drive = tmp_path / "drive"
    made = call("simulate", drive, "--rig", "compact", "--seconds", 12, "--seed", 3, "--jobs", 1)
    assert made.exit_code == 0, made.output
    config, plugins = Config(jobs=1, appearance=("none",)), registry()
    log = open_log(drive)
    # KITTI has one sigma for all axes of a position and none for angles
    ins = log.streams["ins"]
    fixes = [replace(f, sigma_position=np.full(3, 0.03), sigma_rpy=None) for f in ins.readings]
    log = replace(log, streams={**log.streams, "ins": replace(ins, readings=fixes)})
    wanted = calibrate(log, config, plugins, cache_folder=tmp_path / "cache").calibration
    for target, name in FORMATS.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        writer = plugins.datasets[target].write
        done = writer(log, tmp_path / name, Silent())
        assert dict(done.readings) == {n: len(s) for n, s in log.streams.items()}
        again = open_log(tmp_path / name / done.inside).select(list(log.streams))
        found = calibrate(again, config, plugins, cache_folder=tmp_path / "cache").calibration
        np.testing.assert_allclose(found.T_base_sensor, wanted.T_base_sensor, atol=1e-5, err_msg=target)
        np.testing.assert_allclose(found.dt_base_sensor, wanted.dt_base_sensor, atol=1e-6, err_msg=target)
        np.testing.assert_allclose(found.sigma, wanted.sigma, rtol=1e-3, err_msg=target)
