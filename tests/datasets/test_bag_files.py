"""Bags as files: every storage and compression, odd clocks, damage of every kind, and conversion."""

import shutil
import sqlite3
import struct
from contextlib import suppress
from dataclasses import replace

import numpy as np
import pytest
from bag_builders import START, Messages, points, write

from calib_toolkit import DataError, Fix, LazyReadings, Log, Scan, Stream, open_log
from calib_toolkit.plugins import registry
from calib_toolkit.progress import Silent
from calib_toolkit.types import CameraIntrinsics, PoseReading
from calib_toolkit_datasets import kitti_writing
from calib_toolkit_datasets.bags import containers, writing

STEP = 100_000_000
STORAGES = ["rosbag1", "sqlite", "mcap"]
PACKED = [
    *((s, None) for s in STORAGES),
    ("rosbag1", "bz2"),
    ("rosbag1", "lz4"),
    ("sqlite", "zstd"),
    ("mcap", "zstd"),
]


def drive(encoding, n=8, size=40):
    m, rows, rng = Messages(encoding), [], np.random.default_rng(4)
    K = np.array([[60.0, 0, 8], [0, 60, 6], [0, 0, 1]])
    rows.append(("/tf_static", START, m.frames(m.transform("velo", "cam0", (1, 0, 0)))))
    for k in range(n):
        ns = START + k * STEP
        pixels = rng.integers(0, 255, (12, 16, 3)).astype(np.uint8)
        rows += [
            ("/velo/points", ns, m.cloud(ns, points(rng, size, time=np.linspace(0, 0.09, size, dtype="f4")))),
            ("/cam0/image_raw", ns + 7, m.image(ns + 7, pixels, "bgr8")),
            ("/cam0/camera_info", ns + 7, m.info(ns + 7, K, size=(16, 12))),
            ("/ins/fix", ns, m.fix(ns, 49 + 1e-5 * k, 8.4, 100.0)),
            ("/ins/imu", ns, m.imu(ns, (0, 0, 0.1, np.sqrt(0.99)))),
            ("/odom", ns, m.pose(ns, (k, 0, 0))),
        ]
    return rows


def made(path, storage, compression=None, n=8, size=40):
    return write(path, storage, drive("ros1" if storage == "rosbag1" else "cdr", n, size), compression)


def plain(folder):
    """The file in a ROS 2 bag's folder."""
    (file,) = [f for f in folder.iterdir() if f.suffix in (".db3", ".mcap")]
    return file


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


@pytest.mark.parametrize("storage", ["rosbag1", "mcap"])
def test_what_comes_before_the_end_of_a_file_cut_short_is_read(tmp_path, storage):
    path = made(tmp_path / "a", storage, n=40, size=20_000)
    file = path if path.is_file() else plain(path)
    raw = file.read_bytes()
    (tmp_path / "cut").write_bytes(raw[: len(raw) // 2])
    log = open_log(tmp_path / "cut")
    assert "ends at byte" in log.notes[0]
    assert 0 < len(log.streams["velo"]) < 40


def test_a_bag_whose_index_was_never_written(tmp_path):
    path = made(tmp_path / "a.bag", "rosbag1")
    raw = bytearray(path.read_bytes())
    at = raw.index(b"index_pos=") + 10
    (index,) = struct.unpack_from("<Q", raw, at)
    raw[at : at + 8] = bytes(8)
    path.write_bytes(raw[:index])
    assert len(open_log(path).streams["velo"]) == 8


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


def test_a_message_type_of_ones_own_under_a_name_of_ros_is_refused(tmp_path):
    path = made(tmp_path / "a", "sqlite")
    with sqlite3.connect(plain(path)) as db:
        text = db.execute(
            "SELECT encoded_message_definition FROM message_definitions WHERE topic_type LIKE '%PointCloud2'"
        ).fetchone()[0]
        db.execute(
            "UPDATE message_definitions SET encoded_message_definition = ? WHERE topic_type LIKE '%PointCloud2'",
            (text.replace("point_step", "pointStep"),),
        )
    db.close()
    log = open_log(path)
    assert "velo" not in log.streams
    assert "field 'point_step'" in next(t.unused for t in log.topics if t.name == "/velo/points")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("!!python/object/apply:os.system ['touch PWNED']", "can not be read"),
        ("rosbag2_bagfile_information: {relative_file_paths: ['../../etc/passwd']}", "outside its folder"),
        ("rosbag2_bagfile_information: {relative_file_paths: ['gone.db3']}", "lists gone.db3, which is missing"),
        ("rosbag2_bagfile_information: {relative_file_paths: [a.db3], compression_mode: FILE}", "zstd -d"),
        ("[1, 2", "can not be read"),
        ("just words", "not that of a ROS 2 bag"),
    ],
)
def test_metadata_that_is_not_to_be_trusted(tmp_path, monkeypatch, text, said):
    path = made(tmp_path / "a", "sqlite", n=2)
    monkeypatch.chdir(tmp_path)
    (path / "metadata.yaml").write_text(text)
    with pytest.raises(DataError, match=said):
        open_log(path)
    assert not (tmp_path / "PWNED").exists()


