"""The tables of nuScenes: a list of rows in each JSON file, read row by row, so that their size does not matter."""

import json
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from decimal import Decimal
from pathlib import Path
from typing import Any, NoReturn, TextIO

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from calib_toolkit import CameraIntrinsics, se3, tables
from calib_toolkit.errors import DataError

Array = NDArray[np.float64]

VERSIONS = "v1.0-*"
"""Folders of tables."""
BLOCK = 2**20
LARGEST_ROW = 2**24
"""Characters of a row that are held in memory; more is a damaged table."""
BLANK = re.compile(r"[ \t\r\n]*")
NAME = re.compile(r"[\w-]+")
"""What a channel may be called."""
FARTHEST = 1e7
"""Metres along an axis; what is farther is damaged."""
UNIT = 1e-3
"""By how much the length of a quaternion may differ from one."""


@dataclass(frozen=True)
class Row:
    """One row of a table, counted from 0, and where it is. What it is asked for and is not, raises DataError."""

    file: Path
    number: int
    values: dict[str, Any]

    @property
    def place(self) -> str:
        """File and row, as sentences begin with them."""
        return f"{self.file}, row {self.number}"

    def text(self, key: str) -> str:
        """A text that is not empty and can be printed."""
        value = self.values.get(key)
        return value if isinstance(value, str) and value and value.isprintable() else self._refuse(key, "a text")

    def numbers(self, key: str, *shape: int) -> Array:
        """Finite numbers of that shape; -1 is any length."""
        try:
            array = np.asarray(self.values.get(key))
        except ValueError:
            array = np.zeros(0, dtype=object)
        fits = len(shape) == array.ndim and all(want in (-1, n) for want, n in zip(shape, array.shape, strict=True))
        if not fits or (array.size and (array.dtype.kind not in "iuf" or not np.isfinite(array).all())):
            self._refuse(key, f"{'x'.join(str(n) for n in shape if n > 0) or 'a list of'} finite numbers")
        return array.astype(np.float64)

    def stamp(self) -> int:
        """Nanoseconds of ``timestamp``, which is in microseconds; ``BLANK`` for zero."""
        value = self.values.get("timestamp")
        if isinstance(value, bool) or not isinstance(value, int | float) or not 0 <= value < np.inf:
            self._refuse("timestamp", "microseconds")
        if value > tables.LATEST * 10**6:
            raise DataError(
                f"{self.place}: the stamp {value!r} is beyond any clock in microseconds, which nuScenes has; "
                "convert the stamps of all tables"
            )
        return round(Decimal(value) * 1000) or tables.BLANK

    def pose(self) -> Array:
        """(4, 4) of ``translation`` (metres) and ``rotation`` (quaternion w x y z)."""
        t, (w, x, y, z) = self.numbers("translation", 3), self.numbers("rotation", 4)
        if max(map(abs, (w, x, y, z))) > 2 or abs(np.linalg.norm([w, x, y, z]) - 1) > UNIT:
            self._refuse("rotation", "a quaternion w x y z of length one")
        if np.any(np.abs(t) > FARTHEST):
            self._refuse("translation", "a place on earth, in metres")
        return se3.rigid(Rotation.from_quat([x, y, z, w]).as_matrix(), t)

    def _refuse(self, key: str, wanted: str) -> NoReturn:
        is_there = f"is {str(self.values[key])[:60]!r}" if key in self.values else "is missing"
        raise DataError(f"{self.place}: '{key}' must be {wanted}, and {is_there}; fetch the table again")


@dataclass(frozen=True)
class Place:
    """Where a scene is. root: what ``filename`` starts from, links followed. tables: their folder.

    scene: its name, "" for the only one.
    """

    root: Path
    tables: Path
    scene: str = ""

    def rows(self, name: str) -> Iterator[Row]:
        """The rows of the table of that name. Raises DataError; the file and the row are named."""
        return read_rows(self.tables / f"{name}.json")

    def file(self, row: Row, key: str) -> Path:
        """The file that a row names, from the root. Raises DataError for one that is not below it."""
        name = row.text(key)
        try:
            real = Path(os.path.realpath(self.root / name))
        except ValueError:
            real = Path()
        if not real.is_relative_to(self.root):
            raise DataError(
                f"{row.place}: {name[:80]!r} lies outside {self.root}; put the file there and correct the row"
            )
        return real


@dataclass(frozen=True)
class Found:
    """A sensor's readings, as a stream has them. ns: (n,) nanoseconds, increasing."""

    kind: str
    ns: tables.Nanoseconds
    readings: Sequence[Any]
    intrinsics: CameraIntrinsics | None = None
    notes: tuple[str, ...] = ()
    topic: str = ""


