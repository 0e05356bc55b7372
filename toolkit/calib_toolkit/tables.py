"""Tables in text: keys and paths of a rig.toml, rows of numbers, stamps to the nanosecond."""

import re
from bisect import bisect_left
from collections.abc import Callable, Collection, Sequence
from decimal import Decimal
from os import SEEK_END
from os.path import expanduser
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from calib_toolkit.errors import DataError
from calib_toolkit.hookspecs import SensorTable

Array = NDArray[np.float64]
Nanoseconds = NDArray[np.int64]

BLANK = int(np.iinfo(np.int64).min)
"""The stamp of a row that holds none."""
DATE = re.compile(r"(\d{4}-\d\d-\d\d)[ T](\d\d:\d\d:\d\d)(\.\d{1,9})?", re.ASCII)  # as KITTI writes stamps
LATEST = 9 * 10**9  # seconds of unix time (the year 2255); a stamp beyond is in another unit


class Row(NamedTuple):
    """One row of a text table, and where it is. cut: it is the last and has too few columns; its words are empty."""

    file: Path
    line: int
    words: list[str]
    cut: bool = False

    @property
    def place(self) -> str:
        """File and line, as sentences begin with them."""
        return f"{self.file}, line {self.line}"


def refuse_unknown(table: SensorTable, known: Collection[str]) -> None:
    """Raises DataError for a key that such a table does not have: a misspelt one would be ignored in silence."""
    for key in table.values:
        if key not in known and key != "kind":
            raise DataError(
                f"sensor {table.name} has the key '{key}', which is unknown here; it may have {', '.join(known)}"
            )


def table_file(table: SensorTable, key: str) -> Path:
    """The file that a key names, from the folder of the rig.toml; ``~`` is the home folder. Raises DataError."""
    return _path(table, key, "file", Path.is_file)


def table_folder(table: SensorTable, key: str) -> Path:
    """The folder that a key names, as :func:`table_file` finds a file. Raises DataError."""
    return _path(table, key, "folder", Path.is_dir)


def read_rows(file: Path, fewest: int, most: int, titles: bool = False) -> list[Row]:
    """Rows of fewest to most columns parted by commas or blanks, without empty lines and # comments.

    titles: the first row is one of titles, and others must follow. A last row that has fewer columns than the one
    before it was cut short, and is marked so. Raises DataError.
    """
    kept = [(k, text) for k, line in enumerate(_lines(file), 1) if (text := line.partition("#")[0].strip())]
    rows = [Row(file, k, [w.strip() for w in t.split(",")] if "," in t else t.split()) for k, t in kept]
    if len(rows) > 1 + titles and len(rows[-1].words) < (columns := len(rows[-2].words)):
        rows[-1] = rows[-1]._replace(words=[""] * columns, cut=True)
    for row in rows:
        if not fewest <= len(row.words) <= most:
            wanted = f"{fewest}" if fewest == most else f"{fewest} to {most}"
            raise DataError(f"{row.place}: {len(row.words)} columns where {wanted} belong; correct or remove it")
    if len(rows) <= titles:
        raise DataError(f"{file} holds no rows{' below its titles' if rows else ''}; name a file that does")
    return rows


def to_numbers(rows: Sequence[Row], columns: int) -> Array:
    """(n, columns) what is written in the first columns of rows, nan where nothing is. Raises DataError."""
    numbers = np.empty((len(rows), columns))
    for k, row in enumerate(rows):
        try:
            numbers[k] = [float(row.words[j] or "nan") for j in range(columns)]
        except ValueError as e:
            raise DataError(f"{row.place}: {e}; the first {columns} columns must hold numbers") from e
    return numbers


def to_nanoseconds(rows: Sequence[Row], unit: str = "1") -> Nanoseconds:
    """(n,) exact stamps of the first column, dates or in ``unit`` seconds; ``BLANK`` for nan. Raises DataError."""
    return np.array([_stamp(r.words[0], unit, r.place, "correct or remove the row") for r in rows], dtype=np.int64)


