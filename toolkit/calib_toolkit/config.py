"""What may be chosen for a run; every field has a default that needs no tuning."""

import os
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from calib_toolkit.errors import ConfigError
from calib_toolkit.rotation import RotationOptions
from calib_toolkit.timing import TimingOptions
from calib_toolkit.translation import TranslationOptions
from calib_toolkit.types import Measured

METHODS = ("joint", "paper")
TINY = 1e-3


@dataclass(frozen=True)
class SyncOptions:
    """gate: steps are dropped where two sensors' angles differ by more standard deviations than this (VI-A1)."""

    gate: float = 10.0


@dataclass(frozen=True)
class Config:
    """One run's choices.

    base: the sensor all poses are given in; None for the first that has scale. start, duration: the part of the
    drive to use, seconds from its first stamp. jobs: processes for the sensors' own motion. sensors: options of
    the sensor plugins, by sensor name or kind. prior: numbers that were measured by hand. appearance: metrics that
    refine what the motion tells, or ("none",). moments: of each pair, at which appearance is compared. metrics:
    options of the metrics, by id.
    """

    method: str = "joint"
    base: str | None = None
    start: float = 0.0
    duration: float | None = None
    jobs: int = field(default_factory=lambda: os.cpu_count() or 1)
    seed: int = 0
    sync: SyncOptions = field(default_factory=SyncOptions)
    timing: TimingOptions = field(default_factory=TimingOptions)
    rotation: RotationOptions = field(default_factory=RotationOptions)
    translation: TranslationOptions = field(default_factory=TranslationOptions)
    sensors: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    prior: tuple[Measured, ...] = ()
    appearance: tuple[str, ...] = ("im", "matching", "map")
    moments: int = 25
    metrics: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.method not in METHODS:
            raise ConfigError(f"there is no method '{self.method}'; there are: {', '.join(METHODS)}")
        if self.timing.start not in ("correlation", "zero"):
            raise ConfigError(f"timing.start = '{self.timing.start}' is neither 'correlation' nor 'zero'")
        if not self.appearance or not all(isinstance(m, str) for m in self.appearance):
            raise ConfigError(f"appearance = {self.appearance!r} is no list of metrics; name some, or none")
        if not isinstance(self.base, str | None):
            raise ConfigError(f"base = {self.base!r} is not the name of a sensor")
        for name, value, least, below in (
            ("start", self.start, 0.0, np.inf),
            ("duration", 1.0 if self.duration is None else self.duration, TINY, np.inf),
            ("jobs", self.jobs, 1, np.inf),
            ("moments", self.moments, 8, 1001),
            ("sync.gate", self.sync.gate, TINY, np.inf),
            ("timing.steps", self.timing.steps, 100, 1_000_001),
            ("timing.max_offset", self.timing.max_offset, TINY, np.inf),
            *(
                (f"{stage}.trim", getattr(self, stage).trim, 0.0, 1.0)
                for stage in ("timing", "rotation", "translation")
            ),
        ):
            if not isinstance(value, int | float) or isinstance(value, bool) or not least <= value < below:
                raise ConfigError(
                    f"{name} = {value!r} is out of range; give a number from {least:g} to below {below:g}"
                )


def read_config(file: Path, **overrides: Any) -> Config:
    """The configuration in a TOML file; unknown names are refused. Raises ConfigError."""
    try:
        table = tomllib.loads(file.read_text())
    except (OSError, ValueError, RecursionError) as e:
        raise ConfigError(f"{file} can not be read as TOML: {e}") from e
    return replace(_filled(Config(), table, str(file)), **overrides)


def _filled(default: Any, table: Mapping[str, Any], where: str) -> Any:
    """A copy of a dataclass with a table's values, tables within filling dataclasses within."""
    known = {f.name for f in fields(default)}
    values = {}
    for key, value in table.items():
        if key not in known:
            raise ConfigError(f"{where} sets '{key}', which does not exist; there are: {', '.join(sorted(known))}")
        current = getattr(default, key)
        if is_dataclass(current):
            value = _filled(current, _table(value, where, key), f"{where} [{key}]")
        elif isinstance(current, Mapping):
            value = {k: _table(v, where, f"{key}.{k}") for k, v in _table(value, where, key).items()}
        else:
            value = _same_type(current, value, f"{where}: {key}")
        values[key] = value
    return replace(default, **values)


def _table(value: Any, where: str, key: str) -> Mapping[str, Any]:
    if not isinstance(value, Mapping):
        raise ConfigError(f"{where}: {key} is a table; write [{key}]")
    return value


def _same_type(current: Any, value: Any, where: str) -> Any:
    if isinstance(current, float) and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if current is None:
        return value
    if isinstance(current, tuple) and isinstance(value, list):
        return tuple(value)
    if type(value) is not type(current):
        raise ConfigError(f"{where} is {value!r}, where a {type(current).__name__} is expected")
    return value
