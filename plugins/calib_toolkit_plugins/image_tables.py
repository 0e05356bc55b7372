"""Cameras in a rig.toml: folders of images, their stamps, and what is known of each lens."""

import re
from collections.abc import Iterable, Mapping, Sequence
from decimal import Decimal, InvalidOperation
from os.path import expanduser
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib_toolkit import CameraIntrinsics, LazyReadings, Log, SensorTable, Stream
from calib_toolkit.errors import DataError

SUFFIXES = {".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".pgm", ".ppm"}
LENS_KEYS = {"images", "camera_matrix", "distortion", "mask"}
STAMP = re.compile(r"\d{4}-\d\d-\d\d[ T]\d\d:\d\d:\d\d(\.\d{1,9})?")

Nanoseconds = int


def load_image(file: Path) -> NDArray[np.uint8]:
    """An image as it is stored: (h, w) grey or (h, w, 3) BGR. Raises DataError where it can not be read."""
    import cv2

    try:
        data = np.fromfile(file, dtype=np.uint8)
    except OSError as e:
        raise DataError(f"{file}: the image can not be read ({type(e).__name__}); restore or remove it") from e
    image = cv2.imdecode(data, cv2.IMREAD_ANYCOLOR) if len(data) else None
    if image is None:
        raise DataError(f"{file} is not an image, or is cut short; restore or remove it")
    return np.asarray(image, dtype=np.uint8)


def open_cameras(table: SensorTable, kind: str, heads: Mapping[str, Mapping[str, Any]]) -> Log:
    """One stream for each head, all on the clock of the table's ``times``.

    heads: stream name to ``images`` (a folder), ``camera_matrix`` (9 numbers or 3 x 3), and at will ``distortion``
    (OpenCV's order) and ``mask`` (an image, non-zero where it may be used). An image belongs to a stamp by the last
    number in its name, so that one missing in one head shifts nothing. Raises DataError.
    """
    files = {name: _images(name, _path(f"sensor {name}", table, values, "images")) for name, values in heads.items()}
    times = _path(f"sensor {table.name}", table, table.values, "times")
    ns_of = _stamps_by_number(f"sensor {table.name}", times, sorted({n for images in files.values() for n in images}))
    epoch_ns = min(ns_of.values())
    streams = {}
    for name, values in heads.items():
        numbers = sorted(files[name])
        stamps = np.array([ns_of[n] - epoch_ns for n in numbers]) / 1e9
        readings = LazyReadings(load_image, [files[name][n] for n in numbers])
        lens = _intrinsics(name, table, values, readings[0])
        gone = len(ns_of) - len(numbers)
        notes = (f"{name}: {gone} of {len(ns_of)} images are missing",) if gone else ()
        streams[name] = Stream(name, kind, stamps, readings, lens, has_scale=False, clock=table.name, notes=notes)
    return Log(table.folder, streams, epoch_ns)


def refuse_unknown(where: str, values: Mapping[str, Any], known: Iterable[str]) -> None:
    """Raises DataError for a key that this table does not have (a misspelt one would be ignored in silence)."""
    for key in values:
        if key not in known:
            raise DataError(
                f"{where} has the key '{key}', which is unknown here; known are {', '.join(sorted(known))}"
            )


def _path(where: str, table: SensorTable, values: Mapping[str, Any], key: str) -> Path:
    value = values.get(key)
    if not isinstance(value, str):
        raise DataError(f"{where} needs '{key}' with a path; {'add it' if value is None else f'it is {value!r}'}")
    path = table.folder / expanduser(value)
    if not path.exists():
        raise DataError(f"{where}: there is no {path}; correct '{key}'")
    return path


def _images(name: str, folder: Path) -> dict[int, Path]:
    """The images of a folder by the last number in their name."""
    if not folder.is_dir():
        raise DataError(f"sensor {name}: 'images' is {folder}, which is not a folder; name the folder of the images")
    found: dict[int, Path] = {}
    for file in sorted(f for f in folder.iterdir() if f.suffix.lower() in SUFFIXES):
        digits = re.findall(r"\d+", file.stem)
        if not digits:
            raise DataError(
                f"sensor {name}: {file} has no number in its name, so it has no place; rename or remove it"
            )
        other = found.setdefault(int(digits[-1]), file)
        if other is not file:
            raise DataError(f"sensor {name}: {other} and {file} have the same last number; rename one")
    if not found:
        raise DataError(f"sensor {name}: {folder} holds no images ({', '.join(sorted(SUFFIXES))})")
    return found


def _stamps_by_number(where: str, file: Path, numbers: Sequence[int]) -> dict[int, Nanoseconds]:
    """The stamp of every numbered image, from lines that hold a stamp, or an image's number and its stamp."""
    try:
        lines = [line.strip() for line in file.read_text(encoding="utf-8").splitlines()]
    except (OSError, UnicodeDecodeError) as e:
        raise DataError(f"{where}: {file} can not be read ({type(e).__name__}); give a text file of stamps") from e
    rows = [_row(file, k, line) for k, line in enumerate(lines, 1) if line and not line.startswith("#")]
    if not rows:
        raise DataError(f"{where}: {file} holds no stamps; write one for each image")
    if any(number is not None for number, _ in rows):
        by_number = {number: ns for number, ns in rows if number is not None}
    elif len(rows) == len(numbers):
        by_number = dict(zip(numbers, (ns for _, ns in rows), strict=True))
    elif numbers[-1] - numbers[0] + 1 == len(rows):
        by_number = {numbers[0] + k: ns for k, (_, ns) in enumerate(rows)}
    elif numbers[0] == 0 and numbers[-1] < len(rows):
        by_number = {k: ns for k, (_, ns) in enumerate(rows)}
    else:
        raise DataError(
            f"{where}: {file} has {len(rows)} stamps for {len(numbers)} images numbered {numbers[0]} to "
            f"{numbers[-1]}, so it is not known which belong together; write each image's number before its stamp"
        )
    missing = [n for n in numbers if n not in by_number]
    if missing:
        raise DataError(f"{where}: {file} has no stamp for image {missing[0]}; add it, or remove the image")
    return {n: by_number[n] for n in numbers}


def _row(file: Path, k: int, line: str) -> tuple[int | None, Nanoseconds]:
    """(image number or None, stamp in nanoseconds) of ``[number] stamp``, seconds or ``2011-09-26 13:02:25.964``."""
    *number, stamp = [line] if STAMP.fullmatch(line) else line.split(maxsplit=1)
    try:
        if STAMP.fullmatch(stamp):
            ns = int(np.datetime64(stamp.replace(" ", "T"), "ns").astype(np.int64))
        else:
            ns = int(Decimal(stamp) * 10**9)
        return (int(number[0]) if number else None), ns
    except (ValueError, OverflowError, InvalidOperation) as e:
        raise DataError(
            f"{file}: line {k} ('{line}') is not a stamp in seconds, or an image's number and its stamp; mend it"
        ) from e


def _intrinsics(
    name: str, table: SensorTable, values: Mapping[str, Any], image: NDArray[np.uint8]
) -> CameraIntrinsics:
    refuse_unknown(f"sensor {name}", values, LENS_KEYS)
    if "camera_matrix" not in values:
        raise DataError(f"sensor {name} has no camera_matrix; add its nine numbers (fx 0 cx 0 fy cy 0 0 1, pixels)")
    K = _numbers(name, "camera_matrix", values["camera_matrix"])
    if K.size != 9:
        raise DataError(f"sensor {name}: camera_matrix has {K.size} numbers; it needs nine (3 x 3, row by row)")
    distortion = _numbers(name, "distortion", values.get("distortion", []))
    if distortion.size not in (0, 4, 5, 8, 12, 14):
        raise DataError(
            f"sensor {name}: distortion has {distortion.size} numbers; OpenCV's model has 4, 5, 8, 12 or 14 "
            "(k1 k2 p1 p2 k3 ...)"
        )
    h, w = image.shape[:2]
    mask = None
    if "mask" in values:
        drawn = load_image(_path(f"sensor {name}", table, values, "mask"))
        mask = np.asarray(drawn if drawn.ndim == 2 else drawn.max(axis=2), dtype=np.uint8)
        if mask.shape != (h, w):
            raise DataError(
                f"sensor {name}: its mask is {mask.shape[1]} x {mask.shape[0]} pixels, its images {w} x {h}; "
                "give a mask of the images' size"
            )
    return CameraIntrinsics(K.reshape(3, 3), distortion, (w, h), mask)


def _numbers(name: str, key: str, value: Any) -> NDArray[np.float64]:
    try:
        numbers = np.asarray(value, dtype=np.float64).ravel()
    except (TypeError, ValueError) as e:
        raise DataError(f"sensor {name}: {key} must be a list of numbers, not {value!r}") from e
    if not np.all(np.isfinite(numbers)):
        raise DataError(f"sensor {name}: {key} holds a number that is not finite; correct it")
    return numbers
