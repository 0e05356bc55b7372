"""What a recording holds and what is wrong with it, before anything is calibrated."""

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

import numpy as np

from calib_toolkit.types import Log, Stream

GAP_PERIODS = 3.0
"""A step between readings longer than this many periods is a gap."""
IRREGULAR = 0.5
"""Steps (gaps aside) whose 5 to 95 % range is wider than this share of the period make an irregular rate."""
SHORT = 30.0
"""A drive shorter than this, in seconds, can hardly turn often enough to be calibrated from motion."""


@dataclass(frozen=True)
class SensorSummary:
    """One sensor's stamps in numbers; times are seconds, nan where there are too few readings.

    start, end: since the first stamp of the whole log. rate: readings per second, from the median period.
    gaps: steps of more than ``GAP_PERIODS`` periods. largest_gap: the longest step, which starts at ``gap_at``.
    """

    name: str
    kind: str
    readings: int
    rate: float
    start: float
    end: float
    gaps: int
    largest_gap: float
    gap_at: float


@dataclass(frozen=True)
class Inspection:
    """A recording at a glance. duration: seconds from its first stamp to its last. problems: one sentence each."""

    source: Path
    duration: float
    sensors: tuple[SensorSummary, ...]
    problems: tuple[str, ...]

    @property
    def clean(self) -> bool:
        """Whether nothing is wrong with the recording."""
        return not self.problems


def inspect_log(log: Log) -> Inspection:
    """Count, time and judge the streams of a log from their stamps alone; no reading is loaded."""
    stamps = [s.stamps for s in log.streams.values() if len(s)]
    first = min((s[0] for s in stamps), default=0.0)
    duration = float(max((s[-1] for s in stamps), default=first) - first)
    sensors = tuple(_summary(stream, first) for stream in log.streams.values())
    problems = [
        *log.notes,
        *(note for s in log.streams.values() for note in _notes(s)),
        *_length(log, duration),
        *(p for summary in sensors for p in _holes(summary, duration)),
        *(p for stream in log.streams.values() for p in _irregular(stream)),
        *_apart(sensors),
    ]
    return Inspection(log.source, duration, sensors, tuple(problems))


def _summary(stream: Stream, first: float) -> SensorSummary:
    n, nan = len(stream), float("nan")
    start, end = (float(stream.stamps[0] - first), float(stream.stamps[-1] - first)) if n else (nan, nan)
    if n < 2:
        return SensorSummary(stream.name, stream.kind, n, nan, start, end, 0, nan, nan)
    steps = np.diff(stream.stamps)
    k = int(np.argmax(steps))
    gaps = int(np.sum(steps > GAP_PERIODS * stream.period))
    at = float(stream.stamps[k] - first)
    return SensorSummary(stream.name, stream.kind, n, 1 / stream.period, start, end, gaps, float(steps[k]), at)


def _notes(stream: Stream) -> Iterable[str]:
    return (note if stream.name in note else f"{stream.name}: {note}" for note in stream.notes)


def _length(log: Log, duration: float) -> Iterable[str]:
    if not log.streams:
        yield f"{log.source} holds no sensor at all; name the folder that holds the recording"
    elif duration < SHORT:
        yield (
            f"the drive lasts only {duration:.1f} s; motion needs turns in several directions, which takes "
            f"{SHORT:.0f} s at the very least and better some minutes"
        )


def _holes(s: SensorSummary, duration: float) -> Iterable[str]:
    if s.readings < 2:
        count = "one reading" if s.readings else "no readings"
        yield f"{s.name} has {count} where motion needs two; check its files or leave it out with --sensors"
        return
    if s.end - s.start < 0.5 * duration:
        yield f"{s.name} covers only {s.end - s.start:.1f} s of the {duration:.1f} s drive"
    if s.gaps:
        yield (
            f"{s.name} has {s.gaps} gap{'s' * (s.gaps > 1)} of over {GAP_PERIODS:.0f} periods; the longest is "
            f"{s.largest_gap:.3f} s, {s.gap_at:.3f} s into the drive"
        )


def _irregular(stream: Stream) -> Iterable[str]:
    if len(stream) < 3:
        return
    steps = np.diff(stream.stamps)
    low, high = np.percentile(steps[steps <= GAP_PERIODS * stream.period], [5, 95])
    if high - low > IRREGULAR * stream.period:
        yield (
            f"{stream.name} is irregular: its readings come {low:.3f} to {high:.3f} s apart where "
            f"{stream.period:.3f} s is usual; its stamps may be of arrival, not of measurement"
        )


def _apart(sensors: Iterable[SensorSummary]) -> Iterable[str]:
    for a, b in combinations([s for s in sensors if s.readings], 2):
        if max(a.start, b.start) >= min(a.end, b.end) and a.readings > 1 and b.readings > 1:
            yield (
                f"{a.name} ({a.start:.1f} to {a.end:.1f} s) and {b.name} ({b.start:.1f} to {b.end:.1f} s) do not "
                "overlap in time; their clocks may count from different epochs"
            )
