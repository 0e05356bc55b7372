"""The spherical panorama of Fig. 9: every camera's image turned onto one sphere, by the truth and by the estimate."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib_toolkit import se3
from calib_toolkit.evaluation.drives import Drive
from calib_toolkit.evaluation.errors import DELTA
from calib_toolkit.evaluation.measures import FORWARD_LEFT_UP, TOGETHER
from calib_toolkit.evaluation.store import Row
from calib_toolkit.evaluation.summary import numbers
from calib_toolkit.types import CameraIntrinsics

Array = NDArray[np.float64]
Image = NDArray[np.uint8]
View = tuple[Image, CameraIntrinsics, Array]
"""What a camera saw, its intrinsics, and its rotation ``R_first_camera`` (3, 3)."""

SIZE = (1440, 720)
"""Width and height in pixels: the whole sphere, a quarter of a degree each."""


def draw(drive: Drive, rows: Sequence[Row], file: Path) -> str:
    """Write the panorama from the truth above that from the mean of the first method's rotations; a sentence on it.

    Without images there is none, and the sentence says why. Raises DataError if an image can not be read.
    """
    names = list(drive.motions)
    missing = _missing(drive)
    method = next(r["estimator"] for r in rows if r["estimator"].endswith(TOGETHER))
    some = [r for r in rows if r["estimator"] == method]
    R = mean_rotations(some, names, drive.truth.T_base_sensor[:, :3, :3])
    if missing or R is None:
        return f"no panorama: {missing or f'no repeat of {method} determined the rotation of every camera'}"
    images, intrinsics = _at_once(drive), [s.intrinsics for s in drive.log.streams.values()]
    both = []
    for rotations in (drive.truth.T_base_sensor[:, :3, :3], R):
        views = [(i, k, r) for i, k, r in zip(images, intrinsics, rotations, strict=True) if k is not None]
        both.append(panorama(views))
    _save(both, f"from the mean of the rotations of {method}", file)
    return f"panorama of {', '.join(names)}: {file.name}"


def mean_rotations(rows: Sequence[Row], names: Sequence[str], R_true: Array) -> Array | None:
    """``R_first_camera`` (n, 3, 3) by the mean error in one estimator's rows; None if some camera has none."""
    R = [R_true[0]]
    for name, true in zip(names[1:], R_true[1:], strict=True):
        pair = [r for r in rows if r["sensor"] == f"{names[0]}-{name}"]
        delta = np.radians(np.column_stack([numbers(pair, f"{axis}_deg") for axis in DELTA]))
        delta = delta[np.isfinite(delta).all(axis=1)]
        if not len(delta):
            return None
        error = FORWARD_LEFT_UP.T @ se3.exp_so3(delta.mean(axis=0)) @ FORWARD_LEFT_UP
        R.append(error.T @ true)
    return np.array(R)


def panorama(views: Sequence[View]) -> Image:
    """All views on one sphere (h, w, 3), ahead of the first in the middle; each place from the camera that looks
    most directly at it, so that a wrong rotation shows as a broken edge.
    """
    import cv2

    cv2.setNumThreads(1)
    rays = _rays() @ FORWARD_LEFT_UP  # in the first camera's axes
    best = np.zeros(rays.shape[:2])
    canvas = np.zeros((*rays.shape[:2], 3), dtype=np.uint8)
    for image, intrinsics, R in views:
        turned = rays @ R
        seen, pixels = _project(turned, intrinsics, image.shape)
        colour = image if image.ndim == 3 else cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)
        x, y = (np.ascontiguousarray(pixels[..., k], dtype=np.float32) for k in (0, 1))
        drawn = cv2.remap(colour, x, y, cv2.INTER_LINEAR)
        ahead = np.where(seen, turned[..., 2], 0.0)
        nearer = ahead > best
        canvas[nearer], best[nearer] = drawn[nearer], ahead[nearer]
    return canvas


def _rays() -> Array:
    """(h, w, 3) directions ahead, left, up: left of the middle of the picture is left of the camera."""
    width, height = SIZE
    yaw = np.pi * (1 - 2 * (np.arange(width) + 0.5) / width)
    pitch = np.pi * (0.5 - (np.arange(height) + 0.5) / height)
    across, up = np.cos(pitch)[:, None], np.broadcast_to(np.sin(pitch)[:, None], (height, width))
    return np.stack([across * np.cos(yaw), across * np.sin(yaw), up], axis=-1)


def _project(rays: Array, intrinsics: CameraIntrinsics, shape: tuple[int, ...]) -> tuple[NDArray[np.bool_], Array]:
    """Whether a camera sees each ray (h, w), and where: (h, w, 2) pixels."""
    import cv2

    height, width = shape[:2]
    K, distortion = intrinsics.K, np.asarray(intrinsics.distortion, dtype=float)
    corners = np.array([[[x, y]] for x in (0.0, width - 1.0) for y in (0.0, height - 1.0)])
    widest = np.linalg.norm(cv2.undistortPoints(corners, K, distortion).reshape(-1, 2), axis=1).max()
    ahead = np.maximum(rays[..., 2], 1e-6)
    x, y = rays[..., 0] / ahead, rays[..., 1] / ahead
    # beyond the corners the lens model turns back on itself
    seen = (rays[..., 2] > 1e-6) & (x * x + y * y < (1.02 * widest) ** 2)
    points = np.column_stack([x[seen], y[seen], np.ones(int(seen.sum()))])
    pixels = np.full((*x.shape, 2), -1.0)
    if len(points):
        pixels[seen] = cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, distortion)[0].reshape(-1, 2)
    inside = (pixels >= 0).all(axis=-1) & (pixels[..., 0] <= width - 1) & (pixels[..., 1] <= height - 1)
    return np.asarray(seen & inside), pixels


def _at_once(drive: Drive) -> list[Image]:
    """Each camera's image nearest to the middle of the drive."""
    middle = sum(drive.span) / 2
    streams = zip(drive.log.streams.values(), drive.truth.dt_base_sensor, strict=True)
    return [s.readings[int(np.argmin(np.abs(s.stamps + dt - middle)))] for s, dt in streams]


def _missing(drive: Drive) -> str:
    """Why a recording holds no images, or nothing."""
    for stream in drive.log.streams.values():
        if not isinstance(stream.readings[0], np.ndarray):
            return f"{drive.name} holds no images, only motions of {stream.name}"
        if stream.intrinsics is None:
            return f"{drive.name} does not hold the intrinsics of {stream.name}"
    return ""


def _save(both: Sequence[Any], second: str, file: Path) -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 8), layout="constrained")
    seen = np.flatnonzero(np.any(both, axis=(0, 2, 3)))
    highest, lowest = (90 - 180 * k / SIZE[1] for k in (seen.min(), seen.max() + 1))
    titles = ("from the true rotations", second)
    for panel, image, title in zip(figure.subplots(2, 1, sharex=True), both, titles, strict=True):
        panel.imshow(image[..., ::-1], extent=(180, -180, -90, 90))
        panel.set_ylim(lowest, highest)
        panel.set_title(title, fontsize=10)
        panel.set_ylabel("up, deg")
    figure.axes[-1].set_xlabel("left, deg")
    figure.savefig(file, dpi=120)
