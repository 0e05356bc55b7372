"""A rig put together from files and other recordings: one table for each sensor in a ``rig.toml``.

    [sensors.NAME]
    kind = "odometry"          # a sensor plugin's id, then the keys that this sensor asks for
    poses = "poses.txt"
    clock = "trigger"          # at will: sensors that name the same share one clock offset

    [sensors.OTHER]
    log = "2011_10_03_drive_0027_extract"    # any recording that another reader knows
    sensor = "cam0"                          # its name there; default: OTHER

Paths are relative to the folder of the rig.toml; ``~`` is the home folder.
"""

import tomllib
from collections.abc import Mapping
from dataclasses import replace
from os.path import expanduser, isfile
from pathlib import Path
from typing import Any

from calib_toolkit import Dataset, Log, ReadContext, SensorTable, hookimpl
from calib_toolkit.errors import DataError
from calib_toolkit_datasets import rig_writing
from calib_toolkit_datasets.merging import merged

FILE = "rig.toml"


@hookimpl
def calib_register_datasets() -> list[Dataset]:
    """The ``rig`` reader."""
    looks_for = f"a {FILE} with one [sensors.NAME] table for each sensor"
    return [Dataset("rig", looks_for, matches, open_log, rig_writing.write, resumes=True)]


def matches(path: Path) -> bool:
    """Whether a path is a rig.toml or a folder with one."""
    return path.name == FILE if isfile(path) else isfile(path / FILE)


def open_log(path: Path, context: ReadContext) -> Log:
    """The streams of all tables on one epoch. Raises DataError; the file and the sensor are named."""
    file = path if path.is_file() else path / FILE
    logs: list[Log] = []
    opened: dict[Path, Log] = {}
    for name, values in _tables(file).items():
        table = _Keys(values, f"{file}: sensor {name}")
        if ("kind" in table) == ("log" in table):
            raise DataError(
                f"{table.where} needs either 'kind' (a sensor's id) or 'log' (a recording); give one of them"
            )
        logs.append(
            _from_log(name, table, file, context, opened) if "log" in table else _own(name, table, file, context)
        )
    return merged(file, logs)


class _Keys(dict[str, Any]):
    """A sensor's keys; one that is asked for and missing is refused in a sentence."""

    def __init__(self, values: Mapping[str, Any], where: str) -> None:
        super().__init__(values)
        self.where = where

    def __missing__(self, key: str) -> Any:
        raise DataError(f"{self.where} lacks the key '{key}'; add it")


def _tables(file: Path) -> dict[str, dict[str, Any]]:
    try:
        content = tomllib.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as e:
        raise DataError(f"{file} can not be read: {e}; mend the file") from e
    unknown = [key for key in content if key != "sensors"]
    tables = content.get("sensors")
    if unknown or not isinstance(tables, dict) or not tables:
        raise DataError(
            f"{file} must hold one table [sensors.NAME] for each sensor and nothing else"
            f"{f'; remove {unknown[0]!r}' if unknown else ', and holds none; add one'}"
        )
    stray = [name for name, values in tables.items() if not isinstance(values, dict)]
    if stray:
        raise DataError(f"{file}: sensors.{stray[0]} is not a table; write it as [sensors.{stray[0]}]")
    return tables


def _own(name: str, table: _Keys, file: Path, context: ReadContext) -> Log:
    kind = table["kind"]
    able = [k for k, s in context.sensors.items() if s.open_table is not None]
    sensor = context.sensors.get(kind) if isinstance(kind, str) else None
    if sensor is None:
        raise DataError(
            f"{table.where} is of kind {kind!r}, which no installed plugin reads; kinds that can stand here: "
            f"{', '.join(able) or 'none'}"
        )
    if sensor.open_table is None:
        raise DataError(
            f"{table.where} is of kind '{kind}', which can not be read from a {FILE}; take it out of a recording "
            f"with 'log', or use one of: {', '.join(able) or 'none'}"
        )
    values = _Keys({k: v for k, v in table.items() if k not in ("kind", "clock")}, table.where)
    log = sensor.open_table(SensorTable(name, file.absolute().parent, values))
    clock = table.get("clock", "")
    if not isinstance(clock, str):
        raise DataError(f"{table.where}: 'clock' must be a string, the same for sensors that share one clock offset")
    return replace(log, streams={n: replace(s, clock=clock or s.clock) for n, s in log.streams.items()})


def _from_log(name: str, table: _Keys, file: Path, context: ReadContext, opened: dict[Path, Log]) -> Log:
    unknown = [key for key in table if key not in ("log", "sensor")]
    if unknown:
        raise DataError(
            f"{table.where} has the key '{unknown[0]}', but beside 'log' only 'sensor' is known; remove it"
        )
    theirs = table.get("sensor", name)
    if not isinstance(table["log"], str) or not isinstance(theirs, str):
        raise DataError(f"{table.where}: 'log' and 'sensor' must be strings")
    path = (file.absolute().parent / expanduser(table["log"])).resolve()
    if matches(path):  # two of them could name each other for ever
        raise DataError(f"{table.where}: {path} is a rig itself; copy the tables that are wanted from its {FILE}")
    try:
        log = opened.get(path) or context.open_log(path)
        stream = log.select([theirs]).streams[theirs]
    except DataError as e:
        raise DataError(f"{table.where}: {e}") from e
    opened[path] = log
    sharing = [s.name for s in log.streams.values() if s.clock == stream.clock]
    clock = name if len(sharing) == 1 else f"{stream.clock} of {log.source}"
    return replace(log, streams={name: replace(stream, name=name, clock=clock)})
