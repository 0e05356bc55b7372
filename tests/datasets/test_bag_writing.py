"""What is written as a bag or as KITTI raw is read again, and what has no place there is counted."""

from dataclasses import replace

import numpy as np
import pytest
from bag_builders import START

from calib_toolkit import DataError, Fix, LazyReadings, Log, Scan, Stream, open_log
from calib_toolkit.progress import Silent
from calib_toolkit.types import CameraIntrinsics, PoseReading
from calib_toolkit_datasets import kitti_writing
from calib_toolkit_datasets.bags import containers, writing


def small_log(sigma=0.03):
    """What every format has a place for."""
    rng, n = np.random.default_rng(5), 6
    scans = [
        Scan(
            rng.uniform(-9, 9, (30, 3)).astype("f4"),
            rng.uniform(-0.05, 0.05, 30).astype("f4"),
            rng.random(30).astype("f4"),
        )
        for _ in range(n)
    ]
    images = [rng.integers(0, 255, (12, 16)).astype(np.uint8) for _ in range(n)]
    fixes = [Fix(0.85, 0.14 + 1e-7 * k, 100.0, 0.01, -0.02, 3.0, np.full(3, sigma)) for k in range(n)]
    at = np.arange(n) * 0.1
    lens = CameraIntrinsics(
        np.array([[60.0, 0, 8], [0, 60, 6], [0, 0, 1]]), np.array([-0.2, 0.05, 0, 0, 0]), (16, 12)
    )
    streams = {
        "velo": Stream("velo", "velodyne", at, scans),
        "cam0": Stream("cam0", "monocular", at + 1e-9, images, lens, has_scale=False),
        "ins": Stream("ins", "gps_ins", at + 0.013, fixes),
    }
    return Log(containers.Path("here"), streams, START + 123)


@pytest.mark.parametrize(
    ("write_log", "name"),
    [
        (writing.write_bag1, "a.bag"),
        (writing.write_bag2, "a"),
        (writing.write_mcap, "a.mcap"),
        (kitti_writing.write, "k"),
    ],
)
def test_what_is_written_is_read_again(tmp_path, write_log, name):
    log = small_log()
    (tmp_path / name).parent.mkdir(exist_ok=True)
    if write_log is kitti_writing.write:
        (tmp_path / name).mkdir()
    done = write_log(log, tmp_path / name, Silent())
    assert dict(done.readings) == {"velo": 6, "cam0": 6, "ins": 6}
    again = open_log(tmp_path / name / done.inside)
    assert list(again.streams) == list(log.streams)
    for n, stream in again.streams.items():
        ns = again.epoch_ns + np.round(stream.stamps * 1e9).astype(int)
        wanted = log.epoch_ns + np.round(log.streams[n].stamps * 1e9).astype(int)
        assert ns.tolist() == wanted.tolist()
    scan, wanted = again.streams["velo"].readings[4], log.streams["velo"].readings[4]
    np.testing.assert_array_equal(scan.points, wanted.points)
    np.testing.assert_array_equal(scan.intensity, wanted.intensity)
    if not done.inside:
        np.testing.assert_array_equal(scan.times, wanted.times)
    np.testing.assert_array_equal(again.streams["cam0"].readings[2], log.streams["cam0"].readings[2])
    np.testing.assert_array_equal(again.streams["cam0"].intrinsics.K, log.streams["cam0"].intrinsics.K)
    np.testing.assert_array_equal(
        again.streams["cam0"].intrinsics.distortion, log.streams["cam0"].intrinsics.distortion
    )
    a, b = again.streams["ins"].readings[3], log.streams["ins"].readings[3]
    for field, within in {"lat": 1e-15, "lon": 1e-15, "alt": 0, "roll": 1e-15, "pitch": 1e-15, "yaw": 1e-14}.items():
        assert abs(getattr(a, field) - getattr(b, field)) <= within, field
    np.testing.assert_allclose(a.sigma_position, b.sigma_position, rtol=1e-15)


def test_what_is_not_written_is_counted(tmp_path):
    def broken(k):
        if k == 2:
            raise DataError("file 2 is broken")
        return PoseReading(np.eye(4))

    stream = Stream("o", "odometry", np.arange(4.0), LazyReadings(broken, range(4)))
    odd = Stream("odd", "other", np.arange(4.0), list("abcd"))
    done = writing.write_bag2(Log(tmp_path, {"o": stream, "odd": odd}, START), tmp_path / "a", Silent())
    assert dict(done.readings) == {"o": 3, "odd": 0}
    assert set(done.lost) == {
        "o: 1 unreadable, the first because file 2 is broken",
        "odd: 4 readings of kind str, for which ROS has no message",
    }


def test_a_wider_sigma_for_one_axis_is_named_as_lost_by_kitti(tmp_path):
    log = small_log()
    fixes = [replace(f, sigma_position=np.array([0.1, 0.1, 0.3])) for f in log.streams["ins"].readings]
    log = replace(log, streams={"ins": replace(log.streams["ins"], readings=fixes)})
    (tmp_path / "k").mkdir()
    done = kitti_writing.write(log, tmp_path / "k", Silent())
    assert done.lost == ("ins: the sigma of each axis of a position; KITTI has one for all",)
