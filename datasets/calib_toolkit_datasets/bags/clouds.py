"""PointCloud2: points by the names of their fields, and the time of each by what it must be."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib_toolkit import Scan
from calib_toolkit.errors import DataError
from calib_toolkit_datasets import point_fields
from calib_toolkit_datasets.bags.index import Key, Source
from calib_toolkit_datasets.bags.messages import load, place
from calib_toolkit_datasets.point_fields import Timing, to_scan

KIND = "sensor_msgs/msg/PointCloud2"
TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
"""NumPy's names of the message's types of numbers."""


def load_scan(key: Key, source: Source, topic: str, encoding: str, timing: Timing | None) -> Scan:
    """One sweep without its points that are not numbers. Raises DataError, naming file, topic and place."""
    where = place(key, source, topic)
    message = load(key, source, topic, KIND, encoding)
    return to_scan(_columns(message, where), timing, _ns(message), where)


def told_timing(key: Key, source: Source, topic: str, encoding: str, period: float) -> tuple[Timing | None, str]:
    """How a driver tells the time of points, and a sentence where that is odd or missing; from one of its sweeps.

    period: seconds from one sweep to the next. Raises DataError.
    """
    message = load(key, source, topic, KIND, encoding)
    columns = _columns(message, place(key, source, topic))
    return point_fields.told_timing(columns, _ns(message), period, topic)


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
    sizes = np.array([np.dtype(kind).itemsize for _, kind, _ in fields])
    described = [
        types["sensor_msgs/msg/PointField"](name, offset, numbers[kind], 1)
        for (name, kind, _), offset in zip(fields, (np.cumsum(sizes) - sizes).tolist(), strict=True)
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


def _ns(message: Any) -> int:
    return int(message.header.stamp.sec * 10**9 + message.header.stamp.nanosec)
