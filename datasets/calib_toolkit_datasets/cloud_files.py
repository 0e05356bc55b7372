"""Clouds of points in files: .pcd, .ply, .bin, .npy, .las and .laz as columns by the names of their fields."""

import logging
import re
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib_toolkit.errors import DataError

SUFFIXES = (".pcd", ".ply", ".bin", ".npy", ".las", ".laz")
FARTHEST, LEAST = 1e8, 1e-30
"""Metres: what is beyond is no place on earth, and what is below (but zero) no length: bytes in another order."""
DENSEST = 4
"""Points a byte that a compressed file can hold."""
HEADER = 65536
"""Bytes within which the header of a file must end."""
PLY_TYPES = {
    "char": "i1",
    "uchar": "u1",
    "short": "i2",
    "ushort": "u2",
    "int": "i4",
    "uint": "u4",
    "float": "f4",
    "double": "f8",
    "int8": "i1",
    "uint8": "u1",
    "int16": "i2",
    "uint16": "u2",
    "int32": "i4",
    "uint32": "u4",
    "float32": "f4",
    "float64": "f8",
}
PCD_TYPES = {f"{t}{s}": f"{t.lower()}{s}" for t, sizes in (("F", "48"), ("I", "1248"), ("U", "1248")) for s in sizes}


def read_columns(file: Path, sensor: str) -> dict[str, NDArray[Any]]:
    """Every field of a cloud, (n,), x, y and z among them. Raises DataError, naming file and sensor.

    .bin: rows of float32 x y z intensity (KITTI), in .pcd.bin also ring (nuScenes). .npy: (n, 3 or more) numbers of
    that order, or a table with names. Nothing in a file is run.
    """
    where = f"{file}: sensor {sensor}: the cloud"
    try:
        columns = _READERS[file.suffix.lower()](file)
        missing = [c for c in "xyz" if c not in columns]
        if missing:
            raise ValueError(f"its points have no field '{missing[0]}'; they have {', '.join(columns) or 'none'}")
        _refuse_garbled(columns)
    except (OSError, ValueError, TypeError, MemoryError, OverflowError, EOFError) as e:
        raise DataError(f"{where} can not be read ({' '.join(str(e).split())[:200]}); restore or remove it") from e
    return columns


@np.errstate(over="ignore", invalid="ignore")
def _refuse_garbled(columns: dict[str, NDArray[Any]]) -> None:
    xyz = np.abs(np.stack([columns[c].astype(np.float64) for c in "xyz"]))
    finite = np.isfinite(xyz)
    if not finite.all(axis=0).any():
        raise ValueError("it holds no points")
    if np.any(xyz[finite] > FARTHEST) or np.any((xyz[finite] < LEAST) & (xyz[finite] > 0)):
        raise ValueError("its coordinates are no metres; is it of another layout or order of bytes?")


def _bin(file: Path) -> dict[str, NDArray[Any]]:
    names = ["x", "y", "z", "intensity", *(["ring"] if file.stem.endswith(".pcd") else [])]
    flat = np.fromfile(file, dtype="<f4")
    if file.stat().st_size % (4 * len(names)):
        raise ValueError(f"its {file.stat().st_size} bytes are no rows of {len(names)} numbers {' '.join(names)}")
    return dict(zip(names, flat.reshape(-1, len(names)).T, strict=True))


def _npy(file: Path) -> dict[str, NDArray[Any]]:
    try:
        table = np.array(np.lib.format.open_memmap(file, mode="r"))  # no pickles, no more than the file holds
    except Exception as e:  # a damaged header makes NumPy raise anything
        raise ValueError(f"{type(e).__name__}: {e}") from e
    if table.dtype.names:
        return {n: table[n].ravel() for n in table.dtype.names if table.dtype[n].kind in "fiu"}
    if table.ndim != 2 or table.shape[1] < 3 or table.dtype.kind not in "fiu":
        raise ValueError(f"it holds {table.dtype} of shape {table.shape}; points are (n, 3) or (n, 4) numbers")
    names = ("x", "y", "z", "intensity")[: table.shape[1]]
    return dict(zip(names, table.T, strict=False))


def _pcd(file: Path) -> dict[str, NDArray[Any]]:
    raw = file.read_bytes()
    head = re.match(rb"(?:[^\n]*\n){0,40}?DATA +(\w+)[ \r]*\n", raw[:HEADER])
    if head is None:
        raise ValueError("it has no header that ends with DATA")
    said = {w[0]: w[1:] for line in head[0].decode("latin-1").splitlines() if (w := line.split())}
    names, sizes, types = (said.get(key, []) for key in ("FIELDS", "SIZE", "TYPE"))
    counts = [int(c) for c in said.get("COUNT", ["1"] * len(names))]
    n = int((said.get("POINTS") or said.get("WIDTH") or ["0"])[0])
    kinds = [PCD_TYPES.get(t + s, "") for t, s in zip(types, sizes, strict=False)]
    fit = len(names) == len(counts) == len(kinds) and all(kinds) and all(0 < c < 10_000 for c in counts)
    if fit and n < 1:
        raise ValueError("it says that it holds no points")
    if not fit:
        raise ValueError("its header does not say fields, sizes, types, counts and points that fit one another")
    if head[1] == b"binary_compressed":
        return _compressed(file)
    numbered = [f"{name} {k}" for k, name in enumerate(names)]
    fields = [(name, kind, (count,)) for name, kind, count in zip(numbered, kinds, counts, strict=True)]
    return _single(_table(raw[head.end() :], fields, n, head[1].decode()))


