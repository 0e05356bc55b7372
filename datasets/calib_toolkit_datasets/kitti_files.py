"""What the recordings of the KITTI family share: numbered scans and images, calibration files, sweep timing."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calib_toolkit import Scan
from calib_toolkit.errors import DataError
from calib_toolkit.types import Calibration

Array = NDArray[np.float64]
FARTHEST = 1e6
"""Metres from one sensor to another that no vehicle has."""
ROUNDED = 1e-4
"""How far a published matrix may be from a rotation: it has seven digits."""


@dataclass(frozen=True)
class ScanFile:
    """Key of one lidar reading. period: seconds of one revolution, nan if not known."""

    path: Path
    period: float


def numbered_files(folder: Path, suffixes: Sequence[str]) -> dict[int, Path]:
    """Files called ``NNNNNNNNNN.ext`` by their number; of one number, the suffix named first wins."""
    try:
        files = [p for p in folder.iterdir() if re.fullmatch("[0-9]{1,10}", p.stem)] if folder.is_dir() else []
    except OSError as e:
        raise DataError(f"{folder} can not be listed ({e.strerror}); make it readable") from e
    return {int(p.stem): p for suffix in reversed(suffixes) for p in files if p.suffix == suffix}


def load_scan(key: ScanFile, sensor: str) -> Scan:
    """One sweep from ``.bin`` (float32 x y z reflectance) or ``.txt`` (the same, one point a line).

    Raises DataError, naming file, sensor and frame, if it is missing, empty, cut short or not finite.
    """
    where, remedy = _where(key.path, sensor), "fetch the file again, or remove it to do without this scan"
    try:
        rows = _points(key.path)
    except (OSError, ValueError) as e:
        raise DataError(f"{where} can not be read ({e}); {remedy}") from e
    if not len(rows):
        raise DataError(f"{where} holds no points; {remedy}")
    bad = ~np.all(np.isfinite(rows), axis=1)
    if np.any(bad):
        raise DataError(f"{where} has {int(bad.sum())} points that are not numbers, first {bad.argmax()}; {remedy}")
    points = np.ascontiguousarray(rows[:, :3])
    times = None if np.isnan(key.period) else sweep_times(points, key.period)
    return Scan(points, times, np.ascontiguousarray(rows[:, 3]))


def sweep_times(points: NDArray[np.float32], period: float) -> NDArray[np.float32]:
    """When each point was measured, seconds relative to the middle of the sweep. (n, 3), seconds -> (n,).

    The HDL-64E of KITTI and KITTI-360 turns clockwise seen from above, from rear to rear, facing forward (x)
    at mid-sweep: a point at azimuth a is measured at ``-a / (2 pi)`` of a revolution. Geiger et al. (2013)
    print "counter-clockwise"; KITTI-360's own accumulation tool unrolls its scans clockwise, and scans eight
    metres apart agree better that way (48 mm against 51 mm on upright surfaces).
    """
    azimuth = np.arctan2(points[:, 1], points[:, 0])
    times: NDArray[np.float32] = (azimuth * np.float32(-period / (2 * np.pi))).astype(np.float32)
    return times


def load_image(path: Path, sensor: str, size: tuple[int, int] | None = None) -> NDArray[np.uint8]:
    """An 8-bit image, (h, w) grey or (h, w, 3) in BGR order. size: (width, height) it must have.

    Raises DataError, naming file, sensor and frame.
    """
    import cv2

    where, remedy = _where(path, sensor), "fetch the file again, or remove it to do without this image"
    try:
        data = np.fromfile(path, dtype=np.uint8)
    except OSError as e:
        raise DataError(f"{where} can not be read ({e}); {remedy}") from e
    # some versions of OpenCV decode a png that was cut short and leave the rest grey
    whole = b"IEND" in data[-64:].tobytes()
    image = cv2.imdecode(data, cv2.IMREAD_ANYCOLOR) if whole else None
    if image is None:
        raise DataError(f"{where} is not a whole png image; {remedy}")
    if size is not None and image.shape[1::-1] != size:
        raise DataError(
            f"{where} is {image.shape[1]} x {image.shape[0]} pixels where the calibration file says "
            f"{size[0]} x {size[1]}; use the calibration that belongs to these images"
        )
    return np.asarray(image, dtype=np.uint8)


def read_calib(file: Path) -> Mapping[str, Array]:
    """Numbers of a ``key: values`` calibration file by key. Raises DataError."""
    import pykitti.utils  # brings pandas, so not before it is needed

    try:
        return dict(pykitti.utils.read_calib_file(file))
    except (OSError, ValueError) as e:
        raise DataError(f"{file} is not a calibration file of lines 'key: values' ({e}); fetch it again") from e


def entry(calib: Mapping[str, Array], file: Path, key: str, shape: tuple[int, ...]) -> Array:
    """One entry in its shape. Raises DataError if it is missing, of another size or not finite."""
    values = calib.get(key)
    if values is None or values.size != np.prod(shape) or not np.all(np.isfinite(values)):
        raise DataError(f"{file}: '{key}' must be {np.prod(shape)} numbers; fetch the calibration again")
    return values.reshape(shape)


def reference(T_velo_sensor: Mapping[str, Array], without_scale: Sequence[str] = ()) -> Calibration | None:
    """The shipped poses as a calibration with base velo, or None if there are none.

    T_velo_sensor: (4, 4) by sensor name. Such files state neither uncertainty nor clock offsets: the
    covariance is zero and dt is not determined. Raises DataError where a rotation is none.
    """
    if not T_velo_sensor:
        return None
    for name, T in T_velo_sensor.items():
        R = T[:3, :3]
        if not np.all(np.abs(T) < FARTHEST) or np.abs(R @ R.T - np.eye(3)).max() > ROUNDED or np.linalg.det(R) < 0:
            raise DataError(
                f"sensor {name}: the calibration files beside the drive turn it by a matrix that is no rotation; "
                "fetch them again"
            )
    names = ("velo", *T_velo_sensor)
    determined = np.ones((len(names), 7), dtype=bool)
    determined[1:, 6] = False
    return Calibration(
        base="velo",
        names=names,
        T_base_sensor=np.stack([np.eye(4), *T_velo_sensor.values()]),
        dt_base_sensor=np.zeros(len(names)),
        covariance=np.zeros((7 * len(names), 7 * len(names))),
        has_scale=np.array([name not in without_scale for name in names]),
        determined=determined,
    )


def _points(path: Path) -> NDArray[np.float32]:
    if path.suffix == ".txt":
        text = path.read_text(encoding="ascii")
        return np.loadtxt(text.splitlines(), dtype=np.float32, ndmin=2).reshape(-1, 4) if text.strip() else _NO_POINTS
    size = path.stat().st_size
    if size % 16:
        raise ValueError(f"its {size} bytes are not a whole number of points of 16 bytes")
    return np.fromfile(path, dtype=np.float32).reshape(-1, 4)


_NO_POINTS = np.zeros((0, 4), dtype=np.float32)


def _where(path: Path, sensor: str) -> str:
    return f"{path}: sensor {sensor}, frame {int(path.stem)},"
