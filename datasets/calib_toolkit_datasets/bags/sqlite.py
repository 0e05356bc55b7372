"""ROS 2 bags that SQLite stores (``.db3``), their messages as they are or compressed by zstd."""

import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from urllib.parse import quote

from calib_toolkit_datasets.bags.index import HEAD, LARGEST, Channel, Damaged, Index, Key
from calib_toolkit_datasets.bags.packing import zstd

MAGIC = b"SQLite format 3\0"
PACKED = b"\x28\xb5\x2f\xfd"
"""How what zstd made begins; CDR begins with a zero."""
_DEFINITIONS = {"ros2msg": False, "ros2idl": True}


def scan(path: Path, number: int, index: Index) -> None:
    """Find every message of a file, which is the recording's file of that number. Raises Damaged at what stops it."""
    if path.with_name(f"{path.name}-wal").exists():
        index.notes.append(
            f"{path.name}: its last messages lie in {path.name}-wal and are not read; close the bag first"
        )
    with _opened(path) as db:
        for table in ("topics", "messages"):
            if db.execute("SELECT type FROM sqlite_master WHERE name = ?", (table,)).fetchone() != ("table",):
                raise Damaged(f"it has no table '{table}', as a bag of ROS 2 has")
        channels = _channels(db)
        for channel in channels.values():
            index.declare(channel)
        for row, topic, received, size in db.execute("SELECT id, topic_id, timestamp, length(data) FROM messages"):
            if not all(isinstance(value, int) for value in (row, topic, received, size)) or topic not in channels:
                raise Damaged(f"its message {row} has no topic, no time or no data")
            if size > LARGEST:
                raise Damaged(f"its message {row} has {size} bytes, more than any message")
            head = _head(db, row, size)
            if head.startswith(PACKED):
                head = _unpacked(_data(db, row), row)[:HEAD]
            index.add(channels[topic], max(received, 0), head, (number, 0, row, size))


def fetch(path: Path, key: Key) -> bytes:
    """The bytes of one message. Raises Damaged."""
    with _opened(path) as db:
        data = _data(db, key[2])
    return _unpacked(data, key[2]) if data.startswith(PACKED) else data


@contextmanager
def _opened(path: Path) -> Iterator[sqlite3.Connection]:
    """The database, to be read only; what it can make SQLite do is bounded."""
    try:
        with closing(sqlite3.connect(f"file:{quote(str(path.absolute()))}?mode=ro&immutable=1", uri=True)) as db:
            db.execute("PRAGMA trusted_schema = OFF")
            db.execute("PRAGMA cell_size_check = ON")
            db.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, LARGEST)
            yield db
    except (sqlite3.Error, OverflowError, UnicodeDecodeError) as e:
        raise Damaged(f"SQLite can not read it ({' '.join(str(e).split())[:120]})") from e


def _channels(db: sqlite3.Connection) -> dict[int, Channel]:
    definitions = dict[str, tuple[str, str]]()
    if db.execute("SELECT 1 FROM sqlite_master WHERE type = 'table' AND name = 'message_definitions'").fetchone():
        rows = db.execute("SELECT topic_type, encoding, encoded_message_definition FROM message_definitions")
        definitions = {str(name): (str(style), str(text)) for name, style, text in rows.fetchmany(10_000)}
    channels = {}
    rows = db.execute("SELECT id, name, type, serialization_format FROM topics")
    for number, topic, kind, encoding in rows.fetchmany(100_000):
        style, text = definitions.get(str(kind), ("", ""))
        known = style in _DEFINITIONS
        channels[number] = Channel(
            str(topic), str(kind), str(encoding), text if known else "", _DEFINITIONS.get(style, False)
        )
    return channels


def _data(db: sqlite3.Connection, row: int) -> bytes:
    found = db.execute("SELECT data FROM messages WHERE id = ?", (row,)).fetchone()
    if found is None or not isinstance(found[0], bytes):
        raise Damaged(f"its message {row} holds no data")
    return bytes(found[0])


def _unpacked(data: bytes, row: int) -> bytes:
    try:
        return bytes(zstd().ZstdDecompressor().decompress(data, max_length=LARGEST))
    except (zstd().ZstdError, EOFError, MemoryError) as e:
        raise Damaged(f"its message {row} can not be unpacked ({e})") from e


def _head(db: sqlite3.Connection, row: int, size: int) -> bytes:
    """The first bytes of a message, without loading the rest."""
    with db.blobopen("messages", "data", row, readonly=True) as blob:
        return blob.read(min(HEAD, size))
