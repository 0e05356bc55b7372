"""Clock offsets in a file of their own, where a format has no place for them."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from calib_toolkit import Calibration
from calib_toolkit.errors import DataError
from calib_toolkit_plugins.exporters import files


def beside(path: Path) -> Path:
    """Where the clock offsets are: ``rig.urdf.clocks.yaml`` of ``rig.urdf``, ``clocks.yaml`` in a folder."""
    return path / "clocks.yaml" if path.is_dir() else path.with_name(f"{path.name}.clocks.yaml")


def sentence(path: Path) -> str:
    """Where they are, for the comments of a file that does not have them."""
    return f"Clock offsets: in {beside(path).name}, for this format has no place for them."


def meaning(base: str) -> str:
    """What the numbers mean."""
    return (
        f"dt is added to a sensor's stamp to get the time of {base}'s clock: "
        "t = stamp + dt + clock_skew * (stamp - t_ref), seconds; a sensor that stamps late has a negative dt; "
        "null is not determined"
    )


def write(c: Calibration, path: Path) -> None:
    """The offsets of the calibration that was written to a path, beside it."""
    sensors = {
        name: {"dt": float(c.dt_base_sensor[i]) if c.determined[i, 6] else None, "clock_skew": float(c.clock_skew[i])}
        for i, name in enumerate(c.names)
        if name != c.base
    }
    files.write_yaml(
        beside(path),
        [f"Clock offsets of the rig in {path.name}", meaning(c.base)],
        {"base": c.base, "t_ref": float(c.t_ref), "sensors": sensors},
    )


def read(c: Calibration, path: Path) -> Calibration:
    """A calibration with the offsets that lie beside its file, if they do. Raises DataError."""
    file = beside(path)
    if not file.is_file():
        return c
    content = files.load_yaml(file)
    base, sensors = (files.entry(file, "it", content, key) for key in ("base", "sensors"))
    t_ref = files.number(file, "t_ref", files.entry(file, "it", content, "t_ref"))
    if not isinstance(sensors, dict) or {base, *sensors} != set(c.names) or base in sensors:
        raise DataError(
            f"{file} has the clocks of {', '.join(map(str, [base, *sensors]))}, and {path} the poses of "
            f"{', '.join(c.names)}; export both again, or remove {file.name} to do without clock offsets"
        )
    dt, skew = np.zeros(len(c.names)), np.zeros(len(c.names))
    known = c.determined.copy()
    for name, table in sensors.items():
        i, told = c.index(name), files.entry(file, name, table, "dt")
        skew[i] = files.number(file, f"clock_skew of {name}", files.entry(file, name, table, "clock_skew"))
        known[i, 6] = told is not None
        dt[i] = files.number(file, f"dt of {name}", told) if told is not None else 0.0
    known[c.index(base), 6] = True
    first = c.index(c.base)
    known[:, 6] &= known[first, 6]
    known[first, 6] = True
    return replace(c, dt_base_sensor=dt - dt[first], clock_skew=skew - skew[first], determined=known, t_ref=t_ref)