def matches(path: Path) -> bool:
    """Whether a folder has tables of nuScenes, is a folder of them, or names a scene that such a folder may have."""
    path = path.absolute()
    return bool(_versions(path) or (not os.path.lexists(path) and _versions(path.parent)))


def locate(path: Path) -> Place:
    """What a path names: ``ROOT``, ``ROOT/v1.0-mini``, or either with ``/SCENE`` behind it. Raises DataError."""
    path = path.absolute()
    folder, scene = (path, "") if path.exists() else (path.parent, path.name)
    versions = _versions(folder)
    if len(versions) != 1:
        names = ", ".join(v.name for v in versions) or "none"
        raise DataError(
            f"{folder} has {len(versions)} folders {VERSIONS} with a scene.json ({names}); name one of them"
        )
    return Place(versions[0].parent.resolve(), versions[0], scene)


def read_rows(file: Path) -> Iterator[Row]:
    """The rows of a table, of which one at a time is in memory. Raises DataError."""
    number = -1
    try:
        with file.open(encoding="utf-8-sig") as f:
            for number, values in enumerate(_objects(f)):
                yield Row(file, number, values)
    except OSError as e:
        raise DataError(f"{file} can not be read ({e.strerror or e}); fetch the table again") from e
    except (ValueError, RecursionError) as e:
        raise DataError(f"{file} is damaged after row {number} ({e}); fetch the table again") from e


def _objects(f: TextIO) -> Iterator[dict[str, Any]]:
    """The objects of a list in JSON. Raises ValueError."""
    text = _Text(f)
    mark = text.take()
    if mark != "[":
        raise ValueError("it is no list of rows")
    while mark != "]":
        if mark == "[" and text.peek() == "]":
            mark = text.take()
            continue
        yield text.row()
        mark = text.take()
        if mark not in {",", "]"}:
            raise ValueError("it ends before its list does" if not mark else f"'{mark}' stands where a comma belongs")
    if text.peek():
        raise ValueError("it goes on behind its list")


class _Text:
    """A file's characters, of which a block at a time is in memory."""

    def __init__(self, f: TextIO) -> None:
        self.f, self.text, self.at = f, "", 0
        self.decode = json.JSONDecoder(parse_constant=_no_constant).raw_decode

    def peek(self) -> str:
        """The next character that is not blank, "" at the end."""
        while self.at < len(self.text) or self._more():
            self.at = BLANK.match(self.text, self.at).end()  # type: ignore[union-attr]  # matches nothing, too
            if self.at < len(self.text):
                return self.text[self.at]
        return ""

    def take(self) -> str:
        """The next character that is not blank, and go on behind it."""
        character = self.peek()
        self.at += 1
        return character

    def row(self) -> dict[str, Any]:
        """The next object. Raises ValueError."""
        if self.peek() != "{":
            raise ValueError("a row is missing")
        while True:
            try:
                values, self.at = self.decode(self.text, self.at)
                return values
            except json.JSONDecodeError as e:
                if len(self.text) - self.at > LARGEST_ROW or not self._more():
                    raise ValueError(e.msg) from e

    def _more(self) -> bool:
        """Read a block, what comes before being forgotten; whether there was one."""
        block = self.f.read(BLOCK)
        self.text, self.at = self.text[self.at :] + block, 0
        return bool(block)


def _no_constant(name: str) -> NoReturn:
    raise ValueError(f"{name} is no number")


def _versions(path: Path) -> list[Path]:
    """Folders of tables: a path itself, or those in it."""
    try:
        folders = [path] if path.match(VERSIONS) else sorted(path.glob(VERSIONS))
        return [f for f in folders if os.path.isfile(f / "scene.json")]
    except (OSError, ValueError):
        return []


class TableWriter:
    """Tables that grow row by row, so that none is held in memory; each is closed at the end.

    empty: those that have no rows.
    """

    def __init__(self, folder: Path, empty: Sequence[str] = ()) -> None:
        self.folder, self.files = folder, dict[str, TextIO]()
        for name in empty:
            self._file(name)

    def __enter__(self) -> "TableWriter":
        return self

    def __exit__(self, *_: object) -> None:
        for file in self.files.values():
            file.write("\n]\n")
            file.close()

    def __call__(self, table: str, row: Mapping[str, Any]) -> None:
        known, file = table in self.files, self._file(table)
        file.write((",\n" if known else "\n") + json.dumps(row, allow_nan=False))

    def _file(self, name: str) -> TextIO:
        if name not in self.files:
            self.files[name] = (self.folder / f"{name}.json").open("w", encoding="utf-8")
            self.files[name].write("[")
        return self.files[name]
