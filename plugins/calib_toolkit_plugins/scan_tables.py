"""Scans in a rig.toml: folders of clouds, their stamps, and the time of each point."""

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib_toolkit import DataError, LazyReadings, Log, Scan, SensorTable, Stream, tables

KEYS = ("scans", "times", "turns")
TURNS = {"clockwise": -1.0, "counterclockwise": 1.0}
SUFFIXES = (".bin", ".npy", ".ply", ".pcd")
COLUMNS = ("x", "y", "z", "intensity", "time", "ring")


def open_table(table: SensorTable) -> Log:
    """The stream of one velodyne table of a rig.toml. Raises DataError.

    Keys: ``scans``, a folder of .bin (KITTI: float32 x y z intensity), .npy ((n, 3 or 4), or a table with columns
    x y z and at will intensity, time and ring), .ply or .pcd files;
    ``times``, a file with the stamp of each, in the order of their names, as seconds or as KITTI's dates; at
    will ``turns = "clockwise"`` (seen from above) or ``"counterclockwise"``, which gives each point its time
    from its azimuth, the stamp being when the scanner looks along x.
    """
    tables.refuse_unknown(table, KEYS)
    where, turns = f"sensor {table.name}", table.values.get("turns")
    folder, times = tables.table_folder(table, "scans"), tables.table_file(table, "times")
    if turns is not None and turns not in TURNS:
        raise DataError(f"{where}: turns = {turns!r} is not known; write one of {', '.join(TURNS)}, or leave it out")
    files = sorted(f for f in folder.iterdir() if f.suffix in SUFFIXES)
    if not files:
        raise DataError(f"{where}: {folder} holds no scans ({', '.join(SUFFIXES)})")
    ns = tables.read_stamps(times)
    if len(ns) != len(files):
        raise DataError(f"{where}: {times} holds {len(ns)} stamps and {folder} {len(files)} scans; each needs one")
    if tables.BLANK in ns:
        line = ns.tolist().index(tables.BLANK) + 1
        raise DataError(f"{where}: {times}, line {line} holds no stamp; write one, or remove it and its scan")
    stamps = tables.seconds(ns, int(ns[0]))
    period = float(np.median(np.diff(stamps))) if len(stamps) > 1 else 0.0
    load = partial(_load, rate=TURNS[turns] * period / (2 * np.pi) if turns else None)
    stream = Stream(table.name, "velodyne", stamps, LazyReadings(load, files), notes=tables.unfinished(times))
    return Log(times, {table.name: stream}, int(ns[0]))


def _load(file: Path, rate: float | None) -> Scan:
    """One scan file. rate: seconds per radian of azimuth, or None."""
    try:
        rows = _rows(file)
    except ImportError as e:
        raise DataError(f"{file} can not be read without Open3D ({e}); run script/setup or write .npy files") from e
    except (OSError, ValueError) as e:
        raise DataError(f"{file} is not a scan ({e}); write it anew or remove it with its stamp") from e
    names = rows.dtype.names
    if names is None and rows.ndim == 2:
        columns = dict(zip(COLUMNS[:4], rows.T, strict=False))
    else:
        columns = {c: rows[c].ravel() for c in COLUMNS if c in (names or ())}
    if any(c not in columns for c in "xyz") or any(column.dtype.kind not in "fiu" for column in columns.values()):
        raise DataError(f"{file} holds {rows.dtype} of shape {rows.shape}; a scan is (n, 3) or (n, 4) numbers")
    return _scan(columns, file, rate)


@np.errstate(over="ignore", invalid="ignore")
def _scan(columns: Mapping[str, NDArray[Any]], file: Path, rate: float | None) -> Scan:
    """x, y, z and at will intensity, time (seconds from the stamp) and ring; points that are nowhere are left out."""
    points = np.stack([columns[c] for c in "xyz"], axis=-1).astype(np.float32)
    keep = np.isfinite(points).all(axis=1)
    if not keep.any():
        raise DataError(f"{file} holds no points; write it anew or remove it with its stamp")
    time, intensity, ring = (columns[c][keep] if c in columns else None for c in ("time", "intensity", "ring"))
    points = points[keep]
    if time is None and rate is not None:
        time = rate * np.arctan2(points[:, 1], points[:, 0])
    return Scan(
        points,
        None if time is None else time.astype(np.float32),
        None if intensity is None else intensity.astype(np.float32),
        None if ring is None else ring.astype(np.int32),
    )


def _rows(file: Path) -> NDArray[Any]:
    if file.suffix == ".bin":
        flat = np.fromfile(file, dtype="<f4")
        if flat.size % 4:
            raise ValueError(f"{flat.size} numbers are not rows of four; it seems cut short")
        return flat.reshape(-1, 4)
    if file.suffix == ".npy":
        try:
            return np.array(np.lib.format.open_memmap(file, mode="r"))  # no pickles, no more than the file holds
        except Exception as e:  # a damaged header makes NumPy raise anything
            raise ValueError(f"{type(e).__name__}: {e}") from e
    import open3d

    cloud = open3d.io.read_point_cloud(file)
    if not cloud.has_points():
        raise ValueError("Open3D finds no points in it")
    return np.asarray(cloud.points)
