"""A camera: motion without scale from its images (paper, section V-B).

Harris corners spread over the image, pyramidal Lucas-Kanade with a forward-backward check, then two-view geometry.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib_toolkit import CameraIntrinsics, Log, Motions, Sensor, SensorTable, Stream, hookimpl, se3
from calib_toolkit.errors import DataError
from calib_toolkit_plugins.epipolar import Points, tangent
from calib_toolkit_plugins.image_tables import open_cameras
from calib_toolkit_plugins.two_view import TwoViewMotion, two_view_motion

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

FORWARD = np.array([0.0, 0.0, 1.0])
UNKNOWN_DIRECTION_VAR = 1.0  # rad^2 in the tangent plane: as good as the whole sphere


@dataclass(frozen=True)
class MonocularOptions:
    """corners: at most so many, no two closer than ``spacing`` pixels. window: of the flow, pixels; levels: of its
    pyramid. forward_backward: how far a corner may land from itself when followed there and back, pixels.
    point_sigma: noise of a corner in each image, pixels (the paper's author: 0.5). centre_sigma: of the principal
    point, pixels, by which all directions of travel lean.
    """

    corners: int = 800
    spacing: float = 10.0
    window: int = 11
    levels: int = 4
    forward_backward: float = 1.0
    point_sigma: float = 0.5
    centre_sigma: float = 0.3


@hookimpl
def calib_register_sensors() -> list[Sensor]:
    """The ``monocular`` sensor."""
    return [Sensor("monocular", estimate, MonocularOptions, open_table, version="3")]


def open_table(table: SensorTable) -> Log:
    """The camera of one monocular table of a rig.toml.

    Keys: ``images``, ``times``, ``camera_matrix``, and at will ``distortion`` and ``mask``, as
    :func:`~calib_toolkit_plugins.image_tables.open_cameras` reads them. Raises DataError.
    """
    lens = {key: value for key, value in table.values.items() if key != "times"}
    return open_cameras(table, "monocular", {table.name: lens})


def estimate(stream: Stream, options: MonocularOptions) -> Motions:
    """``T_prev_curr`` from each image to the next, camera axes, the translation of unit length.

    Where no motion fits (a black image, a cut) the step is left out. Where only the rotation shows (a standing or
    purely turning camera) the direction is forward, its variance 1 rad^2 in the tangent plane.
    Covariance: (6, 6) of ``vec``; the translation part has rank two, zero along the direction itself.
    Raises DataError on missing intrinsics, fewer than two images, and images that do not fit the intrinsics.
    """
    import cv2

    cv2.setNumThreads(1)  # slices run in parallel
    camera = _checked(stream, options)
    steps: list[tuple[float, float, Array, Array]] = []
    before: _View | None = None
    for stamp, reading in zip(stream.stamps, stream.readings, strict=True):
        view = _view(f"sensor {stream.name}, image at {stamp:.6f} s", stamp, reading, camera, options)
        motion = None if before is None else _motion(before, view, camera, options)
        if before is not None and motion is not None:
            steps.append((before.stamp, view.stamp, *_vec_and_cov(motion)))
        before = view
    if not steps:
        return Motions(np.zeros(0), np.zeros(0), np.zeros((0, 6)), np.zeros((0, 6, 6)), has_scale=False)
    start, end, vec, cov = (np.array(column) for column in zip(*steps, strict=True))
    f = np.array([camera.K[1, 1], camera.K[0, 0], np.inf])
    return Motions(start, end, vec, cov, has_scale=False, lean=np.arctan(options.centre_sigma / f))


def normalise(pixels: Array, camera: CameraIntrinsics, sigma: float) -> tuple[Points, NDArray[np.bool_]]:
    """Normalised points of pixels (n, 2) with the noise that ``sigma`` pixels are there, and which are usable.

    OpenCV's undistortion is finished by Newton steps on its projection, whose inverse Jacobian carries the noise.
    Where the distortion model can not be inverted a point is not usable.
    """
    import cv2

    xy: Array = np.asarray(cv2.undistortPoints(pixels.reshape(-1, 1, 2), camera.K, camera.distortion), np.float64)
    xy = xy.reshape(-1, 2)
    h = 1e-6
    for _ in range(3):
        at, right, down = (_project(xy + shift, camera) for shift in ((0.0, 0.0), (h, 0.0), (0.0, h)))
        J = np.stack([right - at, down - at], axis=2) / h
        usable = np.all(np.isfinite(J), axis=(1, 2)) & (np.linalg.det(J) > 0)
        J_inv = np.linalg.inv(np.where(usable[:, None, None], J, np.eye(2)))
        left = pixels - at
        xy = xy + np.where(usable[:, None], np.einsum("nij,nj->ni", J_inv, left), 0.0)
    usable &= np.linalg.norm(np.where(usable[:, None], left, np.inf), axis=1) < 0.01
    cov: Array = sigma**2 * J_inv @ J_inv.transpose(0, 2, 1)
    return Points(xy, cov), usable


@dataclass(frozen=True)
class _View:
    """One image, ready to be followed from and to."""

    stamp: float
    grey: Image
    corners: NDArray[np.float32]


def _checked(stream: Stream, options: MonocularOptions) -> CameraIntrinsics:
    import cv2

    camera = stream.intrinsics
    if camera is None:
        raise DataError(
            f"sensor {stream.name} has no intrinsics; give the camera matrix "
            "(calib_cam_to_cam.txt, or camera_matrix in rig.toml)"
        )
    K = np.asarray(camera.K, dtype=np.float64)
    if K.shape != (3, 3) or not np.all(np.isfinite(K)) or min(K[0, 0], K[1, 1]) <= 0 or K[2].tolist() != [0, 0, 1]:
        raise DataError(
            f"sensor {stream.name}: its camera matrix is {K.tolist()}; it must be "
            "[[fx, s, cx], [0, fy, cy], [0, 0, 1]] in pixels, with positive fx and fy"
        )
    if len(stream) < 2:
        raise DataError(f"sensor {stream.name} has {len(stream)} image(s); motion needs at least two")
    if camera.mask is None:
        return camera
    # what may not be used may not lie in a corner's window either
    usable = cv2.erode(np.where(camera.mask > 0, 255, 0).astype(np.uint8), np.ones((options.window,) * 2, np.uint8))
    return replace(camera, mask=np.asarray(usable, np.uint8))


def _view(where: str, stamp: float, reading: Any, camera: CameraIntrinsics, options: MonocularOptions) -> _View:
    import cv2

    image = np.asarray(reading)
    if image.dtype != np.uint8 or not (image.ndim == 2 or (image.ndim == 3 and image.shape[2] == 3)):
        raise DataError(
            f"{where} is an array of {image.dtype}, shape {image.shape}; images must be 8 bit, grey (h, w) or "
            "colour (h, w, 3)"
        )
    h, w = image.shape[:2]
    _refuse_misfit(where, w, h, camera)
    grey: Image = image if image.ndim == 2 else np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), np.uint8)
    grey = np.ascontiguousarray(grey)
    return _View(stamp, grey, _corners(grey, camera, options))


def _refuse_misfit(where: str, w: int, h: int, camera: CameraIntrinsics) -> None:
    if camera.size is not None and tuple(camera.size) != (w, h):
        raise DataError(
            f"{where} is {w} x {h} pixels, but its intrinsics are for {camera.size[0]} x {camera.size[1]}; "
            "give the intrinsics of these images"
        )
    if camera.mask is not None and camera.mask.shape != (h, w):
        raise DataError(
            f"{where} is {w} x {h} pixels, but its mask is {camera.mask.shape[1]} x {camera.mask.shape[0]}; "
            "give a mask of the images' size"
        )
    if not (0 <= camera.K[0, 2] <= w and 0 <= camera.K[1, 2] <= h):
        raise DataError(
            f"{where} is {w} x {h} pixels, but its camera matrix has the principal point at "
            f"({camera.K[0, 2]:.0f}, {camera.K[1, 2]:.0f}); give the intrinsics of these images"
        )


def _corners(grey: Image, camera: CameraIntrinsics, options: MonocularOptions) -> NDArray[np.float32]:
    """The strongest corners of each tile, (n, 2): a strong one elsewhere must not silence a whole part."""
    import cv2

    h, w = grey.shape
    rows, columns = max(1, round(np.sqrt(32 * h / w))), max(1, round(np.sqrt(32 * w / h)))
    found = []
    for y0, y1 in zip(*_edges(h, rows), strict=True):
        for x0, x1 in zip(*_edges(w, columns), strict=True):
            tile_mask = None if camera.mask is None else np.ascontiguousarray(camera.mask[y0:y1, x0:x1])
            corners = cv2.goodFeaturesToTrack(
                np.ascontiguousarray(grey[y0:y1, x0:x1]),
                -(-options.corners // (rows * columns)),
                0.001,
                options.spacing,
                mask=tile_mask,
                useHarrisDetector=True,
                k=0.04,
            )
            if corners is not None:
                found.append(corners.reshape(-1, 2) + np.array([x0, y0], np.float32))
    return np.concatenate(found) if found else np.zeros((0, 2), np.float32)


def _edges(length: int, parts: int) -> tuple[list[int], list[int]]:
    edges = np.linspace(0, length, parts + 1).astype(int).tolist()
    return edges[:-1], edges[1:]


def _track(a: _View, b: _View, camera: CameraIntrinsics, options: MonocularOptions) -> tuple[Array, Array]:
    """Pixels (n, 2) of a, and where they are in b: corners followed there and back, inside image and mask.

    Where the flow changes within a window, what is followed is the middle of the window's gradients.
    """
    import cv2

    if not len(a.corners):
        return np.zeros((0, 2)), np.zeros((0, 2))
    start, window = a.corners.reshape(-1, 1, 2), (options.window, options.window)

    def follow(first: _View, second: _View, points: Any) -> tuple[Any, Any]:
        return cv2.calcOpticalFlowPyrLK(
            first.grey, second.grey, points, None, winSize=window, maxLevel=options.levels
        )[:2]  # type: ignore[call-overload]

    (there, seen), (back, seen_back) = (forth := follow(a, b, start)), follow(b, a, forth[0])
    p, q = start.reshape(-1, 2).astype(np.float64), there.reshape(-1, 2).astype(np.float64)
    keep = (seen.ravel() > 0) & (seen_back.ravel() > 0)
    keep &= np.linalg.norm(back.reshape(-1, 2) - p, axis=1) <= options.forward_backward
    aside = _middles(a.grey, p[keep], options.window // 2)
    p, q = p[keep] + aside, q[keep] + aside
    h, w = b.grey.shape
    inside = np.all((q >= 0) & (q <= [w - 1, h - 1]), axis=1)
    p, q = p[inside], q[inside]
    if camera.mask is not None:
        column, row = np.rint(q).astype(int).T
        p, q = p[camera.mask[row, column] > 0], q[camera.mask[row, column] > 0]
    return p, q


def _middles(grey: Image, p: Array, reach: int) -> Array:
    """(n, 2) pixels from p (n, 2) to where the gradients within ``reach`` meet: ``sum(g g^T (x - p)) = 0``.

    Foerstner & Guelch, "A fast operator for detection and precise location of distinct points", 1987.
    """
    import cv2

    u, v = np.meshgrid(*[np.arange(-reach, reach + 1)] * 2)
    column, row = np.rint(p).astype(int).T[:, :, None]
    padded = cv2.copyMakeBorder(grey, reach, reach, reach, reach, cv2.BORDER_REPLICATE)
    there = row + v.ravel() + reach, column + u.ravel() + reach
    g = np.stack([cv2.Scharr(padded, cv2.CV_32F, *d)[there].astype(float) for d in ((1, 0), (0, 1))], axis=2)
    x = np.stack([column + u.ravel() - p[:, :1], row + v.ravel() - p[:, 1:]], axis=2)
    weight, moment = np.einsum("nki,nkj->nij", g, g), np.einsum("nki,nkj,nkj->ni", g, g, x)
    aside = (np.linalg.pinv(weight, hermitian=True) @ moment[..., None])[..., 0]
    return np.where(np.abs(aside).max(axis=1, keepdims=True) < reach, aside, 0.0)


def _motion(a: _View, b: _View, camera: CameraIntrinsics, options: MonocularOptions) -> TwoViewMotion | None:
    p, q = _track(a, b, camera, options)
    if not len(p):
        return None
    prev, usable_prev = normalise(p, camera, options.point_sigma)
    curr, usable_curr = normalise(q, camera, options.point_sigma)
    usable = usable_prev & usable_curr
    return two_view_motion(prev[usable], curr[usable])


def _vec_and_cov(motion: TwoViewMotion) -> tuple[Array, Array]:
    """vec (6,) and its covariance (6, 6) from five parameters, or from three where no direction was seen."""
    direction = FORWARD if motion.t is None else motion.t
    cov = UNKNOWN_DIRECTION_VAR * np.eye(5)
    known = len(motion.cov)
    cov[:known, :known] = motion.cov
    rotvec = se3.log_so3(motion.R)
    J = np.zeros((6, 5))
    J[:3, 3:] = tangent(direction)
    J[3:, :3] = np.linalg.inv(se3.left_jacobian(rotvec))
    full = J @ cov @ J.T
    return np.concatenate([direction, rotvec]), (full + full.T) / 2


def _project(xy: Array, camera: CameraIntrinsics) -> Array:
    import cv2

    rays = np.column_stack([xy, np.ones(len(xy))])
    zero = np.zeros(3)
    return np.asarray(cv2.projectPoints(rays, zero, zero, camera.K, camera.distortion)[0], float).reshape(-1, 2)
