"""Bags as files: every storage and compression, what topics are kept, odd clocks."""

import shutil

import numpy as np
import pytest
from bag_builders import PACKED, START, STEP, Messages, drive, made, plain, points, write

from calib_toolkit import DataError, LazyReadings, open_log


@pytest.mark.parametrize(("storage", "compression"), PACKED)
def test_every_storage_says_the_same(tmp_path, storage, compression):
    log = open_log(made(tmp_path / "a", storage, compression))
    assert {n: (s.kind, len(s)) for n, s in log.streams.items()} == {
        "velo": ("velodyne", 8),
        "cam0": ("monocular", 8),
        "ins": ("gps_ins", 8),
        "odom": ("odometry", 8),
    }
    assert log.notes == ()
    assert log.epoch_ns == START
    assert round(log.streams["cam0"].stamps[3] * 1e9) == 3 * STEP + 7
    other = open_log(made(tmp_path / "b.bag", "rosbag1"))
    for name in ("velo", "cam0"):
        a, b = (each.streams[name].readings[5] for each in (log, other))
        np.testing.assert_array_equal(getattr(a, "points", a), getattr(b, "points", b))


@pytest.mark.parametrize("storage", ["sqlite", "mcap"])
def test_a_file_of_a_bag_alone_and_a_bag_that_was_killed(tmp_path, storage):
    folder = made(tmp_path / "a", storage)
    assert len(open_log(plain(folder)).streams["velo"]) == 8
    (folder / "metadata.yaml").unlink()
    log = open_log(folder)
    assert "no metadata.yaml" in log.notes[0]
    assert len(log.streams["velo"]) == 8


def test_topics_are_listed_with_what_keeps_them(tmp_path):
    m = Messages("cdr")
    rows = drive("cdr", 3)
    rows += [("/status", START + k, m.make("std_msgs/String", "on")) for k in range(3)]
    rows += [("/none/points", START + k * STEP, m.cloud(0, points(np.random.default_rng(0)))) for k in range(3)]
    log = open_log(write(tmp_path / "a", "sqlite", rows))
    listed = {t.name: t for t in log.topics}
    assert listed["/velo/points"].sensor == "velo"
    assert listed["/cam0/camera_info"].sensor == "cam0"
    assert "no sensor reads" in listed["/status"].unused
    assert "stamps in its headers are zero" in listed["/none/points"].unused
    with pytest.raises(DataError, match="stamps in its headers are zero"):
        log.select(["velo", "odd=/none/points"])


def test_a_bag_without_sensors_says_what_it_has_and_what_is_read(tmp_path):
    m = Messages("cdr")
    rows = [("/tf", START + k * STEP, m.frames(m.transform("map", "base", (k, 0, 0)))) for k in range(3)]
    with pytest.raises(DataError, match=r"/tf \(tf2_msgs/TFMessage\): it tells where frames sit") as refused:
        open_log(write(tmp_path / "tf", "sqlite", rows))
    assert "sensor_msgs/PointCloud2" in str(refused.value)
    rows += [(f"/status{k:02d}", START, m.make("std_msgs/String", "on")) for k in range(30)]
    rows += [("/cam0/camera_info", START, m.info(START, np.eye(3)))]
    with pytest.raises(
        DataError, match=r"/cam0/camera_info \(sensor_msgs/CameraInfo\): no images go with it"
    ) as refused:
        open_log(write(tmp_path / "more", "sqlite", rows))
    assert "/status00 (std_msgs/String): no sensor reads this type" in str(refused.value)
    assert "and 12 topics more" in str(refused.value)


def test_some_stamps_of_zero_and_some_that_go_back(tmp_path):
    m, rng = Messages("cdr"), np.random.default_rng(0)
    stamps = [START + k * STEP for k in range(10)]
    stamps[3], stamps[6] = 0, START
    rows = [("/p", START + k * STEP, m.cloud(s, points(rng))) for k, s in enumerate(stamps)]
    stream = open_log(write(tmp_path / "a", "sqlite", rows)).streams["p"]
    assert len(stream) == 8
    assert "1 of 10 messages without a stamp" in stream.notes[0]
    assert "1 of 10 messages whose stamps repeat or go back" in stream.notes[1]


def test_a_clock_of_another_epoch_is_brought_to_the_others_and_that_is_said(tmp_path):
    m, rng, rows = Messages("cdr"), np.random.default_rng(0), []
    for k in range(10):
        ns = START + k * STEP
        rows += [
            ("/a/odom", ns, m.pose(ns, (k, 0, 0))),
            ("/b/odom", ns, m.pose(ns, (k, 0, 0))),
            ("/p", ns, m.cloud(ns - START + 5 * 10**9 + 250_000_000, points(rng))),
        ]
    log = open_log(write(tmp_path / "a", "sqlite", rows))
    stream = log.streams["p"]
    assert "its clock is -1699999995 s from the others'" in stream.notes[0]
    assert abs(stream.stamps[0] - log.streams["a"].stamps[0]) == pytest.approx(0.25, abs=0.51)


def test_reading_is_lazy_and_one_message_is_fetched_by_its_place(tmp_path):
    path = made(tmp_path / "a.bag", "rosbag1", n=50)
    stream = open_log(path).streams["velo"]
    assert isinstance(stream.readings, LazyReadings)
    moved = tmp_path / "moved"
    shutil.move(path, moved)
    with pytest.raises(DataError, match="No such file"):
        stream.readings[49]
