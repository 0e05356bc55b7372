"""CSV, for tables: one row for each sensor, cells empty where a number was not determined."""

import csv
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

from calib_toolkit import Calibration, CameraIntrinsics, Exporter, hookimpl
from calib_toolkit.errors import DataError
from calib_toolkit_plugins.exporters import files, plain

POSE = ("x", "y", "z", "qx", "qy", "qz", "qw")
TITLES = (
    *("sensor", "base", *POSE, "dt", "clock_skew", "t_ref"),
    *(f"sigma_{key}" for key in plain.SIGMAS),
    "has_scale",
)


@hookimpl
def calib_register_exporters() -> list[Exporter]:
    """The ``csv`` exporter."""
    loses = "correlations of errors, reasons why a number was not determined, intrinsics"
    looks_for = f"a line of titles that begins with {','.join(TITLES[:5])}"
    return [Exporter("csv", write, read, looks_for, matches, loses, holds_unknown=True)]


def matches(path: Path) -> bool:
    """Whether a file has the titles that :func:`write` gives it."""
    return any(line.startswith(",".join(TITLES[:5])) for line in files.head(path).splitlines())


def write(c: Calibration, path: Path, intrinsics: Mapping[str, CameraIntrinsics]) -> None:
    """Comments, titles, and one row for each sensor."""
    if bad := next((n for n in c.names if n.startswith("#")), None):
        raise DataError(f"a row that begins with # is a comment, so csv has no sensor {bad!r}; rename it")
    with path.open("w", newline="", encoding="utf-8") as file:
        file.write(files.comments(["Calibration", *plain.meaning(c), "Null is an empty cell."]))
        file.write(",".join(TITLES) + "\n")
        table = csv.writer(file, lineterminator="\n")
        for r in plain.rows(c):
            numbers = (*r.translation, *r.quaternion, r.dt, r.clock_skew, c.t_ref, *r.sigma, int(r.has_scale))
            table.writerow([r.name, c.base, *numbers])
        file.write(f"# {len(c.names)} sensors, {files.END}\n")


def read(path: Path) -> Calibration:
    """The calibration, its covariance diagonal. Raises DataError."""
    content = files.text(path)
    lines = [line for line in content.split("\n") if line.strip() and not line.startswith("#")]
    try:
        titles, *rows = csv.reader(lines, strict=True)
    except (csv.Error, ValueError) as e:
        raise DataError(f"{path} is no table of comma-separated values ({e}); correct it or fetch it again") from e
    if tuple(titles) != TITLES or not all(len(row) == len(TITLES) for row in rows):
        raise DataError(f"{path} must have the titles {','.join(TITLES)}, and as many cells in each row; correct it")
    count = re.search(rf"^# (\d+) sensors, {files.END}$", content, re.MULTILINE)
    if count and int(count[1]) != len(rows):
        raise DataError(f"{path} has {len(rows)} rows, but its last line says {count[1]} sensors; correct it")
    tables = [dict(zip(TITLES, row, strict=True)) for row in rows]
    bases, stamps = {t["base"] for t in tables}, {t["t_ref"] for t in tables}
    if len(bases) != 1 or len(stamps) != 1:
        raise DataError(f"{path} must have one base and one t_ref, the same in each row; correct it")
    (t_ref,) = _numbers(path, "t_ref", [stamps.pop()], required=True)
    base = files.name(path, "base", bases.pop())
    return plain.calibration(path, base, t_ref or 0.0, [_row(path, t) for t in tables])


def _row(file: Path, table: Mapping[str, str]) -> plain.Row:
    name = files.name(file, "a sensor", table["sensor"])
    if table["has_scale"] not in ("0", "1"):
        raise DataError(f"{file}: has_scale of {name} is {table['has_scale']!r}, neither 0 nor 1; correct it")
    pose = _numbers(file, f"the pose of {name}", [table[key] for key in POSE])
    (skew,) = _numbers(file, f"clock_skew of {name}", [table["clock_skew"]], required=True)
    (dt,) = _numbers(file, f"dt of {name}", [table["dt"]])
    return plain.Row(
        name,
        pose[:3],
        pose[3:],
        dt,
        skew or 0.0,
        _numbers(file, f"sigma of {name}", [table[f"sigma_{key}"] for key in plain.SIGMAS]),
        table["has_scale"] == "1",
    )


def _numbers(file: Path, what: str, cells: Sequence[str], required: bool = False) -> tuple[float | None, ...]:
    try:
        values = [float(cell) if cell or required else None for cell in cells]
    except ValueError as e:
        raise DataError(f"{file}: {what}: {e}; write a number") from e
    return plain.maybe(file, what, values, len(cells))
