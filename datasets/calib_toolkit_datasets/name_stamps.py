"""Stamps of readings that are one file each: in the names of the files, or in a list beside them."""

import re
from collections.abc import Sequence
from decimal import Decimal
from pathlib import Path

import numpy as np

from calib_toolkit import tables
from calib_toolkit.errors import DataError
from calib_toolkit_datasets import stamps

LISTS = ("times.txt", "timestamps.txt")
EARLIEST, LATEST = 5 * 10**8, 5 * 10**9
"""Seconds of unix time (1985 to 2128); a whole number in a name is in the unit in which it lies between."""
UNITS_NS = (10**9, 10**6, 10**3, 1)


def stamped(
    name: str, files: Sequence[Path], *folders: Path
) -> tuple[tables.Nanoseconds, list[Path], tuple[str, ...]]:
    """Increasing stamps (n,) in nanoseconds, the file of each, and sentences on what was left out.

    files: in the order of their numbers. folders: where a list of stamps may lie. Raises DataError.
    """
    lists = [folder / file for folder in folders for file in LISTS if (folder / file).is_file()]
    if not lists:
        files = sorted(files, key=lambda f: _of_name(name, f))
        ns = np.array([_of_name(name, f) for f in files], dtype=np.int64)
        notes: tuple[str, ...] = ()
    else:
        ns, files, notes = _of_list(name, files, lists[0])
    rising = tables.increasing(ns)
    if not rising.all():
        notes += (f"{name}: {np.sum(~rising)} of {len(ns)} readings whose stamps repeat or go back are left out",)
    if rising.sum() < 2:
        raise DataError(f"sensor {name} has {rising.sum()} files with a stamp of their own; a motion takes two")
    return ns[rising], [f for f, keep in zip(files, rising, strict=True) if keep], notes


def natural(file: Path) -> tuple[tuple[int, str], ...]:
    """Key that sorts names by the numbers in them: 9 comes before 10."""
    return tuple((int(d), "") if d else (-1, t) for t, d in re.findall(r"([^0-9]+)|([0-9]{1,30})", file.name))


def _of_name(name: str, file: Path) -> int:
    """A number with a point is seconds; a whole one is seconds, milli-, micro- or nanoseconds of unix time."""
    text = file.stem.removesuffix(".pcd")
    match = re.fullmatch(r"[^0-9]*([0-9]{1,12}\.[0-9]+|[0-9]{1,20})", text)
    if match and "." in match[1]:
        return round(Decimal(match[1]) * 10**9)
    whole = int(match[1]) if match else 0
    units = [u for u in UNITS_NS if EARLIEST * 10**9 <= whole * u < LATEST * 10**9]
    if not units:
        raise DataError(
            f"sensor {name}: the name of {file} is no stamp in seconds or a part of them; write {LISTS[0]} beside "
            "it, with the stamp of each file in a line, in the order of their numbers"
        )
    return whole * units[0]


def _of_list(
    name: str, files: Sequence[Path], file: Path
) -> tuple[tables.Nanoseconds, Sequence[Path], tuple[str, ...]]:
    """One line a file, or else a line for each number that a file could have, counted from 0."""
    ns = _lines(file)
    if len(ns) == len(files) and tables.BLANK not in ns:
        return ns, files, ()
    numbers = [int(f.stem) for f in files if re.fullmatch("[0-9]{1,10}", f.stem)]
    if len(set(numbers)) < len(files) or max(numbers, default=-1) >= len(ns):
        raise DataError(
            f"sensor {name}: {file} has {len(ns)} stamps for {len(files)} files, so it is not known which belong "
            "together; write one a line for each file"
        )
    matched = stamps.match(name, dict(zip(numbers, files, strict=True)), ns)
    return matched.ns, matched.files, matched.notes


def _lines(file: Path) -> tables.Nanoseconds:
    """Seconds or dates, or whole nanoseconds."""
    rows = tables.read_rows(file, 1, 2)
    if all(re.fullmatch("[0-9]{18,19}", row.words[0]) for row in rows):
        return tables.to_nanoseconds(rows, "1e-9")
    return tables.read_stamps(file)
