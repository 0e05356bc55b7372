"""Recordings of each kind: which files belong to one, all messages in them, and the bytes of one message."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from calib_toolkit.errors import DataError
from calib_toolkit_datasets.bags import bag1, mcap, sqlite
from calib_toolkit_datasets.bags.index import Bag, Damaged, Index, Key, Source

METADATA = "metadata.yaml"
LONGEST_METADATA = 2**24
"""Bytes of a metadata.yaml; it lists topics and files."""
SUFFIXES = (".db3", ".mcap")


def starts_with(path: Path, magic: bytes) -> bool:
    """Whether a path is a file that begins so."""
    try:
        with path.open("rb") as file:
            return file.read(len(magic)) == magic
    except OSError:
        return False


def is_bag1(path: Path) -> bool:
    """Whether a path is a ROS 1 bag."""
    return starts_with(path, bag1.MAGIC[:8])


def is_mcap(path: Path) -> bool:
    """Whether a path is an MCAP file."""
    return starts_with(path, mcap.MAGIC)


def is_bag2(path: Path) -> bool:
    """Whether a path is the folder of a ROS 2 bag, or a file of one that SQLite stores."""
    try:
        if path.is_dir():
            return any(p.suffix in SUFFIXES for p in path.iterdir())
    except OSError:
        return False
    return path.suffix == ".db3" and starts_with(path, sqlite.MAGIC)


def open_bag1(path: Path) -> Bag:
    """A ROS 1 bag. Raises DataError."""
    return _found(Source((path,), "bag1"), ())


def open_mcap(path: Path) -> Bag:
    """An MCAP file. Raises DataError."""
    return _found(Source((path,), "mcap"), ())


def open_bag2(path: Path) -> Bag:
    """The folder of a ROS 2 bag, its files in the order of its metadata.yaml, or a ``.db3``. Raises DataError."""
    if not path.is_dir():
        return _found(Source((path,), "sqlite"), ())
    present = sorted((p for p in path.iterdir() if p.suffix in SUFFIXES), key=lambda p: (len(p.name), p.name))
    if not (path / METADATA).is_file():
        note = f"{path} has no {METADATA}, as if its recording was killed; its files are read in the order of names"
        return _found(_source(path, present), (note,))
    files, stated = _listed(path)
    missing = [f.name for f in files if not f.is_file()]
    if missing:
        raise DataError(f"{path / METADATA} lists {missing[0]}, which is missing; copy the whole folder")
    notes = [f"{path.name}: {p.name} is not in its {METADATA} and is left out" for p in present if p not in files]
    return _found(_source(path, files), tuple(notes), stated)


def fetch(source: Source, key: Key) -> bytes:
    """The bytes of one message. Raises DataError."""
    file = source.files[key[0]]
    try:
        return _FETCH[source.storage](file, key)
    except (Damaged, OSError) as e:
        raise DataError(f"{file}: {e}; copy or record it again") from e


_FETCH: dict[str, Callable[[Path, Key], bytes]] = {
    "bag1": bag1.fetch,
    "mcap": mcap.fetch,
    "sqlite": sqlite.fetch,
}
_SCAN: dict[str, Callable[[Path, int, Index], None]] = {
    "bag1": bag1.scan,
    "mcap": mcap.scan,
    "sqlite": sqlite.scan,
}


def _found(source: Source, notes: Sequence[str], stated: int = 0) -> Bag:
    """All messages. stated: how many the metadata says there are, 0 if it does not."""
    index = Index(notes=list(notes))
    for number, file in enumerate(source.files):
        before, index.stated = index.found, 0
        try:
            _SCAN[source.storage](file, number, index)
        except Damaged as e:
            index.notes.append(f"{file} is damaged: {e}; only what comes before is used")
        except OSError as e:
            raise DataError(f"{file} can not be read ({e.strerror}); make it readable") from e
        _compare(index, file.name, index.stated, index.found - before)
    _compare(index, METADATA, stated, index.found)
    return index.bag(source)


def _compare(index: Index, where: str, stated: int, found: int) -> None:
    """Note messages that are counted and were not found: damage can make a record look like one of no interest."""
    if stated > found:
        index.notes.append(f"{where} counts {stated} messages, of which {found} were found; the others are lost")


def _source(folder: Path, files: Sequence[Path]) -> Source:
    kinds = {f.suffix for f in files}
    if len(kinds) != 1:
        raise DataError(f"{folder} must hold files of one kind, {' or '.join(SUFFIXES)}; name one file, or sort them")
    if kinds == {".mcap"}:
        return Source(tuple(files), "mcap")
    return Source(tuple(files), "sqlite")


def _listed(folder: Path) -> tuple[list[Path], int]:
    """Files that a metadata.yaml lists, none outside its folder, and how many messages it says they hold."""
    file = folder / METADATA
    try:
        content = _yaml(file)["rosbag2_bagfile_information"]
        names, mode = [str(n) for n in content["relative_file_paths"]], str(content.get("compression_mode") or "")
    except (KeyError, TypeError, AttributeError) as e:
        raise DataError(f"{file} is not that of a ROS 2 bag ({e}); remove it to read the files in order") from e
    names = [n.removeprefix(f"{folder.name}/") for n in names]  # the first versions wrote them so
    outside = [n for n in names if Path(n).is_absolute() or ".." in Path(n).parts]
    if outside:
        raise DataError(f"{file} lists {outside[0]}, which lies outside its folder; list files of this folder only")
    if not names:
        raise DataError(f"{file} lists no files; remove it to read those that are there")
    if mode.lower() == "file":
        raise DataError(f"{folder} is compressed file by file; unpack {names[0]} with zstd -d, and remove {METADATA}")
    stated = content.get("message_count")
    return [folder / n for n in names], stated if isinstance(stated, int) else 0


def _yaml(file: Path) -> Any:
    """Plain YAML: a tag that asks for anything to be made is refused. Raises DataError."""
    import yaml

    try:
        if file.stat().st_size > LONGEST_METADATA:
            raise DataError(
                f"{file} is larger than any list of topics; remove it to read the files in order of names"
            )
        return yaml.safe_load(file.read_text(encoding="utf-8"))
    except (OSError, ValueError, yaml.YAMLError, RecursionError, ArithmeticError) as e:
        why = " ".join(str(e).split())[:200]
        raise DataError(f"{file} can not be read ({why}); remove it to read the files in order of names") from e
