"""Each sensor's own motion (section V): in slices, in parallel, cached, and resumable after a kill."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields, replace
from itertools import chain
from pathlib import Path
from typing import Any

import joblib
import numpy as np

from calib_toolkit import cache
from calib_toolkit.errors import CalibrationError, ConfigError, DataError
from calib_toolkit.hookspecs import Sensor
from calib_toolkit.progress import Progress
from calib_toolkit.types import LazyReadings, Motions, Stream, Trajectory

UNREADABLE = 0.1
"""A sensor is refused when more than this share of its readings can not be read."""


@dataclass(frozen=True)
class SensorMotion:
    """How one sensor moved, and one sentence for each thing that was skipped."""

    motion: Motions | Trajectory
    notes: tuple[str, ...] = ()

    @property
    def is_antenna(self) -> bool:
        """Whether it tells positions alone."""
        return isinstance(self.motion, Trajectory) and not self.motion.has_attitude

    @property
    def motions(self) -> Motions:
        """As motions between successive readings. Raises DataError for positions alone."""
        if self.is_antenna:
            raise DataError("positions without attitude tell no motion; leave that sensor out here")
        return self.motion.motions() if isinstance(self.motion, Trajectory) else self.motion


@dataclass(frozen=True)
class _Slice:
    """One piece of work: the motion of a stretch of readings."""

    sensor: Sensor
    stream: Stream
    options: Any
    folder: Path | None

    @property
    def lazy(self) -> bool:
        """Whether its readings still have to be loaded."""
        return isinstance(self.stream.readings, LazyReadings)


def estimate_motions(
    streams: Iterable[tuple[Stream, Sensor]],
    options: Mapping[str, Mapping[str, Any]],
    progress: Progress,
    jobs: int = 1,
    folder: Path | None = None,
) -> dict[str, SensorMotion]:
    """The motion of every stream, by sensor name.

    options: overrides by sensor name or kind. jobs: processes. folder: where finished slices are kept, or None.
    Raises CalibrationError.
    """
    streams = list(streams)
    _check_tables(streams, options)
    work = {stream.name: _slices(stream, sensor, options, folder) for stream, sensor in streams}
    for name, slices in work.items():
        progress.begin(name, sum(len(s.stream) - 1 for s in slices))
    pool = joblib.Parallel(n_jobs=jobs, return_as="generator", pre_dispatch="2*n_jobs")
    parts = [(name, part) for name, slices in work.items() for part in slices]
    # what is in memory already costs more to send than to do here
    sent = [p for p in parts if jobs != 1 and p[1].lazy]
    here = [p for p in parts if jobs == 1 or not p[1].lazy]
    results = chain(map(_estimate, (part for _, part in here)), pool(joblib.delayed(_estimate)(p) for _, p in sent))
    done: dict[str, list[SensorMotion]] = {name: [] for name in work}
    for (name, part), result in zip([*here, *sent], results, strict=True):
        done[name].append(result)
        progress.advance(name, len(part.stream) - 1)
    return {name: _joined(name, work[name], parts) for name, parts in done.items()}


def _check_tables(streams: list[tuple[Stream, Sensor]], options: Mapping[str, Mapping[str, Any]]) -> None:
    known = [*(stream.name for stream, _ in streams), *dict.fromkeys(sensor.id for _, sensor in streams)]
    for table in options:
        if table not in known:
            raise ConfigError(
                f"[sensors.{table}] of the configuration is neither a sensor of this run nor the kind of one; there "
                f"are: {', '.join(known)}"
            )


def _slices(
    stream: Stream, sensor: Sensor, options: Mapping[str, Mapping[str, Any]], folder: Path | None
) -> list[_Slice]:
    if len(stream) < 2:
        raise DataError(
            f"sensor {stream.name} has {len(stream)} reading{'s' * (len(stream) != 1)} in the part of the drive that "
            "was chosen, and a motion takes two; take another part (--start, --duration), or leave the sensor out"
        )
    chosen = _options(stream, sensor, options)
    chunk = sensor.chunk if isinstance(stream.readings, LazyReadings) else len(stream)
    cuts = range(0, len(stream) - 1, chunk)
    return [_Slice(sensor, stream[i : i + chunk + 1], chosen, folder) for i in cuts]


def _options(stream: Stream, sensor: Sensor, options: Mapping[str, Mapping[str, Any]]) -> Any:
    known = {f.name for f in fields(sensor.options)}
    values = {k: v for k, v in stream.options.items() if k in known}
    for table in (sensor.id, stream.name):
        for key, value in options.get(table, {}).items():
            if key not in known:
                raise ConfigError(
                    f"[sensors.{table}] of the configuration: a {sensor.id} has no option '{key}'; it has: "
                    f"{', '.join(sorted(known)) or 'none'}"
                )
            values[key] = tuple(value) if isinstance(value, list) else value
    return replace(sensor.options(), **values)


def _estimate(part: _Slice) -> SensorMotion:
    """One slice: from the cache, or made and kept there."""
    stream, sensor = part.stream, part.sensor
    if part.folder is None or not part.lazy:
        return _estimate_readable(stream, sensor, part.options)
    what = (stream.name, stream.stamps, stream.readings, stream.intrinsics, stream.has_scale)
    key = cache.key_of(sensor.id, sensor.version, part.options, *what)
    stored = cache.load(part.folder, key)
    if stored is not None:
        return SensorMotion(*stored)
    result = _estimate_readable(stream, sensor, part.options)
    cache.store(part.folder, key, result.motion, result.notes)
    return result


def _estimate_readable(stream: Stream, sensor: Sensor, options: Any) -> SensorMotion:
    """The slice's motion; readings that can not be read are left out, and said so."""
    try:
        return SensorMotion(sensor.estimate(stream, options))
    except DataError:
        bad = [(i, why) for i in range(len(stream)) if (why := _unreadable(stream, i))]
        if not bad:
            raise
        good = [i for i in range(len(stream)) if i not in dict(bad)]
        notes = tuple(f"left out: {why}" for _, why in bad)
        kept = replace(stream, stamps=stream.stamps[good], readings=LazyReadings(stream.readings.__getitem__, good))
        if len(good) < 2:
            return SensorMotion(_nothing(stream), notes)
        return SensorMotion(sensor.estimate(kept, options), notes)