def read_stamps(file: Path) -> Nanoseconds:
    """(lines,) stamps of a file, one a line, dates or seconds; ``BLANK`` where a line is empty. Raises DataError."""
    remedy = "write seconds or YYYY-MM-DD hh:mm:ss, or empty the line if there is none"
    lines = enumerate(_lines(file), 1)
    return np.array([_stamp(text, "1", f"{file}, line {k}", remedy) for k, text in lines], dtype=np.int64)


def whole_rows(rows: Sequence[Row]) -> tuple[list[Row], tuple[str, ...]]:
    """The rows without a last one that was cut short, and the sentence on it. Raises DataError if none is left."""
    if not rows or not rows[-1].cut:
        return list(rows), ()
    note = f"{rows[-1].place} has fewer columns than the line before it, as if the file had been cut short; left out"
    if len(rows) == 1:
        raise DataError(f"{note}, and nothing else is there; write the file anew")
    return list(rows[:-1]), (note,)


def unfinished(file: Path) -> tuple[str, ...]:
    """A sentence if the last line of a file has no end: what programs write has one, unless it was cut short."""
    with file.open("rb") as content:
        content.seek(-1, SEEK_END)
        ended = content.read() == b"\n"
    return () if ended else (f"{file} ends in the middle of a line, as if cut short; its last number may be wrong",)


def usable_rows(ns: Nanoseconds, numbers: Array, rows: Sequence[Row]) -> tuple[NDArray[np.int64], tuple[str, ...]]:
    """Indices of the rows that are whole and whose stamps increase, and sentences on those left out.

    ns: (n,). numbers: (n, m). Raises DataError if fewer than two of the rows are left, or fewer than half.
    """
    _, cut = whole_rows(rows)
    whole = (ns != BLANK) & np.isfinite(numbers).all(axis=1)
    index = np.flatnonzero(whole)
    rising = increasing(ns[index])
    keep = index[rising]
    late = "have a stamp that goes back or repeats"
    hollow = ~whole & [not row.cut for row in rows]
    unusable = {"hold nan or nothing": np.flatnonzero(hollow), late: index[~rising]}
    notes = cut + tuple(
        f"{rows[0].file}: {len(which)} of {len(rows)} rows {what}, the first in line {rows[which[0]].line}; left out"
        for what, which in unusable.items()
        if len(which)
    )
    if len(keep) < max(2, len(rows) / 2):
        raise DataError(" and ".join(notes) or f"{rows[0].file} has one row; a motion takes two")
    return keep, notes


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


def seconds(ns: Nanoseconds, epoch_ns: int) -> Array:
    """Seconds since the epoch, subtracted as integers so that no nanosecond is lost. (n,) without BLANK -> (n,)."""
    return (ns - epoch_ns) / 1e9


def _path(table: SensorTable, key: str, what: str, exists: Callable[[Path], bool]) -> Path:
    value = table.values.get(key)
    if not isinstance(value, str):
        raise DataError(f'sensor {table.name} needs {key} = "{what.upper()}", a path in quotes')
    path = table.folder / expanduser(value)
    try:
        found = exists(path)
    except OSError:  # of names that are too long
        found = False
    if not found:
        raise DataError(f"sensor {table.name}: {key} = {value!r}, but there is no {what} {path}; correct the path")
    return path


def _lines(file: Path) -> list[str]:
    try:
        return [line.strip() for line in file.read_text(encoding="utf-8-sig").rstrip().splitlines()]
    except (OSError, UnicodeDecodeError) as e:
        raise DataError(f"{file} can not be read as text ({type(e).__name__}); name a text file") from e


def _stamp(text: str, unit: str, place: str, remedy: str) -> int:
    """Exact nanoseconds of a date, or of a number of ``unit`` seconds."""
    try:
        if date := DATE.fullmatch(text):
            stamp = int(np.datetime64(f"{date[1]}T{date[2]}", "s").astype(np.int64)) + Decimal(date[3] or 0)
        else:
            stamp = Decimal(text or "nan") * Decimal(unit)
    except (ValueError, ArithmeticError) as e:
        raise DataError(f"{place}: '{text}' is not a stamp; {remedy}") from e
    if not stamp.is_finite():
        return BLANK
    if abs(stamp) > LATEST:
        raise DataError(f"{place}: the stamp {text} is beyond any clock; convert it to the right unit")
    return round(stamp * 10**9)
