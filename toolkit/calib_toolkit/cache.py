"""Motions and pairs that were estimated before, kept on disk under a hash of everything they came from."""

import json
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import fields, is_dataclass
from functools import partial
from pathlib import Path
from types import FunctionType, MethodType
from typing import IO, Any
from zlib import crc32

import joblib
import numpy as np

from calib_toolkit.types import LazyReadings, Motions, PairEstimate, Trajectory, Transform

FORMAT = 2
"""Raised when what is stored changes shape."""


def default_folder() -> Path:
    """``$CALIB_TOOLKIT_CACHE``, or the user's cache folder."""
    chosen = os.environ.get("CALIB_TOOLKIT_CACHE")
    if chosen:
        return Path(chosen)
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "calib-toolkit"


def key_of(*parts: Any) -> str:
    """One hash of anything picklable. A file counts by name, size, time of change and its first and last 4 KiB."""
    return str(joblib.hash([FORMAT, *(_plain(p) for p in parts)]))


def load(folder: Path, key: str) -> tuple[Motions | Trajectory, tuple[str, ...]] | None:
    """What was stored under a key, or None; a damaged file counts as none."""
    try:
        with _file(folder, key).open("rb") as file, np.load(file, allow_pickle=False) as stored:
            kinds: dict[str, type[Motions] | type[Trajectory]] = {"Motions": Motions, "Trajectory": Trajectory}
            kind = kinds[str(stored["kind"])]
            values = {f.name: stored[f.name] for f in fields(kind)}
            values |= {name: values[name].item() for name in values if values[name].ndim == 0}
            return kind(**values), tuple(str(n) for n in stored["notes"])
    except Exception:  # whatever a damaged file makes of itself, the motion can be estimated again
        return None


def store(folder: Path, key: str, motion: Motions | Trajectory, notes: Sequence[str]) -> None:
    """Keep a motion; whole or not at all, so that a kill leaves nothing half-written."""
    values = {f.name: np.asarray(getattr(motion, f.name)) for f in fields(motion)}
    with _whole(_file(folder, key)) as f:
        np.savez(
            f, allow_pickle=False, kind=np.array(type(motion).__name__), notes=np.array(notes, dtype=str), **values
        )


def load_pair(folder: Path, key: str) -> PairEstimate | None:
    """What was stored of a pair under a key, or None; a damaged file counts as none."""
    try:
        stored = json.loads(_file(folder, key, "json").read_text())
        pose: dict[str, Any] = {
            k: np.array(v) if isinstance(v, list) else v for k, v in stored.pop("transform").items()
        }
        return PairEstimate(transform=Transform(**pose), by_clock=np.array(stored.pop("by_clock")), **stored)
    except Exception:  # as for motions
        return None


def store_pair(folder: Path, key: str, estimate: PairEstimate) -> None:
    """Keep what a metric found for a pair; whole or not at all."""
    plain = {f.name: getattr(estimate, f.name) for f in fields(estimate)}
    plain["transform"] = {f.name: getattr(estimate.transform, f.name) for f in fields(estimate.transform)}
    with _whole(_file(folder, key, "json")) as f:
        f.write(json.dumps(plain, default=lambda x: x.tolist()).encode())


@contextmanager
def _whole(file: Path) -> Iterator[IO[bytes]]:
    """A file to write that is there once all of it is."""
    file.parent.mkdir(parents=True, exist_ok=True)
    part = file.with_suffix(f".{os.getpid()}.part")
    with part.open("wb") as f:
        yield f
    part.replace(file)


def _file(folder: Path, key: str, kind: str = "npz") -> Path:
    return folder / key[:2] / f"{key}.{kind}"


def _plain(value: Any) -> Any:
    """The value with every file in it replaced by what tells the file from others."""
    if isinstance(value, Path):
        return _signature(value)
    if isinstance(value, LazyReadings):
        return [_plain(value.load), [_plain(k) for k in value.keys]]
    if isinstance(value, partial):
        return [_plain(value.func), _plain(value.args), _plain(value.keywords)]
    if isinstance(value, FunctionType | MethodType):
        return f"{value.__module__}.{value.__qualname__}"  # a loose file's functions can not be pickled by name
    if isinstance(value, Mapping):
        return {k: _plain(v) for k, v in value.items()}
    if is_dataclass(value) and not isinstance(value, type):
        return [type(value).__name__, *(_plain(getattr(value, f.name)) for f in fields(value))]
    if isinstance(value, tuple | list):
        return [_plain(v) for v in value]
    return value


def _signature(file: Path) -> Any:
    try:
        state = file.stat()
        with file.open("rb") as f:
            head = f.read(4096)
            f.seek(max(state.st_size - 4096, 0))
            return [file.name, state.st_size, state.st_mtime_ns, crc32(head), crc32(f.read(4096))]
    except OSError:
        return [file.name, "unreadable"]
