"""Cameras in a rig.toml: folders of images, their stamps, and what is known of each lens."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib_toolkit import CameraIntrinsics, LazyReadings, Log, SensorTable, Stream, tables
from calib_toolkit.errors import DataError

SUFFIXES = {".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".pgm", ".ppm"}
LENS_KEYS = ("images", "camera_matrix", "distortion", "mask")


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
    lenses = {name: replace(table, name=name, values=values) for name, values in heads.items()}
    files = {name: _images(name, tables.table_folder(lens, "images")) for name, lens in lenses.items()}
    ns_of = _stamps_by_number(table, sorted({n for images in files.values() for n in images}))
    epoch_ns = min(ns_of.values())
    streams = {}
    for name, lens in lenses.items():
        numbers = sorted(files[name])
        stamps = tables.seconds(np.array([ns_of[n] for n in numbers]), epoch_ns)
        readings = LazyReadings(load_image, [files[name][n] for n in numbers])
        intrinsics = _intrinsics(lens, readings[0])
        gone = len(ns_of) - len(numbers)
        notes = (f"{name}: {gone} of {len(ns_of)} images are missing",) if gone else ()
        streams[name] = Stream(name, kind, stamps, readings, intrinsics, False, clock=table.name, notes=notes)
    return Log(table.folder, streams, epoch_ns, notes=tables.unfinished(tables.table_file(table, "times")))


def _images(name: str, folder: Path) -> dict[int, Path]:
    """The images of a folder by the last number in their name."""
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


def _stamps_by_number(table: SensorTable, numbers: Sequence[int]) -> dict[int, int]:
    """Nanoseconds of every numbered image, from lines that hold a stamp, or an image's number and its stamp."""
    where, file = f"sensor {table.name}", tables.table_file(table, "times")
    given, stamps = zip(*map(_number_and_stamp, tables.read_rows(file, 1, 3)), strict=True)
    ns = tables.to_nanoseconds(stamps).tolist()
    if tables.BLANK in ns:
        raise DataError(
            f"{stamps[ns.index(tables.BLANK)].place} holds no stamp; write one, or remove it and its images"
        )
    rows = list(zip(given, ns, strict=True))
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


def _number_and_stamp(row: tables.Row) -> tuple[int | None, tables.Row]:
    """(image number or None, the row without it) of ``[number] stamp``; the stamp may be a date of two words."""
    if row.cut:
        raise DataError(f"{row.place} is cut short; complete it, or remove it and its images")
    text = " ".join(row.words)
    plain = len(row.words) == 1 or tables.DATE.fullmatch(text)
    number, _, stamp = ("", "", text) if plain else text.partition(" ")
    if not (plain or number.isdecimal()):
        raise DataError(f"{row.place}: '{text}' is neither a stamp nor an image's number and its stamp; mend it")
    return int(number) if number else None, row._replace(words=[stamp])


def _intrinsics(lens: SensorTable, image: NDArray[np.uint8]) -> CameraIntrinsics:
    tables.refuse_unknown(lens, LENS_KEYS)
    name, values = lens.name, lens.values
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
        drawn = load_image(tables.table_file(lens, "mask"))
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
