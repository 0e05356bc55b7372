"""PointCloud2: points by the names of their fields, and the time of each by what it must be."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib_toolkit import Scan
from calib_toolkit.errors import DataError
from calib_toolkit_datasets.bags.index import Key, Source
from calib_toolkit_datasets.bags.messages import load, place

Array = NDArray[np.float64]

KIND = "sensor_msgs/msg/PointCloud2"
TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
"""NumPy's names of the message's types of numbers."""
TIMES = ("time", "t", "timestamp", "offset_time", "time_stamp", "time_offset", "timeStamp", "time_us", "time_ns")
"""What drivers call the time of a point: Velodyne, Ouster, Hesai and RoboSense, Livox, others."""
INTENSITIES = ("intensity", "intensities", "reflectivity", "i")
RINGS = ("ring", "channel", "line", "laser_id", "laser")
UNITS = (1.0, 1e-3, 1e-6, 1e-9)
SWEEP = (0.2, 1.5)
"""A sweep lasts from so much to so much of the time from one to the next."""
APART = 1.0
"""Seconds from the stamp beyond which points' times are of another clock."""

ANY_NUMBER = np.errstate(over="ignore", invalid="ignore")
"""What is too large becomes infinite, and what is not finite is dropped."""


@dataclass(frozen=True)
class Timing:
    """What the field of times means. unit: seconds. since: ``stamp`` for an offset from it, ``epoch`` for unix time,
    ``first`` for a clock of its own: then the first point is measured at the stamp.
    """

    field: str
    unit: float
    since: str


@ANY_NUMBER
def load_scan(key: Key, source: Source, topic: str, encoding: str, timing: Timing | None) -> Scan:
    """One sweep without its points that are not numbers. Raises DataError, naming file, topic and place."""
    where = place(key, source, topic)
    message = load(key, source, topic, KIND, encoding)
    columns = _columns(message, where)
    points = np.stack([columns[c] for c in "xyz"], axis=1).astype(np.float32)
    keep = np.isfinite(points).all(axis=1)
    if not keep.any():
        raise DataError(f"{where} holds no points; leave it out")
    times = None if timing is None else _times(columns, timing, message, where)
    intensity, ring = (_first(columns, names) for names in (INTENSITIES, RINGS))
    return Scan(
        points[keep],
        None if times is None else times[keep],
        None if intensity is None else intensity[keep].astype(np.float32),
        None if ring is None else ring[keep].astype(np.int32),
    )


@ANY_NUMBER
def told_timing(key: Key, source: Source, topic: str, encoding: str, period: float) -> tuple[Timing | None, str]:
    """How a driver tells the time of points, and a sentence where that is odd or missing; from one of its sweeps.

    period: seconds from one sweep to the next. The unit is that in which a sweep lasts as long. Raises DataError.
    """
    where = place(key, source, topic)
    message = load(key, source, topic, KIND, encoding)
    columns = _columns(message, where)
    there = [name for name in TIMES if name in columns]
    if not there:
        return None, ""
    raw = columns[there[0]].astype(np.float64)
    raw = raw[np.isfinite(raw) & np.isfinite(columns["x"])]
    if len(raw) < 2:
        return None, f"{topic}: the times of its points are not numbers, so scans are not straightened"
    span = float(np.ptp(raw))
    units = [u for u in UNITS if SWEEP[0] * period <= span * u <= SWEEP[1] * period]
    if not units:
        return None, (
            f"{topic}: its field '{there[0]}' spans {span:g} a sweep, in no unit of time the {period:.3f} s from one "
            "to the next; scans are not straightened"
        )
    timing = Timing(there[0], units[0], "stamp")
    if np.abs(raw).max() * units[0] <= 2 * SWEEP[1] * period:
        return timing, ""
    timing = replace(timing, since="epoch")
    apart = _stamps(columns[there[0]], timing, message)
    if np.abs(np.nanmedian(apart)) < APART:
        return timing, ""
    return replace(timing, since="first"), (
        f"{topic}: its points' times are {np.nanmedian(apart):+.1f} s from the stamps of its scans, so of another "
        "clock; the stamp is taken to be the time of the first point"
    )


