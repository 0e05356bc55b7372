"""ROS 1 bags, version 2.0: http://wiki.ros.org/Bags/Format/2.0

Read from front to end, so that a bag whose index was never written, or that was cut short, can be read as well.
"""

import struct
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path
from typing import IO

from calib_toolkit_datasets.bags.index import HEAD, Channel, Damaged, Index, Key
from calib_toolkit_datasets.bags.packing import message, read, size_of, unpack

MAGIC = b"#ROSBAG V2.0\n"
MESSAGE, BAG, INDEX, CHUNK, CONNECTION = 2, 3, 4, 5, 7
INDEXED = 12
"""Bytes by which the index of a chunk tells where one message lies."""
_LENGTH = struct.Struct("<I")
_TIME = struct.Struct("<II")


def scan(path: Path, number: int, index: Index) -> None:
    """Find every message of a file, which is the recording's file of that number, and how many its chunks index.

    Raises Damaged at what stops it.
    """
    size, connections = size_of(path), dict[int, Channel]()
    with path.open("rb") as file:
        if file.read(len(MAGIC)) != MAGIC:
            raise Damaged("it does not begin as a ROS 1 bag of version 2.0 does")
        while (at := file.tell()) < size:
            header = _fields(read(file, _word(file, size), size - file.tell()))
            length, kind = _word(file, size), _kind(header)
            start = file.tell()
            if kind == BAG and header.get("encryptor"):
                raise Damaged("it is encrypted; decrypt it first")
            if kind == CHUNK:
                data = read(file, length, size - start)
                try:
                    _inside(_unpacked(header, data), header, at, start, number, connections, index)
                except Damaged as e:
                    index.notes.append(f"{path.name}: from byte {at} on {e}; the rest of that chunk is left out")
            elif kind in (MESSAGE, CONNECTION):
                data = read(file, length, size - start)
                _one(kind, header, data, (number, 0, start, length), connections, index)
            elif start + length > size:
                raise Damaged(f"it ends at byte {size}, in the middle of a record of {length} bytes")
            elif kind == INDEX:
                index.stated += length // INDEXED
            file.seek(start + length)


def fetch(path: Path, key: Key) -> bytes:
    """The bytes of one message. Raises Damaged or OSError."""
    return message(path, key, _chunk)


@lru_cache(maxsize=2)
def _chunk(path: Path, at: int) -> bytes:
    size = size_of(path)
    with path.open("rb") as file:
        file.seek(at)
        header = _fields(read(file, _word(file, size), size - file.tell()))
        return _unpacked(header, read(file, _word(file, size), size - file.tell()))


def _inside(
    data: bytes,
    header: dict[str, bytes],
    at: int,
    start: int,
    number: int,
    connections: dict[int, Channel],
    index: Index,
) -> None:
    """The records of a chunk that begins at byte ``at`` of the file, and its data at ``start``."""
    plain = header["compression"] == b"none"
    for fields, first, length in _records(data):
        key = (number, 0, start + first, length) if plain else (number, at, first, length)
        _one(_kind(fields), fields, memoryview(data)[first : first + length], key, connections, index)


def _records(data: bytes) -> Iterator[tuple[dict[str, bytes], int, int]]:
    """Header, first byte and length of each record in a chunk."""
    at = 0
    while at < len(data):
        if at + 4 > len(data):
            raise Damaged("it breaks off")
        (length,) = _LENGTH.unpack_from(data, at)
        fields = _fields(data[at + 4 : at + 4 + length])
        at += 4 + length
        if at + 4 > len(data):
            raise Damaged("it breaks off")
        (length,) = _LENGTH.unpack_from(data, at)
        if at + 4 + length > len(data):
            raise Damaged("it breaks off")
        yield fields, at + 4, length
        at += 4 + length


def _one(
    kind: int,
    header: dict[str, bytes],
    data: bytes | memoryview,
    key: Key,
    connections: dict[int, Channel],
    index: Index,
) -> None:
    try:
        if kind == CONNECTION:
            connection = _connection(header, _fields(bytes(data)))
            connections.setdefault(_LENGTH.unpack(header["conn"])[0], connection)
            index.declare(connection)
        elif kind == MESSAGE:
            channel = connections.get(_LENGTH.unpack(header["conn"])[0])
            if channel is None:
                raise Damaged("there is a message of a connection that was not declared")
            seconds, rest = _TIME.unpack(header["time"])
            index.add(channel, seconds * 10**9 + rest, data[:HEAD], key)
    except (KeyError, struct.error, UnicodeDecodeError) as e:
        raise Damaged(f"a record lacks a field or has a wrong one ({e})") from e


def _connection(header: dict[str, bytes], fields: dict[str, bytes]) -> Channel:
    package, _, name = fields["type"].decode().rpartition("/")
    return Channel(
        header["topic"].decode(),
        f"{package}/msg/{name}",
        "ros1",
        fields.get("message_definition", b"").decode(errors="replace"),
    )


def _unpacked(header: dict[str, bytes], data: bytes) -> bytes:
    try:
        return unpack(data, header["compression"].decode(), _LENGTH.unpack(header["size"])[0])
    except (KeyError, struct.error, UnicodeDecodeError) as e:
        raise Damaged(f"a chunk lacks a field or has a wrong one ({e})") from e


def _kind(header: dict[str, bytes]) -> int:
    return header["op"][0] if header.get("op") else -1


def _fields(data: bytes) -> dict[str, bytes]:
    """``name=value`` each, with its length before it."""
    fields, at = {}, 0
    while at < len(data):
        if at + 4 > len(data):
            raise Damaged("the header of a record breaks off")
        (length,) = _LENGTH.unpack_from(data, at)
        name, equals, value = data[at + 4 : at + 4 + length].partition(b"=")
        if not equals or at + 4 + length > len(data):
            raise Damaged("the header of a record makes no sense")
        fields[name.decode(errors="replace")] = value
        at += 4 + length
    return fields


def _word(file: IO[bytes], size: int) -> int:
    return int(_LENGTH.unpack(read(file, 4, size - file.tell()))[0])
