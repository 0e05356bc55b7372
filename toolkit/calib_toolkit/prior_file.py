"""Numbers that were measured by hand or stand in a drawing, as a TOML file for ``run --prior``."""

import math
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from calib_toolkit.errors import DataError
from calib_toolkit.types import Measured

KEYS = {
    "x": ("x", 1.0),
    "y": ("y", 1.0),
    "z": ("z", 1.0),
    "roll_deg": ("roll", math.pi / 180),
    "pitch_deg": ("pitch", math.pi / 180),
    "yaw_deg": ("yaw", math.pi / 180),
    "dt_ms": ("dt", 1e-3),
}
"""Key in the file: the parameter of :class:`Measured`, and the SI value of one unit."""
LARGEST, SUREST = 1e9, 1e-9
"""No measurement is larger, or surer; an estimator divides by the square of sigma."""


@dataclass(frozen=True)
class Prior:
    """What a file says was measured. base: the sensor whose frame and clock the numbers are in, None if not said."""

    base: str | None
    numbers: tuple[Measured, ...]


def read_prior(file: Path) -> Prior:
    """The measured numbers of a TOML file: one table for each sensor, ``key = [value, sigma]``. Raises DataError."""
    try:
        tables = tomllib.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as e:
        raise DataError(f"{file} can not be read as TOML: {e}") from e
    base = tables.pop("base") if isinstance(tables.get("base"), str) else None
    numbers = tuple(number for name, table in tables.items() for number in _numbers(file, name, table))
    if not numbers:
        raise DataError(f"{file} holds no measured number; give a sensor's table one, such as z = [1.20, 0.02]")
    if base in tables:
        raise DataError(f"{file}: {base} is the base, so its pose and offset are zero by definition; drop its table")
    return Prior(base, numbers)


def _numbers(file: Path, name: str, table: Any) -> Iterator[Measured]:
    if not isinstance(table, dict):
        raise DataError(f"{file}: {name} = {table!r} is no table; write [{name}], and its numbers below it")
    for key, pair in table.items():
        if key not in KEYS:
            raise DataError(f"{file} sets '{key}' for {name}, which does not exist; there are: {', '.join(KEYS)}")
        if not isinstance(pair, list) or len(pair) != 2 or not all(_is_number(x) for x in pair):
            raise DataError(f"{file}: {key} of {name} is {pair!r}; give [value, sigma], two numbers")
        value, sigma = pair
        if sigma < SUREST:
            raise DataError(
                f"{file}: the sigma of {name}'s {key} is {sigma:g}; give how sure the value is, above zero"
            )
        parameter, unit = KEYS[key]
        yield Measured(name, parameter, value * unit, sigma * unit)


def _is_number(x: Any) -> bool:
    return isinstance(x, int | float) and not isinstance(x, bool) and -LARGEST < x < LARGEST
