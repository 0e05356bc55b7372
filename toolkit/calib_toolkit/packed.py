"""What is never opened as a recording: archives, compressed files and pickles, each with what to do instead."""

from itertools import islice
from pathlib import Path

from calib_toolkit.errors import DataError

PACKED = (
    (0, b"PK\x03\x04", "a zip archive", "python -m zipfile -e {} FOLDER"),
    (0, b"PK\x05\x06", "an empty zip archive", "python -m zipfile -e {} FOLDER"),
    (0, b"7z\xbc\xaf\x27\x1c", "a 7z archive", "7z x {}"),
    (0, b"Rar!\x1a\x07", "a rar archive", "unrar x {}"),
    (257, b"ustar", "a tar archive", "tar xf {}"),
    (0, b"\x1f\x8b", "compressed by gzip", "gunzip -k {}"),
    (0, b"BZh", "compressed by bzip2", "bunzip2 -k {}"),
    (0, b"\xfd7zXZ\x00", "compressed by xz", "unxz -k {}"),
    (0, b"\x28\xb5\x2f\xfd", "compressed by zstd", "unzstd {}"),
)
"""Where in a file which bytes tell what it is, and what unpacks it."""
HEAD = 512
"""Bytes of a file that are looked at."""
TARS = (".tgz", ".tbz2", ".txz", ".tzst", ".tar.gz", ".tar.bz2", ".tar.xz", ".tar.zst")
PICKLES = (".pkl", ".pickle", ".pkl.gz", ".pkl.bz2", ".pkl.xz", ".pickle.gz")
PLACES = ("*", "*/*", "*/lidar/*")
"""Where in a folder pickles are looked for; the last is where PandaSet has them below the folder of its scenes."""
LOOKED_AT = 1000
"""Entries of a folder among which pickles are looked for; a recording of pickles has them among its first."""


def refuse_packed(path: Path) -> None:
    """Raise DataError if a path is an archive, a compressed file or a pickle, or a folder that holds pickles.

    Nothing is unpacked and no pickle is opened: of a file the first bytes are read, of a folder the names.
    """
    if pickle := _pickle(path):
        holds = f"{path} is a pickle" if pickle == path else f"{path} holds pickles ({pickle.relative_to(path)})"
        raise DataError(
            f"{holds}, and to open a pickle is to run whatever is in it, so none is opened; write its scans as .npy "
            "or .ply with a program that you trust, and name their folder"
        )
    head = _head(path)
    for at, begins, what, how in PACKED:
        if head[at:].startswith(begins):
            if path.name.lower().endswith(TARS):
                what, how = "a compressed tar archive", "tar xf {}"
            raise DataError(
                f"{path} is {what}, and recordings are not read out of those; "
                f"unpack it ({how.format(path.name)}) and name what comes out"
            )


def _head(path: Path) -> bytes:
    try:
        with path.open("rb") as file:
            return file.read(HEAD)
    except OSError:  # a folder, or nothing that can be read
        return b""


def _pickle(path: Path) -> Path | None:
    """The path itself, or the first pickle in a folder, one folder below or where PandaSet has them; else None."""
    if path.is_file():
        return path if path.name.lower().endswith(PICKLES) else None
    for pattern in PLACES:
        found = [p for p in islice(path.glob(pattern), LOOKED_AT) if p.name.lower().endswith(PICKLES)]
        if found:
            return min(found)
    return None
