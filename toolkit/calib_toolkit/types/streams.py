"""A recording: one stream of stamped readings for each sensor, and the log that holds them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib_toolkit.errors import DataError
from calib_toolkit.types.calibration import Calibration

Array = NDArray[np.float64]


@dataclass(frozen=True)
class CameraIntrinsics:
    """A pinhole camera in OpenCV's model.

    K: (3, 3) pixels. distortion: OpenCV's coefficients (k1 k2 p1 p2 k3 ...), empty for a rectified image.
    size: (width, height) in pixels. mask: (h, w) uint8, non-zero where the image may be used, or None.
    """

    K: Array
    distortion: Array = field(default_factory=lambda: np.zeros(0))
    size: tuple[int, int] | None = None
    mask: NDArray[np.uint8] | None = None


@dataclass(frozen=True)
class Stream:
    """Everything one sensor recorded.

    name: the sensor's name in the log. kind: the id of the sensor plugin that reads it.
    stamps: (n,) float64 seconds since ``Log.epoch_ns``, as recorded; reading k belongs to stamp k.
    readings: a sequence, loaded lazily, that can be sliced and pickled.
    has_scale: False where the motion's length is not known (a single camera).
    clock: streams that name one clock share one timing offset (the heads of a ladybug); default: own clock.
    options: defaults for the sensor plugin's options that belong to this recording.
    notes: sentences on what was wrong with the recording and what was done about it.
    topic: what the recording itself calls it, if it has another name there.
    """

    name: str
    kind: str
    stamps: Array
    readings: Sequence[Any]
    intrinsics: CameraIntrinsics | None = None
    has_scale: bool = True
    clock: str = ""
    options: Mapping[str, Any] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    topic: str = ""

    def __post_init__(self) -> None:
        stamps = np.asarray(self.stamps, dtype=np.float64)
        object.__setattr__(self, "stamps", stamps)
        if not self.clock:
            object.__setattr__(self, "clock", self.name)
        if stamps.ndim != 1 or len(stamps) != len(self.readings):
            raise DataError(
                f"sensor {self.name}: {stamps.size} stamps for {len(self.readings)} readings; "
                "each reading needs one stamp"
            )
        if not np.all(np.isfinite(stamps)):
            bad = int(np.flatnonzero(~np.isfinite(stamps))[0])
            raise DataError(f"sensor {self.name}: the stamp of reading {bad} is not a number; drop that reading")
        steps = np.diff(stamps)
        if np.any(steps <= 0):
            bad = int(np.flatnonzero(steps <= 0)[0]) + 1
            raise DataError(
                f"sensor {self.name}: the stamp of reading {bad} ({stamps[bad]:.6f} s) does not come after the "
                f"one before it ({stamps[bad - 1]:.6f} s); drop or sort such readings before calibrating"
            )

    def __len__(self) -> int:
        return len(self.stamps)

    def __getitem__(self, part: slice) -> "Stream":
        return replace(self, stamps=self.stamps[part], readings=self.readings[part])

    def named(self, name: str) -> "Stream":
        """The same under another name; a clock of its own goes with it."""
        return replace(self, name=name, clock=name if self.clock == self.name else self.clock)

    @property
    def period(self) -> float:
        """Median time between readings, seconds; nan with fewer than two readings."""
        return float(np.median(np.diff(self.stamps))) if len(self) > 1 else float("nan")

    def between(self, start: float, end: float) -> "Stream":
        """The readings with ``start <= stamp <= end``, seconds since the log's epoch."""
        i, j = np.searchsorted(self.stamps, [start, end], side="left")
        return self[int(i) : int(j) + int(j < len(self) and self.stamps[j] == end)]


@dataclass(frozen=True)
class Topic:
    """One topic of a recording that has such. rate: messages a second, nan for fewer than two.

    sensor: the stream that it is a part of, "" for none, and ``unused`` then says why.
    """

    name: str
    type: str
    messages: int
    rate: float
    sensor: str = ""
    unused: str = ""


@dataclass(frozen=True)
class Log:
    """A recorded drive.

    epoch_ns: unix nanoseconds that stamp 0.0 stands for. reference: a calibration that came with the
    recording, used only to compare with, never to calibrate. topics: all that was recorded, where it was by topics.
    """

    source: Path
    streams: Mapping[str, Stream]
    epoch_ns: int = 0
    reference: Calibration | None = None
    notes: tuple[str, ...] = ()
    topics: tuple[Topic, ...] = ()

    def select(self, names: Sequence[str] | None) -> "Log":
        """The log with only the named sensors, in that order (all of them when names is None).

        A name is that of a stream or its topic; ``new=old`` gives it another one, here and in the reference.
        """
        if names is None:
            return self
        pairs = [(new if equals else "", old or new) for new, equals, old in (n.partition("=") for n in names)]
        found = [self._called(old) for _, old in pairs]
        renamed = {old: new or old for (new, _), old in zip(pairs, found, strict=True)}
        for listed in (found, list(renamed.values())):
            doubled = [n for i, n in enumerate(listed) if n in listed[:i]]
            if doubled:
                raise DataError(f"sensor '{doubled[0]}' is named twice in the list of sensors; name it once")
        streams = {new: self.streams[old].named(new) for old, new in renamed.items()}
        reference = self.reference
        if reference is not None and any(new != old for old, new in renamed.items()):
            reference = reference.renamed(renamed)
        return replace(self, streams=streams, reference=reference)

    def _called(self, wanted: str) -> str:
        """The stream of that name or topic."""
        by_topic = [name for name, s in self.streams.items() if s.topic == wanted]
        if wanted in self.streams or by_topic:
            return wanted if wanted in self.streams else by_topic[0]
        why = next((f" ({t.unused})" for t in self.topics if t.name == wanted and t.unused), "")
        raise DataError(
            f"{self.source} has no sensor named '{wanted}'{why}; it has: {', '.join(self.streams) or 'none'}"
        )

    @property
    def span(self) -> tuple[float, float]:
        """First and last stamp of any sensor, seconds; zeros where there is none."""
        stamps = [s.stamps for s in self.streams.values() if len(s)]
        return min((float(s[0]) for s in stamps), default=0.0), max((float(s[-1]) for s in stamps), default=0.0)

    def trim(self, start: float = 0.0, duration: float | None = None) -> "Log":
        """The part from ``start`` seconds after the first stamp of any sensor, ``duration`` seconds long.

        Raises DataError if nothing is left.
        """
        if not self.streams or (start == 0.0 and duration is None):
            return self
        t0, last = self.span
        t0 += start
        if t0 >= last:
            raise DataError(f"{self.source} is {last - t0 + start:.1f} s long, so nothing is left after {start:g} s")
        t1 = np.inf if duration is None else t0 + duration
        return replace(self, streams={n: s.between(t0, t1) for n, s in self.streams.items()})
