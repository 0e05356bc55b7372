"""Odometry in a rig.toml: files of poses in the formats of TUM, KITTI and EuRoC, and tables with titles."""

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from calib_toolkit import DataError, SensorTable, se3, tables
from calib_toolkit.types import Log, MotionReading, PoseReading, Stream, Trajectory
from calib_toolkit_plugins.odometry import noise_of_steps, six_sigmas

Array = NDArray[np.float64]

COLUMNS = {"tum": (8, 8), "euroc": (8, 17), "kitti": (12, 12), "csv": (7, 64)}
"""Fewest and most columns of each format's rows."""
KEYS = ("poses", "format", "times", "has_scale", "motion_sigma", "sigmas")
UNFIT = {"kitti": (), "csv": ("times", "sigmas")}
"""Keys that would be of no use with a format; with those not named, times."""
POSE, MOTION = ("x", "y", "z", "qx", "qy", "qz", "qw"), ("x", "y", "z", "rx", "ry", "rz")
COV = [(i, j, f"cov_{a}_{b}") for i, a in enumerate(MOTION) for j, b in enumerate(MOTION) if i <= j]


def open_table(table: SensorTable) -> Log:
    """The stream of one odometry table of a rig.toml. Raises DataError.

    Keys: ``poses``, ``format`` (tum, euroc, kitti or csv), ``times`` (kitti: a stamp in seconds a line), and at will
    ``has_scale``, ``motion_sigma`` (six numbers: metres and radians of a step; estimated where absent), ``sigmas``
    (a file of such six numbers a row: the step that ends at the pose of that row).
    """
    name, values = table.name, table.values
    tables.refuse_unknown(table, KEYS)
    style, has_scale = values.get("format"), values.get("has_scale", True)
    if style not in COLUMNS:
        raise DataError(f"sensor {name}: format = {style!r} is unknown; write one of {', '.join(COLUMNS)}")
    if not isinstance(has_scale, bool):
        raise DataError(f"sensor {name}: has_scale must be true or false, not {has_scale!r}")
    if unfit := [key for key in UNFIT.get(style, ("times",)) if key in values]:
        raise DataError(f"sensor {name}: {unfit[0]} does not go with format = '{style}'; remove it")
    if style == "csv":
        return _titled(table, tables.table_file(table, "poses"))
    rows = tables.read_rows(tables.table_file(table, "poses"), *COLUMNS[style])
    timed = _rows_beside(table, "times", rows, 1) if style == "kitti" else rows
    ns = tables.to_nanoseconds(timed, "1e-9" if style == "euroc" else "1")
    numbers = tables.to_numbers(rows, COLUMNS[style][0])
    keep, notes = tables.usable_rows(ns, numbers, rows)
    T = _poses(style, numbers[keep], [rows[i] for i in keep])
    epoch_ns = int(ns[keep[0]])
    stamps = tables.seconds(ns[keep], epoch_ns)
    steps = Trajectory(stamps, T, np.zeros((len(T), 6, 6)), np.zeros((len(T), 6, 6))).motions()
    if "sigmas" in values:
        beside = _rows_beside(table, "sigmas", rows, 6)
        sigmas = [six_sigmas(s, row.place) for s, row in zip(tables.to_numbers(beside, 6), beside, strict=True)]
        moved = [MotionReading(v, np.diag(sigmas[i] ** 2)) for v, i in zip(steps.vec, keep[1:], strict=True)]
        stream = Stream(name, "odometry", stamps, [MotionReading(None), *moved], has_scale=has_scale, notes=notes)
        return Log(rows[0].file, {name: stream}, epoch_ns)
    stated = values.get("motion_sigma")
    sigma = noise_of_steps(name, steps) if stated is None else six_sigmas(stated, f"sensor {name}: motion_sigma")
    options = {"motion_sigma": tuple(sigma.tolist())}
    readings = [PoseReading(pose) for pose in T]
    stream = Stream(name, "odometry", stamps, readings, None, has_scale, options=options, notes=notes)
    return Log(rows[0].file, {name: stream}, epoch_ns)


def _rows_beside(table: SensorTable, key: str, rows: Sequence[tables.Row], columns: int) -> list[tables.Row]:
    others = tables.read_rows(tables.table_file(table, key), columns, columns)
    if len(others) != len(rows):
        raise DataError(f"{others[0].file} has {len(others)} rows and {rows[0].file} {len(rows)}; give one each")
    return others


def _poses(style: str, numbers: Array, rows: Sequence[tables.Row]) -> Array:
    """(n, 4, 4) poses; refuses what is further than 1 % from a rotation, and normalises the rest."""
    if style == "kitti":
        M = numbers.reshape(-1, 3, 4)
        R, t = M[:, :, :3], M[:, :, 3]
        gram = R @ np.swapaxes(R, 1, 2) - np.eye(3)
        bad = (np.abs(gram).max(axis=(1, 2)) > 0.02) | (np.linalg.det(R) < 0.0)
    else:
        t, q = numbers[:, 1:4], numbers[:, 4:8]
        bad = np.abs(np.linalg.norm(q, axis=1) - 1.0) > 0.01
    if bad.any():
        what = "matrix is no rotation" if style == "kitti" else "quaternion is not of length one"
        raise DataError(f"{rows[int(np.argmax(bad))].place}: the {what}; is format = '{style}' right?")
    rotation = Rotation.from_matrix(R) if style == "kitti" else Rotation.from_quat(q, scalar_first=style == "euroc")
    return se3.rigid(rotation.as_matrix(), t)


