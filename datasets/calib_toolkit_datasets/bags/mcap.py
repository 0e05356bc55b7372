"""MCAP files: https://mcap.dev/spec

Read from front to end, so that a file without an index, or one that was cut short, can be read as well.
"""

import struct
from functools import lru_cache
from pathlib import Path
from zlib import crc32

from calib_toolkit_datasets.bags.index import HEAD, Channel, Damaged, Index, Key
from calib_toolkit_datasets.bags.packing import message, read, size_of, unpack

MAGIC = b"\x89MCAP0\r\n"
SCHEMA, CHANNEL, MESSAGE, CHUNK, STATISTICS = 3, 4, 5, 6, 11
FOOTER, DATA_END = (2, 20), (15, 4)  # and their lengths
MESSAGE_HEADER = struct.Struct("<HIQQ")
_RECORD = struct.Struct("<BQ")
_CHUNK = struct.Struct("<QQQI")
_COUNT = struct.Struct("<Q")
_DEFINITIONS = {"ros1msg": False, "ros2msg": False, "ros2idl": True, "omgidl": True}


class _Declared:
    """Schemas and channels by their numbers."""

    def __init__(self) -> None:
        self.schemas: dict[int, tuple[str, str, str]] = {}
        self.channels: dict[int, Channel] = {}

    def schema(self, data: bytes) -> None:
        rest = _Fields(data)
        number = rest.number("<H")
        self.schemas[number] = (rest.text(), rest.text(), rest.text(errors="replace"))

    def channel(self, data: bytes) -> Channel:
        rest = _Fields(data)
        number, schema = rest.number("<H"), rest.number("<H")
        topic, encoding = rest.text(), rest.text()
        name, style, definition = self.schemas.get(schema, ("", "", ""))
        if encoding == "ros1" and name.count("/") == 1:
            name = name.replace("/", "/msg/")
        known = style in _DEFINITIONS
        channel = Channel(topic, name, encoding, definition if known else "", _DEFINITIONS.get(style, False))
        return self.channels.setdefault(number, channel)


def scan(path: Path, number: int, index: Index) -> None:
    """Find every message of a file, which is the recording's file of that number, and how many it says there are.

    Raises Damaged at what stops it.
    """
    size, declared = size_of(path), _Declared()
    with path.open("rb") as file:
        if file.read(len(MAGIC)) != MAGIC:
            raise Damaged("it does not begin as an MCAP file does")
        kind, length, summary = 0, 0, False
        while (kind, length) != FOOTER:
            at = file.tell()
            kind, length = _RECORD.unpack(read(file, _RECORD.size, size - at))
            start = file.tell()
            summary |= (kind, length) == DATA_END
            if start + length > size:
                raise Damaged(f"it ends at byte {size}, in the middle of a record of {length} bytes")
            if kind == STATISTICS and length >= _COUNT.size:
                index.stated += _COUNT.unpack(read(file, _COUNT.size, size - start))[0]
            elif summary:
                pass  # it repeats what was declared
            elif kind == CHUNK:
                data = read(file, length, size - start)
                try:
                    _inside(data, at, start, number, declared, index)
                except Damaged as e:
                    index.notes.append(f"{path.name}: from byte {at} on {e}; the rest of that chunk is left out")
            elif kind in (SCHEMA, CHANNEL, MESSAGE):
                _one(kind, read(file, length, size - start), 0, length, (number, 0, start, length), declared, index)
            file.seek(start + length)


def fetch(path: Path, key: Key) -> bytes:
    """The bytes of one message. Raises Damaged or OSError."""
    return message(path, key, _chunk)


@lru_cache(maxsize=2)
def _chunk(path: Path, at: int) -> bytes:
    size = size_of(path)
    with path.open("rb") as file:
        file.seek(at)
        _, length = _RECORD.unpack(read(file, _RECORD.size, size - at))
        return _unpacked(read(file, length, size - file.tell()))[0]


def _inside(data: bytes, at: int, start: int, number: int, declared: _Declared, index: Index) -> None:
    """The records of a chunk that begins at byte ``at`` of the file, and its contents at ``start``."""
    whole, packed, first = _unpacked(data)
    here = 0
    while here < len(whole):
        if here + _RECORD.size > len(whole):
            raise Damaged("it breaks off")
        kind, length = _RECORD.unpack_from(whole, here)
        here += _RECORD.size
        if here + length > len(whole):
            raise Damaged("it breaks off")
        key = (number, at, here, length) if packed else (number, 0, start + first + here, length)
        _one(kind, whole, here, length, key, declared, index)
        here += length


def _unpacked(data: bytes) -> tuple[bytes, bool, int]:
    """The records of a chunk, whether they were packed, and how many bytes of the chunk come before them."""
    try:
        _, _, size, crc = _CHUNK.unpack_from(data)
        rest = _Fields(data, _CHUNK.size)
        compression, length = rest.text(), rest.number("<Q")
    except struct.error as e:
        raise Damaged("the header of a chunk breaks off") from e
    packed = data[rest.at : rest.at + length]
    if len(packed) != length:
        raise Damaged("a chunk says it is longer than its record")
    whole = unpack(packed, compression, size)
    if crc and crc32(whole) != crc:
        raise Damaged("a chunk's checksum does not fit what it holds")
    return whole, bool(compression), rest.at


def _one(kind: int, data: bytes, at: int, length: int, key: Key, declared: _Declared, index: Index) -> None:
    """One record, whose content is ``data[at : at + length]``."""
    try:
        if kind == SCHEMA:
            declared.schema(data[at : at + length])
        elif kind == CHANNEL:
            index.declare(declared.channel(data[at : at + length]))
        elif kind == MESSAGE:
            channel, _, received, _ = MESSAGE_HEADER.unpack_from(data, at)
            if channel not in declared.channels or length < MESSAGE_HEADER.size:
                raise Damaged("there is a message of a channel that was not declared")
            number, chunk, start, _ = key
            head, skip = at + MESSAGE_HEADER.size, MESSAGE_HEADER.size
            found = (number, chunk, start + skip, length - skip)
            index.add(declared.channels[channel], received, data[head : min(head + HEAD, at + length)], found)
    except struct.error as e:
        raise Damaged(f"a record breaks off ({e})") from e


class _Fields:
    """Reads one field of a record after the other."""

    def __init__(self, data: bytes, at: int = 0) -> None:
        self.data, self.at = data, at

    def number(self, code: str) -> int:
        (value,) = struct.unpack_from(code, self.data, self.at)
        self.at += struct.calcsize(code)
        return int(value)

    def text(self, errors: str = "strict") -> str:
        length = self.number("<I")
        value = self.data[self.at : self.at + length]
        if len(value) < length:
            raise Damaged("a text is longer than its record")
        self.at += length
        try:
            return value.decode(errors=errors)
        except UnicodeDecodeError as e:
            raise Damaged("a name is not UTF-8") from e
