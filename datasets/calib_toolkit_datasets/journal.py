"""What a conversion has written so far, so that it goes on where it was stopped."""

import json
from pathlib import Path
from types import TracebackType
from typing import Any

from calib_toolkit import Progress, Stream

FILE = ".written.jsonl"

Fact = dict[str, Any]
"""What was noted of a reading once it was written, in plain values."""


class Journal:
    """One line a reading, written after the reading itself; it is removed at the end of a conversion.

    A line that a kill cut short counts as not written.
    """

    def __init__(self, folder: Path) -> None:
        """Of a conversion into a folder, which is made if it is not there."""
        folder.mkdir(parents=True, exist_ok=True)
        self._file = folder / FILE
        self._known: dict[tuple[str, int], Fact] = {}
        self._lines = self._file.open("a+b")

    def __enter__(self) -> "Journal":
        self._lines.seek(0)
        whole = 0
        for line in self._lines:
            try:
                name, k, fact = json.loads(line)
                self._known[str(name), int(k)] = dict(fact)
            except (ValueError, TypeError):
                break
            whole += len(line)
        self._lines.truncate(whole)
        self._lines.seek(whole)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None
    ) -> None:
        self._lines.close()
        if kind is None:
            self._file.unlink()

    def begin(self, stream: Stream, progress: Progress) -> None:
        """Tell the progress of a stream's readings, those of an earlier call as done."""
        progress.begin(stream.name, len(stream), sum(name == stream.name for name, _ in self._known))

    def known(self, stream: Stream, k: int) -> Fact | None:
        """What was noted of a reading, or None if it is not written."""
        return self._known.get((stream.name, k))

    def note(self, stream: Stream, k: int, fact: Fact) -> None:
        """Keep that a reading is written."""
        self._lines.write(json.dumps([stream.name, k, fact]).encode() + b"\n")
        self._lines.flush()
