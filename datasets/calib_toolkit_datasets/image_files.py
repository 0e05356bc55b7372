"""Jpeg and png files, of which all must be there: OpenCV makes something of one that was cut short."""

from collections.abc import Sequence
from os.path import isfile
from pathlib import Path
from zlib import crc32

import numpy as np
from numpy.typing import NDArray

from calib_toolkit import tables
from calib_toolkit.errors import DataError
from calib_toolkit_datasets.merging import refuse_leaving

Image = NDArray[np.uint8]

LARGEST = 2**28
"""Pixels of an image; what says it has more is damaged."""


def decode(data: NDArray[np.uint8]) -> Image | None:
    """(h, w) grey or (h, w, 3) in BGR order, of the bytes of a whole jpeg or png; None if they are not that."""
    import cv2

    raw = data.tobytes()
    whole = _png_is_whole(raw) or (raw.startswith(b"\xff\xd8") and b"\xff\xd9" in raw[-1024:])
    width, height = size_of(raw)
    if not whole or not 0 < width * height <= LARGEST:
        return None
    try:
        image = cv2.imdecode(data, cv2.IMREAD_ANYCOLOR)
    except cv2.error:
        return None
    return None if image is None else np.asarray(image, dtype=np.uint8)


def load(path: Path, sensor: str, size: tuple[int, int] | None = None) -> Image:
    """An image, (h, w) grey or (h, w, 3) in BGR order. size: (width, height) it must have.

    Raises DataError, naming file and sensor.
    """
    remedy = "fetch the file again, or remove it to do without this image"
    try:
        data = np.fromfile(path, dtype=np.uint8)
    except OSError as e:
        raise DataError(f"{path}: sensor {sensor}: the image can not be read ({e.strerror or e}); {remedy}") from e
    image = decode(data)
    if image is None:
        raise DataError(f"{path}: sensor {sensor}: not a whole jpeg or png; {remedy}")
    if size is not None and image.shape[1::-1] != size:
        raise DataError(
            f"{path}: sensor {sensor}: the image is {image.shape[1]} x {image.shape[0]} pixels where "
            f"{size[0]} x {size[1]} belong; use the calibration that belongs to these images"
        )
    return image


def listed(
    name: str, file: Path, unit: str, folder: Path, root: Path
) -> tuple[tables.Nanoseconds, list[Path], tuple[str, ...]]:
    """Stamps (n,), increasing, and images of a list whose rows are a stamp in ``unit`` seconds and a file's name.

    folder: where the names start. root: what no name may lead out of. Images that are missing, stamps that go back
    or repeat, and images beside them that it does not name are left out, which sentences say. Raises DataError.
    """
    rows = tables.read_rows(file, 2, 2)
    ns = tables.to_nanoseconds(rows, unit)
    paths = [folder / row.words[1] for row in rows]
    refuse_leaving(root, paths)
    there = np.array([ns[k] != tables.BLANK and isfile(p) for k, p in enumerate(paths)])
    rows_there = np.flatnonzero(there)
    keep = rows_there[tables.increasing(ns[rows_there])] if len(rows_there) else rows_there
    gone, late = len(rows) - len(rows_there), len(rows_there) - len(keep)
    notes = []
    if gone:
        first = rows[int(np.argmin(there))]
        notes.append(f"{name}: {gone} of {len(rows)} images have no file or no stamp, the first in {first.place}")
    if late:
        notes.append(f"{name}: {late} of {len(rows)} images whose stamps repeat or go back are left out")
    if len(keep) < 2:
        raise DataError(f"{file} lists {len(keep)} images that are there and have a stamp; a motion takes two")
    if unlisted := sorted(_beside([paths[k] for k in keep]).difference(paths)):
        notes.append(f"{name}: {len(unlisted)} images are not in {file}, the first of them {unlisted[0].name}")
    return ns[keep], [paths[k] for k in keep], tuple(notes)


def _beside(files: Sequence[Path]) -> set[Path]:
    """All files of the same kinds in the same folders."""
    return {f for folder, kind in {(p.parent, p.suffix) for p in files} for f in folder.glob(f"*{kind}")}


def size_of(raw: bytes) -> tuple[int, int]:
    """(width, height) that the beginning of a png or jpeg says, zeros if it says none."""
    return _png_size(raw) or _jpeg_size(raw) or (0, 0)


def _png_is_whole(raw: bytes) -> bool:
    """Whether its parts, each of a length, a name, data and their sum, follow one another to the last."""
    at, name = 8, b""
    while raw.startswith(b"\x89PNG") and at + 12 <= len(raw) and name != b"IEND":
        end = at + 8 + int.from_bytes(raw[at : at + 4], "big")
        name = raw[at + 4 : at + 8]
        if crc32(raw[at + 4 : end]).to_bytes(4, "big") != raw[end : end + 4]:
            return False
        at = end + 4
    return name == b"IEND"


def _png_size(raw: bytes) -> tuple[int, int] | None:
    if raw[12:16] != b"IHDR":
        return None
    return int.from_bytes(raw[16:20], "big"), int.from_bytes(raw[20:24], "big")


def _jpeg_size(raw: bytes) -> tuple[int, int] | None:
    """Of the frame's header, found from segment to segment."""
    at = 2
    while at + 9 <= len(raw) and raw[at] == 0xFF:
        marker = raw[at + 1]
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):
            return int.from_bytes(raw[at + 7 : at + 9], "big"), int.from_bytes(raw[at + 5 : at + 7], "big")
        at += 1 if marker == 0xFF else 2 + int.from_bytes(raw[at + 2 : at + 4], "big")
    return None
