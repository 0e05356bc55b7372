"""Topics as sensors: which of them are, what they are called, and whose stamps are odd."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calib_toolkit import Calibration, Dataset, Log, ReadContext, Stream, hookimpl, tables
from calib_toolkit.errors import DataError
from calib_toolkit.types import Topic
from calib_toolkit_datasets.bags import clocks, containers, frames, messages, sensors
from calib_toolkit_datasets.bags.index import Bag, Recorded
from calib_toolkit_datasets.bags.writing import write_bag1, write_bag2, write_mcap

GENERIC = frozenset(
    (
        *("image", "image_raw", "image_color", "image_mono", "image_rect", "image_rect_color", "compressed"),
        *("points", "points_raw", "point_cloud", "pointcloud", "cloud", "fix", "navsat", "imu", "odom", "odometry"),
        *("pose", "data", "raw"),
    )
)
"""Last parts of topics that tell what they are and not whose."""
MOST_TOPICS = 20
"""Topics that a sentence names."""


@hookimpl
def calib_register_datasets() -> list[Dataset]:
    """The readers ``rosbag1``, ``rosbag2`` and ``mcap``."""
    return [
        Dataset("rosbag1", "a ROS 1 bag", containers.is_bag1, open_bag1, write_bag1),
        Dataset("rosbag2", "the folder of a ROS 2 bag, or its .db3", containers.is_bag2, open_bag2, write_bag2),
        Dataset("mcap", "an MCAP file", containers.is_mcap, open_mcap, write_mcap),
    ]


def open_bag1(path: Path, context: ReadContext) -> Log:
    """The sensors of a ROS 1 bag. Raises DataError."""
    return to_log(path, containers.open_bag1(path))


def open_bag2(path: Path, context: ReadContext) -> Log:
    """The sensors of a ROS 2 bag. Raises DataError."""
    return to_log(path, containers.open_bag2(path))


def open_mcap(path: Path, context: ReadContext) -> Log:
    """The sensors of an MCAP file. Raises DataError."""
    return to_log(path, containers.open_mcap(path))


def to_log(path: Path, bag: Bag) -> Log:
    """A stream for each topic that a sensor reads, on the clock of the messages' headers."""
    why = {name: messages.unreadable(r.channel) for name, r in bag.topics.items()}
    usable = {name: clocks.usable_stamps(name, r) for name, r in bag.topics.items() if not why[name]}
    why |= {name: u.reason for name, u in usable.items() if u.reason}
    clean = {name: u for name, u in usable.items() if not u.reason}
    shifts = clocks.shifts({n: u for n, u in clean.items() if u.recorded.channel.type in sensors.KINDS})
    clean = {n: replace(u, ns=u.ns + shifts.get(n, 0)) for n, u in clean.items()}
    made = sensors.streams(bag, clean, why)
    if not made:
        raise DataError(_nothing(path, bag, why))
    names = _names(list(made))
    epoch_ns = min(int(m.ns[0]) for m in made.values())
    streams = {}
    for topic, m in made.items():
        clock = f"the trigger of {names[m.clock]}" if m.clock else ""
        streams[names[topic]] = Stream(
            names[topic],
            m.kind,
            tables.seconds(m.ns, epoch_ns),
            m.readings,
            m.intrinsics,
            m.has_scale,
            clock,
            notes=(*(n for t in m.topics for n in usable[t].notes), *clocks.shifted(topic, shifts), *m.notes),
            topic=topic,
        )
    notes, reference = list(bag.notes), None
    try:
        reference = _reference(bag, {names[t]: m.frame for t, m in made.items()}, streams)
    except DataError as e:
        notes.append(f"its transforms are not used as a reference: {e}")
    used = {t: names[topic] for topic, m in made.items() for t in m.topics}
    listed = tuple(
        Topic(name, r.channel.type, len(r.keys), _rate(r), used.get(name, ""), "" if name in used else why[name])
        for name, r in sorted(bag.topics.items())
    )
    return Log(path, streams, epoch_ns, reference, tuple(notes), listed)


def _nothing(path: Path, bag: Bag, why: Mapping[str, str]) -> str:
    """What there is instead of sensors, and what would be read."""
    there = [f"{name} ({messages.spoken(r.channel.type)}): {why[name]}" for name, r in sorted(bag.topics.items())]
    more = [f"and {len(there) - MOST_TOPICS} topics more"] if len(there) > MOST_TOPICS else []
    read = ", ".join(sorted(map(messages.spoken, sensors.KINDS)))
    return (
        f"{path} holds no topic that a sensor reads: {'; '.join([*bag.notes, *there[:MOST_TOPICS], *more])}; what is "
        f"read are {read}: name a recording with some of them"
    )


def _names(topics: list[str]) -> dict[str, str]:
    """A short name for each topic, the same for none."""
    short = {}
    for topic in topics:
        parts = [p for p in topic.split("/") if p] or ["topic"]
        while len(parts) > 1 and parts[-1] in GENERIC:
            parts.pop()
        short[topic] = "_".join(parts).replace(",", "_").replace("=", "_").replace(".", "_")
    for topic, name in short.items():
        if list(short.values()).count(name) > 1:
            short[topic] = "_".join(p for p in topic.split("/") if p).replace(",", "_").replace("=", "_")
    taken: dict[str, str] = {}
    for topic, name in short.items():
        while name in taken.values():
            name += "_"
        taken[topic] = name
    return taken


def _reference(bag: Bag, frame_of: Mapping[str, str], streams: Mapping[str, Stream]) -> Calibration | None:
    """What /tf_static says of the sensors' frames."""
    found: dict[tuple[str, str], NDArray[np.float64]] = {}
    for name, r in bag.topics.items():
        if r.channel.type not in messages.FRAMES or not name.endswith("tf_static") or messages.unreadable(r.channel):
            continue
        loaded = [
            messages.load(tuple(k), bag.source, name, r.channel.type, r.channel.encoding) for k in r.keys.tolist()
        ]
        found |= frames.edges(loaded, f"{bag.source.files[0]}: {name}")
    frame_of = {n: f.lstrip("/") for n, f in frame_of.items() if f}
    return frames.reference(found, frame_of, {n: s.has_scale for n, s in streams.items()})


def _rate(recorded: Recorded) -> float:
    received = recorded.received
    return 1e9 * (len(received) - 1) / max(int(received[-1] - received[0]), 1) if len(received) > 1 else float("nan")