def _unreadable(stream: Stream, i: int) -> str:
    try:
        stream.readings[i]
    except CalibrationError as e:
        return str(e)
    return ""


def _nothing(stream: Stream) -> Motions:
    return Motions(np.zeros(0), np.zeros(0), np.zeros((0, 6)), np.zeros((0, 6, 6)), stream.has_scale)


def _joined(name: str, slices: list[_Slice], parts: list[SensorMotion]) -> SensorMotion:
    """All slices' motion as one, with the notes that neighbours share said once."""
    notes = tuple(dict.fromkeys(note for part in parts for note in part.notes))
    total = 1 + sum(len(s.stream) - 1 for s in slices)
    if len(notes) > max(UNREADABLE * total, 1):
        raise DataError(
            f"sensor {name}: {len(notes)} of {total} readings can not be read, the first: "
            f"{notes[0].removeprefix('left out: ')}; copy the recording again, or leave the sensor out"
        )
    motions = [p.motion for p in parts if len(p.motion)]
    trajectories = [m for m in motions if isinstance(m, Trajectory)]
    if trajectories and len(trajectories) == len(motions):
        return SensorMotion(Trajectory.concatenate(trajectories), notes)
    steps = Motions.concatenate([p.motions for p in parts])
    failed = total - 1 - len(notes) - len(steps)
    if failed > 0 and slices[0].lazy:
        notes += (
            f"sensor {name}: no motion could be estimated for {failed} of its {total - 1} steps; they are left out",
        )
    if not len(steps):
        raise DataError(
            f"sensor {name}: no motion could be estimated from its {total} readings; see that they show a scene "
            "(not black, not covered), and leave the sensor out otherwise"
        )
    return SensorMotion(steps, notes)
