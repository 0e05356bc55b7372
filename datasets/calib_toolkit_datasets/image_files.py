"""Jpeg and png files, of which all must be there: OpenCV makes something of one that was cut short."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calib_toolkit.errors import DataError

Image = NDArray[np.uint8]

LARGEST = 2**28
"""Pixels of an image; what says it has more is damaged."""


def decode(data: NDArray[np.uint8]) -> Image | None:
    """(h, w) grey or (h, w, 3) in BGR order, of the bytes of a whole jpeg or png; None if they are not that."""
    import cv2

    raw = data.tobytes()
    whole = (raw.startswith(b"\x89PNG") and b"IEND" in raw[-64:]) or (
        raw.startswith(b"\xff\xd8") and b"\xff\xd9" in raw[-1024:]
    )
    width, height = _png_size(raw) or _jpeg_size(raw) or (0, 0)
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