def _compressed(file: Path) -> dict[str, NDArray[Any]]:
    import open3d

    with open3d.utility.VerbosityContextManager(open3d.utility.VerbosityLevel.Error):
        cloud = open3d.t.io.read_point_cloud(file)
    columns = {k: np.asarray(cloud.point[k].numpy()) for k in cloud.point}
    if "positions" not in columns:
        raise ValueError("its compressed points can not be unpacked")
    named = dict(zip("xyz", columns.pop("positions").T, strict=True))
    return named | {k: v.ravel() for k, v in columns.items() if v.size == len(v)}


def _ply(file: Path) -> dict[str, NDArray[Any]]:
    raw = file.read_bytes()
    head = re.match(rb"ply\r?\n(?:[^\n]*\n){1,200}?end_header\r?\n", raw[:HEADER])
    if head is None:
        raise ValueError("it has no header that ends with end_header")
    lines = [w for line in head[0].decode("latin-1").splitlines() if (w := line.split())]
    style = next((w[1] for w in lines if w[0] == "format" and len(w) > 1), "")
    first = next((k for k, w in enumerate(lines) if w[0] == "element"), len(lines))
    if first == len(lines) or len(lines[first]) != 3 or lines[first][1] != "vertex":
        raise ValueError("its first element is not 'vertex'")
    fields: list[tuple[str, str, tuple[int]]] = []
    for words in lines[first + 1 :]:
        if words[0] in ("element", "end_header"):
            break
        if words[0] == "property":
            if len(words) != 3 or words[1] not in PLY_TYPES:
                raise ValueError(f"its property '{' '.join(words[1:])}' is no single number")
            fields.append((f"{words[2]} {len(fields)}", PLY_TYPES[words[1]], (1,)))
    big = style == "binary_big_endian"
    if style not in ("ascii", "binary_little_endian") and not big:
        raise ValueError(f"its format '{style}' is unknown")
    fields = [(name, (">" if big else "<") + kind, shape) for name, kind, shape in fields]
    return _single(_table(raw[head.end() :], fields, int(lines[first][2]), "ascii" if style == "ascii" else "binary"))


def _table(body: bytes, fields: list[tuple[str, str, tuple[int]]], n: int, style: str) -> NDArray[Any]:
    """(n,) rows of numbers, as text or as bytes."""
    kind = np.dtype(fields)
    if n < 1 or kind.itemsize == 0:
        raise ValueError("it says that it holds no points")
    if style == "binary":
        if n * kind.itemsize > len(body):
            raise ValueError(f"it says {n} points of {kind.itemsize} bytes and holds {len(body)} bytes of them")
        return np.frombuffer(body, kind, n)
    if style != "ascii":
        raise ValueError(f"its data are '{style}', which is not read")
    columns = sum(shape[0] for _, _, shape in fields)
    words = body.split()
    if n * columns > len(words):
        raise ValueError(f"it says {n} points of {columns} numbers and holds {len(words)} numbers")
    wide = np.dtype([(name, "f8", shape) for name, _, shape in fields])
    return np.array(words[: n * columns], dtype=np.float64).view(wide)


def _single(table: NDArray[Any]) -> dict[str, NDArray[Any]]:
    """Fields of one number by name; padding, called _, is not one. Of two of one name the first counts."""
    found: dict[str, NDArray[Any]] = {}
    for name in table.dtype.names or ():
        plain = name.rpartition(" ")[0]
        if table[name].shape[1] == 1 and plain != "_":
            found.setdefault(plain, table[name][:, 0])
    return found


def _las(file: Path) -> dict[str, NDArray[Any]]:
    try:
        import laspy
    except ImportError as e:
        raise DataError(f"{file} can not be read without laspy; pip install 'calib-toolkit[las]'") from e
    logging.getLogger("laspy").setLevel(logging.CRITICAL)  # what it says of damage, our sentence says
    try:
        _refuse_endless(file)
        with laspy.open(file) as opened:
            if not 0 < opened.header.point_count <= DENSEST * file.stat().st_size:
                raise ValueError(f"it says {opened.header.point_count} points in {file.stat().st_size} bytes")
            cloud = opened.read()
        columns = {c: np.asarray(getattr(cloud, c), dtype=np.float64) for c in "xyz"}
        there = set(cloud.point_format.dimension_names)
        return columns | {c: np.asarray(cloud[c]) for c in ("intensity", "gps_time", "ring") if c in there}
    except (KeyboardInterrupt, SystemExit):
        raise
    except BaseException as e:  # a damaged file makes laspy raise anything, and its unpacker panic
        raise ValueError(f"{type(e).__name__}: {e}") from e


def _refuse_endless(file: Path) -> None:
    """Unpackers make room for as many chunks as a .laz says, and end the process where there is none."""
    raw = np.memmap(file, np.uint8, "r")
    if len(raw) < 105 or not raw[104] & 128:
        return  # not packed, or no header at all, which laspy says better
    at = int(raw[96:100].view("<u4")[0])
    table = int.from_bytes(raw[at : at + 8].tobytes(), "little", signed=True)
    if table == -1:  # what was written without going back has the place at its end
        table = int.from_bytes(raw[-8:].tobytes(), "little", signed=True)
    chunks = int.from_bytes(raw[table + 4 : table + 8].tobytes(), "little") if 0 < table < len(raw) else 0
    if chunks > len(raw):
        raise ValueError(f"it says {chunks} chunks in {len(raw)} bytes")


_READERS = {".bin": _bin, ".npy": _npy, ".pcd": _pcd, ".ply": _ply, ".las": _las, ".laz": _las}
