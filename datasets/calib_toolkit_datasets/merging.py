"""Logs of single sensors put together as one, and sensors opened as a rig.toml would."""

import math
import os
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from calib_toolkit import Log, ReadContext, SensorTable, Stream
from calib_toolkit.errors import DataError


def from_table(context: ReadContext, kind: str, name: str, folder: Path, **values: Any) -> Log:
    """What a table ``[sensors.NAME]`` of these values opens; its paths start at ``folder``. Raises DataError."""
    sensor = context.sensors.get(kind)
    if sensor is None or sensor.open_table is None:
        raise DataError(f"sensor {name} is of kind '{kind}', which no installed plugin reads from files; install one")
    return sensor.open_table(SensorTable(name, folder, values))


def merged(source: Path, logs: Sequence[Log]) -> Log:
    """One log, its epoch the first stamp of all. Raises DataError if two bring a sensor of one name.

    Epochs are subtracted as integers, so that neither the difference between them nor a small stamp loses
    digits to a large one.
    """
    epoch_ns = min((_first_ns(log, s) for log in logs for s in log.streams.values() if len(s)), default=0)
    streams: dict[str, Stream] = {}
    for log in logs:
        whole, rest_ns = divmod(log.epoch_ns - epoch_ns, 10**9)
        for name, stream in log.streams.items():
            if name in streams:
                raise DataError(f"{source}: two tables bring a sensor called '{name}'; rename one of them")
            streams[name] = replace(stream, stamps=(stream.stamps + whole) + rest_ns * 1e-9)
    return Log(source, streams, epoch_ns, notes=tuple(dict.fromkeys(note for log in logs for note in log.notes)))


def refuse_leaving(root: Path, files: Iterable[Path]) -> None:
    """Raises DataError for a file that lies outside of the recording's folder, by its name or by a link."""
    home, seen = root.resolve(), set()
    for file in files:
        if os.path.islink(file) or file.parent not in seen:
            seen.add(file.parent)
            if not _inside(file, home):
                raise DataError(f"{file} leads out of the recording's folder {root}; copy it there, or remove it")


def _inside(file: Path, home: Path) -> bool:
    try:
        return file.resolve().is_relative_to(home)
    except (OSError, ValueError, RuntimeError):  # a name that no file can have, or links that go round
        return False


def _first_ns(log: Log, stream: Stream) -> int:
    whole, rest = divmod(float(stream.stamps[0]), 1.0)
    return log.epoch_ns + int(whole) * 10**9 + math.floor(rest * 1e9)