def _titled(table: SensorTable, file: Path) -> Log:
    """A table of poses, or of motions since the row before, whose first line names its columns."""
    titles = _titles(file)
    kind = POSE if "qw" in titles else MOTION
    missing = [c for c in ("stamp", *kind) if c not in titles]
    doubled = [c for c in titles if c in ("stamp", *kind) and titles.count(c) > 1]
    if missing or doubled:
        raise DataError(
            f"{file}: its first line must name the columns, stamp,{','.join(POSE)} for poses or stamp,"
            f"{','.join(MOTION)} for motions, and names '{(missing + doubled)[0]}' "
            f"{'twice' if doubled else 'nowhere'}"
        )
    whole = tables.read_rows(file, 1, COLUMNS["csv"][1])
    rows = whole[1:] if len(whole) > 1 and _title(whole[0].words[0]) == titles[0] else whole
    rows, cut = tables.whole_rows(rows)
    cut = cut or tables.unfinished(file)
    for row in rows:
        if len(row.words) != len(titles):
            raise DataError(f"{row.place}: {len(row.words)} columns where {len(titles)} belong; correct or remove it")
    used = [c for c in ("stamp", *kind, *(name for _, _, name in COV)) if c in titles]
    rows = [row._replace(words=[row.words[titles.index(c)] for c in used]) for row in rows]
    ns = tables.to_nanoseconds(rows, "1e-9" if re.fullmatch("[0-9]{17,19}", rows[0].words[0]) else "1")
    columns = dict(zip(used, tables.to_numbers(rows, len(used)).T, strict=True))
    values = np.stack([columns[c] for c in kind], axis=1)
    cov = _covariances(columns)
    has_scale = table.values.get("has_scale", True)
    options = {}
    if "motion_sigma" in table.values:
        sigma = six_sigmas(table.values["motion_sigma"], f"sensor {table.name}: motion_sigma")
        options["motion_sigma"] = tuple(sigma.tolist())
    if kind == MOTION:
        return _motions(table.name, rows, ns, values, cov, has_scale, options, cut)
    keep, notes = tables.usable_rows(ns, values, rows)
    T = _poses("tum", np.column_stack([np.zeros(len(keep)), values[keep]]), [rows[i] for i in keep])
    told = np.full((len(keep), 6, 6), np.nan) if cov is None else cov[keep]
    readings = [PoseReading(p, c if np.isfinite(c).all() else None) for p, c in zip(T, told, strict=True)]
    epoch_ns = int(ns[keep[0]])
    times = tables.seconds(ns[keep], epoch_ns)
    stream = Stream(table.name, "odometry", times, readings, None, has_scale, options=options, notes=cut + notes)
    return Log(file, {table.name: stream}, epoch_ns)


def _motions(
    name: str,
    rows: Sequence[tables.Row],
    ns: tables.Nanoseconds,
    vec: Array,
    cov: Array | None,
    has_scale: bool,
    options: dict[str, tuple[float, ...]],
    notes: tuple[str, ...],
) -> Log:
    """Motions in a table; a row without numbers is one that failed. None between others may go: the chain breaks."""
    late = np.flatnonzero((ns == tables.BLANK) | np.r_[False, np.diff(ns) <= 0])
    if len(late):
        raise DataError(f"{rows[late[0]].place}: its stamp does not come after the one before it; correct it")
    usable = np.asarray(np.isfinite(vec).all(axis=1))
    if cov is not None:
        usable &= np.isfinite(cov).all(axis=(1, 2))
    readings = [
        MotionReading(vec[k], None if cov is None else cov[k]) if usable[k] else MotionReading(None)
        for k in range(len(rows))
    ]
    stamps = tables.seconds(ns, int(ns[0]))
    stream = Stream(name, "odometry", stamps, readings, None, has_scale, options=options, notes=notes)
    return Log(rows[0].file, {name: stream}, int(ns[0]))


def _covariances(columns: dict[str, Array]) -> Array | None:
    """(n, 6, 6) of columns called cov_x_x to cov_rz_rz; None without them."""
    if not all(name in columns for _, _, name in COV):
        return None
    cov = np.zeros((len(columns["stamp"]), 6, 6))
    for i, j, name in COV:
        cov[:, i, j] = cov[:, j, i] = columns[name]
    return cov


def _titles(file: Path) -> list[str]:
    """Of the first line, which may be a comment, in plain words: ``p_RS_R_x [m]`` is x."""
    try:
        with file.open(encoding="utf-8-sig") as lines:
            line = next((text for text in lines if text.strip(" #\n\r")), "").strip().lstrip("# ")
    except (OSError, UnicodeDecodeError) as e:
        raise DataError(f"{file} can not be read as text ({type(e).__name__}); name a text file") from e
    return [_title(w) for w in (line.split(",") if "," in line else line.split())]


def _title(words: str) -> str:
    plain = re.sub(r"[\[(].*", "", words.strip().lstrip("# ").lower()).strip()
    if plain in ("stamp", "timestamp", "time", "t"):
        return "stamp"
    quaternion = re.fullmatch(r"q_?(?:rs_|wb_|ws_)?([xyzw])", plain)
    position = re.fullmatch(r"(?:p|t|pos|position)?_?(?:rs_r_|rs_s_)?([xyz])", plain)
    return f"q{quaternion[1]}" if quaternion else position[1] if position else plain
