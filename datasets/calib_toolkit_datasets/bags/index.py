"""Where every message of a recording lies: what one pass over its files leaves in memory."""

import struct
from array import array
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calib_toolkit import tables
from calib_toolkit.errors import DataError

Key = tuple[int, int, int, int]
"""Of a message: number of the file, place of its chunk (0: none), place in it, bytes."""

LARGEST = 2**30
"""Bytes of a message or a chunk that are held in memory; more is a damaged length."""
COLUMNS = 6
"""Numbers that are kept of each message: when it was received, its stamp, and a ``Key``."""
HEAD = 12
"""Bytes of a message in which the stamp of its header lies."""
STAMPED = frozenset(
    f"{package}/msg/{name}"
    for package, names in {
        "sensor_msgs": ("PointCloud2", "Image", "CompressedImage", "CameraInfo", "NavSatFix", "Imu"),
        "nav_msgs": ("Odometry",),
        "geometry_msgs": ("PoseStamped", "PoseWithCovarianceStamped"),
    }.items()
    for name in names
)
"""Types of messages that are read and begin with a header."""


MOST_NOTES = 5
"""Sentences on damage that are kept; the others are counted."""


class Damaged(Exception):
    """A part of a file is not what it must be; the sentence says what, and where."""


@dataclass(frozen=True)
class Channel:
    """A topic as one file declares it. type: as ROS 2 writes it. encoding: ``ros1`` or ``cdr`` are read.

    definition: text of the message's definition, "" if there is none. idl: whether that is IDL.
    """

    topic: str
    type: str
    encoding: str
    definition: str = ""
    idl: bool = False


@dataclass(frozen=True)
class Recorded:
    """All messages of a topic. received: (n,) and stamps: (n,) nanoseconds, ``BLANK`` where a header has none.

    keys: (n, 4), a ``Key`` in each row. encodings: of the channels, usually one.
    """

    channel: Channel
    received: tables.Nanoseconds
    stamps: tables.Nanoseconds
    keys: NDArray[np.int64]


@dataclass(frozen=True)
class Source:
    """The files of a recording, and how they are read: ``bag1``, ``mcap`` or ``sqlite``."""

    files: tuple[Path, ...]
    storage: str


@dataclass(frozen=True)
class Bag:
    """A recording whose messages have been found. notes: what was wrong with the files."""

    source: Source
    topics: Mapping[str, Recorded]
    notes: tuple[str, ...]


@dataclass
class Index:
    """Messages as they are found.

    clashes: topics that have messages of two types. stated: how many messages the file being read says it holds.
    """

    channels: dict[str, Channel] = field(default_factory=dict)
    rows: dict[str, "array[int]"] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    clashes: set[str] = field(default_factory=set)
    stated: int = 0

    @property
    def found(self) -> int:
        """How many messages there are so far."""
        return sum(map(len, self.rows.values())) // COLUMNS

    def add(self, channel: Channel, received: int, head: bytes | memoryview, key: Key) -> None:
        """A message of at least ``HEAD`` first bytes, if it is so long."""
        known = self.channels.setdefault(channel.topic, channel)
        if known is not channel and (known.type, known.encoding) != (channel.type, channel.encoding):
            self.clashes.add(channel.topic)
        stamp = header_stamp(head, channel.encoding) if channel.type in STAMPED else tables.BLANK
        rows = self.rows.get(channel.topic)
        if rows is None:
            rows = self.rows[channel.topic] = array("q")
        rows.extend((min(received, 2**63 - 1), stamp, *key))

    def declare(self, channel: Channel) -> None:
        """A topic that may have no messages."""
        self.channels.setdefault(channel.topic, channel)

    def bag(self, source: Source) -> Bag:
        """What was found. Raises DataError if there is no topic."""
        if not self.channels:
            why = f" ({'; '.join(self.notes[:MOST_NOTES])})" if self.notes else ""
            raise DataError(f"{source.files[0]} holds no topic that could be read{why}; record or copy it again")
        topics = {}
        for name, channel in self.channels.items():
            rows = np.array(self.rows.get(name, ()), dtype=np.int64).reshape(-1, COLUMNS)
            rows = rows[np.argsort(rows[:, 0], kind="stable")]
            if name in self.clashes:
                channel = Channel(name, "messages of several types", "")
            topics[name] = Recorded(channel, rows[:, 0], rows[:, 1], rows[:, 2:])
        more = len(self.notes) - MOST_NOTES
        notes = [*self.notes[:MOST_NOTES], *([f"{more} more parts of it are damaged"] if more > 0 else [])]
        return Bag(source, topics, tuple(notes))


def header_stamp(head: bytes | memoryview, encoding: str) -> int:
    """Nanoseconds of the stamp that a message begins with; ``BLANK`` for none, zero, or what no clock says.

    ROS 1 puts a counter before it, CDR four bytes that tell the order of bytes.
    """
    if len(head) < HEAD:
        return tables.BLANK
    big = encoding == "cdr" and head[1] == 0
    seconds, rest = struct.unpack_from(">II" if big else "<II", head, 4)
    if rest >= 10**9 or (seconds == 0 and rest == 0) or seconds >= 2**31:
        return tables.BLANK
    return int(seconds * 10**9 + rest)
