"""Stamps of numbered readings: read to the nanosecond, matched to files by number, made to increase."""

import re
from bisect import bisect_left
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calib_toolkit.errors import DataError

Nanoseconds = NDArray[np.int64]

BLANK = int(np.iinfo(np.int64).min)
"""The stamp of a line that holds none."""

_STAMP = re.compile(r"\d{4}-\d\d-\d\d[ T]\d\d:\d\d:\d\d(\.\d{1,9})?")


@dataclass(frozen=True)
class Matched:
    """Readings that have a file and a usable stamp.

    numbers: the files' numbers, (n,). ns: (n,) int64 unix nanoseconds, increasing.
    files: one for each number. notes: a sentence for every kind of reading that was dropped.
    """

    numbers: NDArray[np.int64]
    ns: Nanoseconds
    files: tuple[Path, ...]
    notes: tuple[str, ...]


def read_stamps(file: Path) -> Nanoseconds:
    """Unix nanoseconds of ``2011-09-26 13:02:25.964389445``, one a line, ``BLANK`` where the line is empty.

    Raises DataError, naming the line, for anything else.
    """
    try:
        lines = [line.strip() for line in file.read_text(encoding="ascii").splitlines()]
    except (OSError, UnicodeDecodeError) as e:
        raise DataError(f"{file}: the stamps can not be read ({type(e).__name__}); fetch the file again") from e
    bad = next((k for k, line in enumerate(lines) if line and not _STAMP.fullmatch(line)), None)
    if bad is not None:
        raise DataError(
            f"{file}: line {bad + 1} is not a stamp of the form 2011-09-26 13:02:25.964389445 ('{lines[bad]}'); "
            "mend that line, or empty it to drop the reading"
        )
    try:
        return np.array(lines, dtype="datetime64[ns]").astype(np.int64)
    except ValueError as e:
        raise DataError(f"{file}: a stamp names no date that exists ({e}); mend it, or empty its line") from e


def match(sensor: str, files: Mapping[int, Path], stamps: Nanoseconds) -> Matched:
    """Files and stamps brought together by number: file ``0000000012.ext`` belongs to line 12, counted from 0.

    A missing file shifts nothing. Readings without a stamp, and the fewest readings whose stamps repeat or
    go back, are dropped and noted.
    """
    numbers = np.array(sorted(files), dtype=np.int64)
    stamped = np.zeros(len(numbers), dtype=bool)
    within = numbers < len(stamps)
    stamped[within] = stamps[numbers[within]] != BLANK
    lines = np.flatnonzero(stamps != BLANK)
    between = np.arange(*_span(numbers[within]))
    notes = _note(sensor, "file(s) missing", np.setdiff1d(np.union1d(lines, between), numbers)) + _note(
        sensor, "reading(s) dropped because they have no stamp", numbers[~stamped]
    )
    numbers = numbers[stamped]
    keep = increasing(stamps[numbers])
    notes += _note(sensor, "reading(s) dropped because their stamps repeat or go back", numbers[~keep])
    numbers = numbers[keep]
    return Matched(numbers, stamps[numbers], tuple(files[int(n)] for n in numbers), notes)


def made_up(sensor: str, files: Mapping[int, Path], period_ns: int) -> Matched:
    """Files without stamps: their number times a period stands in, so that a missing file shifts nothing."""
    numbers = np.array(sorted(files), dtype=np.int64)
    jumps = np.flatnonzero(np.diff(numbers) > 1)
    notes = [f"{sensor}: files are missing, the first is number {numbers[jumps[0]] + 1}"] if len(jumps) else []
    notes.append(
        f"{sensor}: there are no stamps, so frame numbers times {period_ns / 1e9} s stand in for them: "
        "a clock offset found here is relative to equal frame numbers"
    )
    return Matched(numbers, numbers * period_ns, tuple(files[int(n)] for n in numbers), tuple(notes))


def increasing(ns: Nanoseconds) -> NDArray[np.bool_]:
    """Which readings to keep so that stamps increase strictly and the fewest are dropped. (n,) -> (n,).

    The longest increasing subsequence: one stamp that leaps ahead costs itself, not everything after it.
    Walked from the end, so that of two equally good choices the earlier reading stays.
    """
    if np.all(np.diff(ns) > 0):
        return np.ones(len(ns), dtype=bool)
    backwards = [-int(x) for x in ns[::-1]]
    tails: list[int] = []  # lowest last value of an increasing run of each length, and where it is
    ends: list[int] = []
    before = [-1] * len(backwards)
    for k, value in enumerate(backwards):
        length = bisect_left(tails, value)
        before[k] = ends[length - 1] if length else -1
        tails[length : length + 1] = [value]
        ends[length : length + 1] = [k]
    keep = np.zeros(len(ns), dtype=bool)
    k = ends[-1]
    while k >= 0:
        keep[len(ns) - 1 - k] = True
        k = before[k]
    return keep


def seconds(ns: Nanoseconds, epoch_ns: int) -> NDArray[np.float64]:
    """Seconds since the epoch, subtracted as integers so that no nanosecond is lost."""
    return (ns - epoch_ns) / 1e9


def _span(numbers: NDArray[np.int64]) -> tuple[int, int]:
    return (int(numbers[0]), int(numbers[-1]) + 1) if len(numbers) else (0, 0)


def _note(sensor: str, what: str, numbers: NDArray[np.int64]) -> tuple[str, ...]:
    if not len(numbers):
        return ()
    return (f"{sensor}: {len(numbers)} {what}, the first is number {numbers[0]}",)
