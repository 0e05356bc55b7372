"""Bags that are damaged or not to be trusted: what is there is read, or a sentence; nothing is run."""

import sqlite3
import struct
from contextlib import suppress

import numpy as np
import pytest
from bag_builders import PACKED, STORAGES, made, plain

from calib_toolkit import DataError, open_log
from calib_toolkit.plugins import registry


@pytest.mark.parametrize("storage", ["rosbag1", "mcap"])
def test_what_comes_before_the_end_of_a_file_cut_short_is_read(tmp_path, storage):
    path = made(tmp_path / "a", storage, n=40, size=20_000)
    file = path if path.is_file() else plain(path)
    raw = file.read_bytes()
    (tmp_path / "cut").write_bytes(raw[: len(raw) // 2])
    log = open_log(tmp_path / "cut")
    assert "ends at byte" in log.notes[0]
    assert 0 < len(log.streams["velo"]) < 40


@pytest.mark.parametrize(
    ("storage", "compression", "before", "kind"),
    [
        ("mcap", "zstd", b"", 200),  # a private record
        ("mcap", "zstd", b"", 9),  # an attachment
        ("mcap", None, b"", 15),  # the end of the data
        ("mcap", None, b"", 2),  # the footer
        ("rosbag1", "lz4", b"op=", 9),
    ],
)
def test_chunks_that_pass_for_something_else_are_missed_by_the_count(tmp_path, storage, compression, before, kind):
    path = made(tmp_path / "a", storage, compression, size=20_000)
    file = path if path.is_file() else plain(path)
    raw = bytearray(file.read_bytes())
    at = second_chunk(raw, storage) + len(before)
    assert raw[at - len(before) : at + 1] == before + bytes([5 if before else 6])
    raw[at] = kind
    (tmp_path / "odd").write_bytes(raw)
    log = open_log(tmp_path / "odd")
    left = sum(t.messages for t in log.topics)
    assert 0 < left < 49
    assert log.notes == (f"odd counts 49 messages, of which {left} were found; the others are lost",)


def second_chunk(raw, storage):
    """Where the kind of a file's second chunk is written."""
    if storage == "rosbag1":
        return raw.index(b"op=\x05", raw.index(b"op=\x05") + 1)
    at, seen = 8, 0
    while (seen := seen + (raw[at] == 6)) < 2:
        at += 9 + struct.unpack_from("<Q", raw, at + 1)[0]
    return at


@pytest.mark.parametrize("storage", ["sqlite", "mcap"])
def test_messages_that_the_metadata_counts_and_no_file_holds_are_noted(tmp_path, storage):
    path = made(tmp_path / "a", storage)
    text = (path / "metadata.yaml").read_text()
    assert "message_count: 49" in text
    (path / "metadata.yaml").write_text(text.replace("message_count: 49", "message_count: 51"))
    log = open_log(path)
    assert log.notes == ("metadata.yaml counts 51 messages, of which 49 were found; the others are lost",)


def test_a_file_that_was_cut_behind_its_messages_says_so(tmp_path):
    file = plain(made(tmp_path / "a", "mcap"))
    file.write_bytes(file.read_bytes()[:-20])
    log = open_log(file)
    assert len(log.streams["velo"]) == 8
    assert "in the middle of a record of 20 bytes" in log.notes[0]


def test_a_bag_whose_index_was_never_written(tmp_path):
    path = made(tmp_path / "a.bag", "rosbag1")
    raw = bytearray(path.read_bytes())
    at = raw.index(b"index_pos=") + 10
    (index,) = struct.unpack_from("<Q", raw, at)
    raw[at : at + 8] = bytes(8)
    path.write_bytes(raw[:index])
    assert len(open_log(path).streams["velo"]) == 8


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


@pytest.mark.parametrize("storage", STORAGES)
def test_a_hundred_damaged_files(tmp_path, storage):
    assert 0 < mutate(tmp_path, storage, None, 100) < 100


@pytest.mark.long
@pytest.mark.parametrize(("storage", "compression"), PACKED)
def test_a_thousand_damaged_files(tmp_path, storage, compression):
    assert 0 < mutate(tmp_path, storage, compression, 1000) < 1000


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


def read_all(path, plugins):
    """Everything that a drive says; refusals of single readings are as good."""
    log = open_log(path, plugins=plugins)
    for stream in log.streams.values():
        for k in range(len(stream)):
            with suppress(DataError):
                stream.readings[k]
