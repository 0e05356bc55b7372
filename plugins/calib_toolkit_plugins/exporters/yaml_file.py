"""Plain YAML, for programs of one's own: every number by name, null where it was not determined."""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from calib_toolkit import Calibration, CameraIntrinsics, Exporter, hookimpl
from calib_toolkit.errors import DataError
from calib_toolkit_plugins.exporters import files, plain


@hookimpl
def calib_register_exporters() -> list[Exporter]:
    """The ``yaml`` exporter."""
    loses = "correlations of errors, reasons why a number was not determined"
    looks_for = "YAML with quaternion_xyzw"
    return [Exporter("yaml", write, read, looks_for, matches, loses, holds_unknown=True)]


def matches(path: Path) -> bool:
    """Whether a file is YAML as :func:`write` writes it."""
    return bool(re.search(r"^\s+quaternion_xyzw\s*:", files.head(path), re.MULTILINE))


def write(c: Calibration, path: Path, intrinsics: Mapping[str, CameraIntrinsics]) -> None:
    """One table for each sensor, and the intrinsics of cameras whose are known."""
    sensors = {}
    for row in plain.rows(c):
        camera = intrinsics.get(row.name)
        sensors[row.name] = {
            "translation": list(row.translation),
            "quaternion_xyzw": list(row.quaternion),
            "dt": row.dt,
            "clock_skew": row.clock_skew,
            "sigma": dict(zip(plain.SIGMAS, row.sigma, strict=True)),
            "has_scale": row.has_scale,
            **({} if camera is None else {"K": camera.K.tolist(), "distortion": camera.distortion.tolist()}),
        }
    files.write_yaml(path, ["Calibration", *plain.meaning(c)], {"base": c.base, "t_ref": c.t_ref, "sensors": sensors})


def read(path: Path) -> Calibration:
    """The calibration, its covariance diagonal. Raises DataError."""
    content = files.load_yaml(path)
    sensors = files.entry(path, "it", content, "sensors")
    base = files.name(path, "base", files.entry(path, "it", content, "base"))
    if not isinstance(sensors, dict):
        raise DataError(f"{path}: sensors is no table of sensors; correct it")
    t_ref = files.number(path, "t_ref", content.get("t_ref", 0.0))
    return plain.calibration(path, base, t_ref, [_row(path, name, table) for name, table in sensors.items()])


def _row(file: Path, name: Any, table: Any) -> plain.Row:
    name = files.name(file, "a sensor", name)
    shift, turn = (files.entry(file, name, table, key) for key in ("translation", "quaternion_xyzw"))
    sigma = table.get("sigma") or {}
    scaled = table.get("has_scale", True)
    if not isinstance(sigma, dict) or not isinstance(scaled, bool):
        raise DataError(f"{file}: sigma of {name} is no table, or has_scale neither true nor false; correct it")
    (dt,) = plain.maybe(file, f"dt of {name}", [table.get("dt")], 1)
    return plain.Row(
        name,
        plain.maybe(file, f"translation of {name}", shift, 3),
        plain.maybe(file, f"quaternion of {name}", turn, 4),
        dt,
        files.number(file, f"clock_skew of {name}", table.get("clock_skew", 0.0)),
        plain.maybe(file, f"sigma of {name}", [sigma.get(key) for key in plain.SIGMAS], 7),
        scaled,
    )
