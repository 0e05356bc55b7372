"""Which stamps can be used, and whose clock is far from the others'."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib_toolkit import tables
from calib_toolkit_datasets.bags import messages
from calib_toolkit_datasets.bags.index import Recorded

CLOCKS_APART = 5.0
"""Seconds between two sensors' clocks, by when their messages arrived, from which one is brought to the other."""


@dataclass(frozen=True)
class Usable:
    """The messages of a topic whose stamps can be used. rows: of ``recorded``. ns: (n,) increasing.

    reason: why there are none, "" if there are. notes: what was left out.
    """

    recorded: Recorded
    rows: NDArray[np.int64]
    ns: tables.Nanoseconds
    reason: str = ""
    notes: tuple[str, ...] = ()


def usable_stamps(name: str, recorded: Recorded) -> Usable:
    """Rows with a stamp, the fewest left out so that stamps increase."""
    stamps = recorded.stamps
    if recorded.channel.type in messages.FRAMES:
        return Usable(recorded, np.arange(len(stamps)), recorded.received)
    rows = np.flatnonzero(stamps != tables.BLANK)
    none = np.zeros(0, dtype=np.int64)
    if not len(stamps):
        return Usable(recorded, none, none, "it has no messages")
    if not len(rows):
        return Usable(recorded, none, none, "the stamps in its headers are zero or make no sense")
    keep = tables.increasing(stamps[rows])
    notes = []
    if len(rows) < len(stamps):
        notes.append(f"{name}: {len(stamps) - len(rows)} of {len(stamps)} messages without a stamp are left out")
    if not keep.all():
        notes.append(f"{name}: {np.sum(~keep)} of {len(stamps)} messages whose stamps repeat or go back are left out")
    rows = rows[keep]
    return Usable(recorded, rows, stamps[rows], "", tuple(notes))


def shifts(usable: Mapping[str, Usable]) -> dict[str, int]:
    """Nanoseconds to add to a topic's stamps where its clock is far from most others', whole seconds."""
    late = {n: float(np.median((u.recorded.received[u.rows] - u.ns) / 1e9)) for n, u in usable.items()}
    usual = float(np.median(list(late.values()))) if late else 0.0
    nearest = min(late.values(), key=lambda x: abs(x - usual), default=0.0)
    return {n: round(x - nearest) * 10**9 for n, x in late.items() if abs(x - nearest) > CLOCKS_APART}


def shifted(topic: str, moved: Mapping[str, int]) -> tuple[str, ...]:
    """A sentence if a topic's stamps were moved. moved: nanoseconds by topic."""
    if topic not in moved:
        return ()
    return (
        f"{topic}: its clock is {-moved[topic] / 1e9:+.0f} s from the others', by when messages arrived; its stamps "
        "were moved by so many whole seconds, and its clock offset is what remains",
    )