def to_message(scan: Scan, header: Any, types: Any) -> Any:
    """A cloud with x, y, z and, as far as the scan has them, intensity, ring and time (seconds from the stamp)."""
    fields: list[tuple[str, str, NDArray[Any]]] = [
        ("x", "<f4", scan.points[:, 0]),
        ("y", "<f4", scan.points[:, 1]),
        ("z", "<f4", scan.points[:, 2]),
    ]
    if scan.intensity is not None:
        fields.append(("intensity", "<f4", scan.intensity))
    if scan.ring is not None:
        fields.append(("ring", "<u2", scan.ring))
    if scan.times is not None:
        fields.append(("time", "<f4", scan.times))
    table = np.empty(len(scan.points), dtype=[(name, kind) for name, kind, _ in fields])
    for name, _, values in fields:
        table[name] = values
    numbers = {f"<{kind}": number for number, kind in TYPES.items()}
    described = [
        types["sensor_msgs/msg/PointField"](name, table.dtype.fields[name][1], numbers[kind], 1)  # type: ignore[index]
        for name, kind, _ in fields
    ]
    size, data = table.dtype.itemsize, np.frombuffer(table.tobytes(), dtype=np.uint8)
    return types[KIND](header, 1, len(table), described, False, size, size * len(table), data, True)


def _columns(message: Any, where: str) -> dict[str, NDArray[Any]]:
    """Every field of one number by name, (n,). Raises DataError for a layout that does not fit the data."""
    step, row, width, height = message.point_step, message.row_step, message.width, message.height
    names, formats, offsets = [], [], []
    order = ">" if message.is_bigendian else "<"
    for field in message.fields:
        kind = TYPES.get(field.datatype)
        if kind is None or field.offset + int(kind[1]) > step:
            raise DataError(
                f"{where}: its field '{field.name}' has no known type or lies beyond the point; leave it out"
            )
        if field.count <= 1 and field.name not in names:
            names.append(field.name)
            formats.append(order + kind)
            offsets.append(field.offset)
    missing = [c for c in "xyz" if c not in names or formats[names.index(c)][1] != "f"]
    if missing:
        raise DataError(f"{where}: its points have no field '{missing[0]}' that is a float; name another topic")
    if row < width * step or len(message.data) < row * height or not step:
        raise DataError(
            f"{where} says it has {height} rows of {row} bytes with {width} points of {step}, and holds "
            f"{len(message.data)} bytes; leave it out"
        )
    layout = np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": step})
    rows = np.asarray(message.data, dtype=np.uint8)[: row * height].reshape(height, row)[:, : width * step]
    table = np.ascontiguousarray(rows).view(layout).ravel()
    return {name: table[name] for name in names}


def _times(columns: dict[str, NDArray[Any]], timing: Timing, message: Any, where: str) -> NDArray[np.float32]:
    """(n,) seconds from the stamp."""
    if timing.field not in columns:
        raise DataError(f"{where}: its points have no field '{timing.field}' as others of this topic; leave it out")
    times = _stamps(columns[timing.field], timing, message)
    if timing.since == "first":
        times = times - np.min(times, initial=np.inf, where=np.isfinite(times))
    return times.astype(np.float32)


def _stamps(raw: NDArray[Any], timing: Timing, message: Any) -> Array:
    """(n,) seconds from the stamp, or from anything where that is what the clock counts from."""
    if timing.since == "stamp":
        return raw.astype(np.float64) * timing.unit
    stamp = message.header.stamp
    whole = raw.astype(np.float64) - round(stamp.sec / timing.unit)  # first what is large and exact
    return whole * timing.unit - stamp.nanosec * 1e-9


def _first(columns: dict[str, NDArray[Any]], names: tuple[str, ...]) -> NDArray[Any] | None:
    there = [n for n in names if n in columns]
    return columns[there[0]] if there else None
