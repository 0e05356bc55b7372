"""What is finished, on disk: a table that grows row by row and the settings it was made with.

A kill loses at most what was running: rows of one repeat are written and flushed together, and what a kill cut off
is dropped at the next start. At the end the table is put in the order of the plan.
"""

import csv
import io
import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any

from calib_toolkit.errors import DataError

Row = Mapping[str, str]


def writable(folder: Path) -> None:
    """Make the folder. Raises DataError if it can not take the results."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with TemporaryFile(dir=folder):
            return
    except OSError as e:
        raise DataError(f"{folder} can not take the results ({e.strerror or e}); choose another with -o") from e


class Store:
    """The table and the settings of one experiment in a folder. Raises DataError if they are of another one."""

    def __init__(self, folder: Path, name: str, settings: Mapping[str, Any], columns: Sequence[str]) -> None:
        self.columns = tuple(columns)
        self.table, self.settings = folder / f"{name}.csv", folder / f"{name}.json"
        writable(folder)
        self._agree(json.loads(json.dumps(settings)))

    def read(self) -> list[Row]:
        """The rows that are whole, as written."""
        if not self.table.exists():
            return []
        whole = self.table.read_text(encoding="utf-8", errors="replace").rpartition("\n")[0]
        titles, *rows = csv.reader(io.StringIO(whole)) if whole else [[]]
        if tuple(titles) != self.columns and whole:
            raise DataError(f"{self.table} has other columns than this experiment; delete it, or choose another -o")
        return [dict(zip(self.columns, row, strict=True)) for row in rows if len(row) == len(self.columns)]

    def append(self, rows: Iterable[Row]) -> None:
        """Add finished rows."""
        with self.table.open("a", encoding="utf-8", newline="") as file:
            file.write(self._text(rows))

    def rewrite(self, rows: Iterable[Row]) -> None:
        """The table with these rows and no others; whole or not at all."""
        self._replace(self.table, ",".join(self.columns) + "\n" + self._text(rows))

    def _text(self, rows: Iterable[Row]) -> str:
        text = io.StringIO()
        csv.DictWriter(text, self.columns, lineterminator="\n").writerows(rows)
        return text.getvalue()

    def _agree(self, settings: dict[str, Any]) -> None:
        if not self.settings.exists():
            if self.table.exists():
                raise DataError(
                    f"{self.table} is there without its settings {self.settings.name}; move it, or choose another "
                    "folder with -o"
                )
            self._replace(self.settings, json.dumps(settings, indent=1) + "\n")
            return
        try:
            before = dict(json.loads(self.settings.read_text(encoding="utf-8")))
        except (ValueError, TypeError) as e:
            raise DataError(
                f"{self.settings} can not be read ({e}); delete it with its table, or choose another -o"
            ) from e
        for key in sorted(settings.keys() | before.keys()):
            if settings.get(key) != before.get(key):
                raise DataError(
                    f"{self.table} was begun with {key} = {_short(before.get(key))}, and this is "
                    f"{_short(settings.get(key))}; give the same, or choose another folder with -o"
                )

    @staticmethod
    def _replace(file: Path, text: str) -> None:
        part = file.with_suffix(file.suffix + ".part")
        part.write_text(text, encoding="utf-8", newline="")
        part.replace(file)


def _short(value: Any) -> str:
    text = json.dumps(value)
    return text if len(text) <= 80 else f"{text[:77]}..."
