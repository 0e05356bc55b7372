"""What the fields of a cloud mean, by their names: rings, intensities, and times by what they must be."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib_toolkit import Scan
from calib_toolkit.errors import DataError

Array = NDArray[np.float64]
Columns = Mapping[str, NDArray[Any]]
"""Every field of one number by name, (n,)."""

TIMES = (
    *("time", "t", "timestamp", "offset_time", "time_stamp", "time_offset", "timeStamp", "time_us", "time_ns"),
    *("gps_time",),
)
"""What drivers call the time of a point: Velodyne, Ouster, Hesai and RoboSense, Livox, others; LAS."""
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
def to_scan(columns: Columns, timing: Timing | None, ns: int, where: str) -> Scan:
    """One sweep, stamped ``ns``, without its points that are not numbers. Raises DataError if none is left."""
    points = np.stack([columns[c] for c in "xyz"], axis=1).astype(np.float32)
    keep = np.isfinite(points).all(axis=1)
    if not keep.any():
        raise DataError(f"{where} holds no points; leave it out")
    times = None if timing is None else _times(columns, timing, ns, where)
    intensity, ring = (_first(columns, names) for names in (INTENSITIES, RINGS))
    return Scan(
        points[keep],
        None if times is None else times[keep],
        None if intensity is None else intensity[keep].astype(np.float32),
        None if ring is None else ring[keep].astype(np.int32),
    )


@ANY_NUMBER
def told_timing(columns: Columns, ns: int, period: float, name: str) -> tuple[Timing | None, str]:
    """How a driver tells the time of points, and a sentence where that is odd or missing; from one of its sweeps.

    ns: its stamp. period: seconds from one sweep to the next; the unit is that in which a sweep lasts as long.
    name: what the sentence begins with.
    """
    there = [n for n in TIMES if n in columns]
    if not there:
        return None, ""
    raw = columns[there[0]].astype(np.float64)
    raw = raw[np.isfinite(raw) & np.isfinite(columns["x"])]
    if len(raw) < 2:
        return None, f"{name}: the times of its points are not numbers, so scans are not straightened"
    span = float(np.ptp(raw))
    units = [u for u in UNITS if SWEEP[0] * period <= span * u <= SWEEP[1] * period]
    if not units:
        return None, (
            f"{name}: its field '{there[0]}' spans {span:g} a sweep, in no unit of time the {period:.3f} s from one "
            "to the next; scans are not straightened"
        )
    timing = Timing(there[0], units[0], "stamp")
    if np.abs(raw).max() * units[0] <= 2 * SWEEP[1] * period:
        return timing, ""
    timing = replace(timing, since="epoch")
    apart = _stamps(columns[there[0]], timing, ns)
    if np.abs(np.nanmedian(apart)) < APART:
        return timing, ""
    return replace(timing, since="first"), (
        f"{name}: its points' times are {np.nanmedian(apart):+.1f} s from the stamps of its scans, so of another "
        "clock; the stamp is taken to be the time of the first point"
    )


def _times(columns: Columns, timing: Timing, ns: int, where: str) -> NDArray[np.float32]:
    """(n,) seconds from the stamp."""
    if timing.field not in columns:
        raise DataError(f"{where}: its points have no field '{timing.field}' as others of this sensor; leave it out")
    times = _stamps(columns[timing.field], timing, ns)
    if timing.since == "first":
        times = times - np.min(times, initial=np.inf, where=np.isfinite(times))
    return times.astype(np.float32)


def _stamps(raw: NDArray[Any], timing: Timing, ns: int) -> Array:
    """(n,) seconds from the stamp, or from anything where that is what the clock counts from."""
    if timing.since == "stamp":
        return raw.astype(np.float64) * timing.unit
    second, rest = divmod(ns, 10**9)
    whole = raw.astype(np.float64) - round(second / timing.unit)  # first what is large and exact
    return whole * timing.unit - rest * 1e-9


def _first(columns: Columns, names: tuple[str, ...]) -> NDArray[Any] | None:
    there = [n for n in names if n in columns]
    return columns[there[0]] if there else None