def test_a_database_whose_messages_are_a_view_is_refused(tmp_path):
    with sqlite3.connect(tmp_path / "a.db3") as db:
        db.execute("CREATE TABLE topics (id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT)")
        db.execute(
            "CREATE VIEW messages AS WITH RECURSIVE m(id) AS (SELECT 1 UNION ALL SELECT id + 1 FROM m) "
            "SELECT id, 1 AS topic_id, id AS timestamp, x'00' AS data FROM m"
        )
    db.close()
    with pytest.raises(DataError, match="no table 'messages'"):
        open_log(tmp_path / "a.db3")


def test_a_chunk_that_unpacks_to_more_than_it_says_is_not_held(tmp_path):
    import bz2

    path = made(tmp_path / "a.bag", "rosbag1", "bz2")
    raw = path.read_bytes()
    at = raw.index(b"BZh")
    (length,) = struct.unpack_from("<I", raw, at - 4)
    bomb = bz2.compress(bytes(50_000_000))
    path.write_bytes(raw[: at - 4] + struct.pack("<I", len(bomb)) + bomb + raw[at + length :])
    with pytest.raises(DataError, match="a chunk holds"):
        open_log(path)


def read_all(path, plugins):
    """Everything that a drive says; refusals of single readings are as good."""
    log = open_log(path, plugins=plugins)
    for stream in log.streams.values():
        for k in range(len(stream)):
            with suppress(DataError):
                stream.readings[k]


def mutated(raw, rng):
    raw = bytearray(raw)
    kind = rng.integers(4)
    if kind == 0:
        return bytes(raw[: rng.integers(len(raw))])
    if kind == 1:
        at, size = rng.integers(len(raw)), rng.integers(1, 64)
        del raw[at : at + size]
        return bytes(raw)
    for _ in range(rng.integers(1, 8)):
        at = int(rng.integers(len(raw) - 8))
        if kind == 2:
            raw[at] ^= 1 << int(rng.integers(8))
        else:
            raw[at : at + 4] = bytes(rng.choice([b"\xff" * 4, bytes(4), b"\x00\x00\x00\x80", b"\x7f" * 4]))
    return bytes(raw)


def mutate(tmp_path, storage, compression, count):
    path = made(tmp_path / "a", storage, compression, n=3)
    file = path if path.is_file() else plain(path)
    raw, rng, damaged = file.read_bytes(), np.random.default_rng([count, len(storage)]), tmp_path / f"m{file.suffix}"
    refused, plugins = 0, registry()
    for _ in range(count):
        damaged.write_bytes(mutated(raw, rng))
        try:
            read_all(damaged, plugins)
        except DataError:
            refused += 1
    return refused


@pytest.mark.parametrize("storage", STORAGES)
def test_a_hundred_damaged_files(tmp_path, storage):
    assert 0 < mutate(tmp_path, storage, None, 100) < 100


@pytest.mark.long
@pytest.mark.parametrize(("storage", "compression"), PACKED)
def test_a_thousand_damaged_files(tmp_path, storage, compression):
    assert 0 < mutate(tmp_path, storage, compression, 1000) < 1000


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


def test_reading_is_lazy_and_one_message_is_fetched_by_its_place(tmp_path):
    path = made(tmp_path / "a.bag", "rosbag1", n=50)
    stream = open_log(path).streams["velo"]
    assert isinstance(stream.readings, LazyReadings)
    moved = tmp_path / "moved"
    shutil.move(path, moved)
    with pytest.raises(DataError, match="No such file"):
        stream.readings[49]
