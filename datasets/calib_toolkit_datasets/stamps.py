"""Stamps of numbered readings, matched to their files by number."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calib_toolkit import tables


@dataclass(frozen=True)
class Matched:
    """Readings that have a file and a usable stamp.

    numbers: the files' numbers, (n,). ns: (n,) int64 unix nanoseconds, increasing.
    files: one for each number. notes: a sentence for every kind of reading that was dropped.
    """

    numbers: NDArray[np.int64]
    ns: tables.Nanoseconds
    files: tuple[Path, ...]
    notes: tuple[str, ...]


def match(sensor: str, files: Mapping[int, Path], stamps: tables.Nanoseconds) -> Matched:
    """Files and stamps brought together by number: file ``0000000012.ext`` belongs to line 12, counted from 0.

    A missing file shifts nothing. Readings without a stamp, and the fewest readings whose stamps repeat or
    go back, are dropped and noted.
    """
    numbers = np.array(sorted(files), dtype=np.int64)
    stamped = np.zeros(len(numbers), dtype=bool)
    within = numbers < len(stamps)
    stamped[within] = stamps[numbers[within]] != tables.BLANK
    lines = np.flatnonzero(stamps != tables.BLANK)
    between = np.arange(*_span(numbers[within]))
    notes = _note(sensor, "file(s) missing", np.setdiff1d(np.union1d(lines, between), numbers)) + _note(
        sensor, "reading(s) dropped because they have no stamp", numbers[~stamped]
    )
    numbers = numbers[stamped]
    keep = tables.increasing(stamps[numbers])
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


def spaced(ns: tables.Nanoseconds, least_ns: int) -> NDArray[np.int64]:
    """Indices of stamps that increase, from the first on, each at least so long after the one kept before. (n,)."""
    kept = [0] if len(ns) else []
    for k in range(1, len(ns)):
        if ns[k] - ns[kept[-1]] >= least_ns:
            kept.append(k)
    return np.array(kept, dtype=np.int64)


def _span(numbers: NDArray[np.int64]) -> tuple[int, int]:
    return (int(numbers[0]), int(numbers[-1]) + 1) if len(numbers) else (0, 0)


def _note(sensor: str, what: str, numbers: NDArray[np.int64]) -> tuple[str, ...]:
    if not len(numbers):
        return ()
    return (f"{sensor}: {len(numbers)} {what}, the first is number {numbers[0]}",)
