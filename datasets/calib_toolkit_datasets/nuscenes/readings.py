"""Sweeps of nuScenes' lidars: points in files, and when each was measured."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calib_toolkit import Scan
from calib_toolkit.errors import DataError

COLUMNS = 5
"""float32 x, y, z, intensity and ring of each point."""


@dataclass(frozen=True)
class SweepFile:
    """Key of one sweep. period: seconds of a turn, nan if not known.

    times: file of the time of each point, None to tell it from the order of the points, "" for a sweep without.
    """

    path: Path
    period: float
    times: Path | str | None = None


def load_sweep(key: SweepFile, sensor: str) -> Scan:
    """One sweep. Raises DataError, naming file and sensor, if it is missing, empty, cut short or not finite."""
    where, remedy = f"{key.path}: sensor {sensor}", "fetch the file again, or remove it to do without this sweep"
    rows = _floats(key.path, sensor, COLUMNS).reshape(-1, COLUMNS)
    if not len(rows):
        raise DataError(f"{where}: the sweep holds no points; {remedy}")
    bad = ~np.all(np.isfinite(rows), axis=1)
    if np.any(bad):
        raise DataError(f"{where}: {int(bad.sum())} points are not numbers, first {bad.argmax()}; {remedy}")
    ring = rows[:, 4]
    known = bool(np.all((ring >= 0) & (ring < 2**16) & (ring % 1 == 0)))
    times = column_times(ring, key.period)
    if isinstance(key.times, Path):
        times = _floats(key.times, sensor, 1)
        if len(times) != len(rows) or not np.isfinite(times).all():
            raise DataError(f"{key.times}: sensor {sensor}: it must hold {len(rows)} times, one a point; {remedy}")
    elif key.times == "":
        times = None
    points, intensity = np.ascontiguousarray(rows[:, :3]), np.ascontiguousarray(rows[:, 3])
    return Scan(points, times, intensity, ring.astype(np.int32) if known else None)


def write_sweep(scan: Scan, path: Path) -> Path | None:
    """A sweep as nuScenes has them; the file of the times of its points beside it, if they are known.

    Intensity is 0 and ring -1 where there is none.
    """
    n = len(scan.points)
    intensity = np.zeros(n) if scan.intensity is None else scan.intensity
    ring = np.full(n, -1) if scan.ring is None else scan.ring
    path.write_bytes(np.column_stack([scan.points, intensity, ring]).astype("<f4").tobytes())
    if scan.times is None:
        return None
    times = path.with_name(f"{path.name.partition('.')[0]}.times.bin")
    times.write_bytes(np.asarray(scan.times, dtype="<f4").tobytes())
    return times


def column_times(ring: NDArray[np.float32], period: float) -> NDArray[np.float32] | None:
    """When each point was measured, seconds from the stamp, (n,); None where their order does not tell. ring: (n,).

    nuScenes keeps every firing of the HDL-32E in the order of measuring: columns of all beams, the same in each.
    Its makers stamp the end of the turn: column k of m lies ``(k + 1/2) / m - 1`` turns from the stamp.
    """
    beams = len(np.unique(ring))
    if np.isnan(period) or beams < 2 or len(ring) % beams or len(ring) == beams:
        return None
    columns = ring.reshape(-1, beams)
    if np.any(columns != columns[0]) or len(np.unique(columns[0])) < beams:
        return None
    turns = (np.arange(len(columns)) + 0.5) / len(columns) - 1.0
    return np.repeat(turns * period, beams).astype(np.float32)


def _floats(path: Path, sensor: str, columns: int) -> NDArray[np.float32]:
    remedy = "fetch the file again, or remove it to do without this sweep"
    try:
        size = path.stat().st_size
        if size % (4 * columns):
            whole = f"a whole number of points of {4 * columns} bytes"
            raise DataError(f"{path}: sensor {sensor}: its {size} bytes are not {whole}; {remedy}")
        return np.fromfile(path, dtype="<f4")
    except OSError as e:
        raise DataError(f"{path}: sensor {sensor}: it can not be read ({e.strerror or e}); {remedy}") from e
