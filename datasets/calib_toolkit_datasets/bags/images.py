"""Image and CompressedImage as arrays of 8 bits, CameraInfo as a pinhole camera."""

import re
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib_toolkit import CameraIntrinsics
from calib_toolkit.errors import DataError
from calib_toolkit_datasets import image_files
from calib_toolkit_datasets.bags.index import Key, Source
from calib_toolkit_datasets.bags.messages import load, place

Image = NDArray[np.uint8]

RAW, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
CHANNELS = {"mono": 1, "bgr": 3, "rgb": 3, "bgra": 4, "rgba": 4, "8UC1": 1, "8UC3": 3, "16UC1": 1, "yuv422": 2}
ENCODING = re.compile(r"(?:(?P<name>mono|bgr|rgb|bgra|rgba|bayer_(?:rggb|bggr|gbrg|grbg))(?P<bits>8|16))")
PLAIN = {"8UC1": "mono8", "8UC3": "bgr8", "16UC1": "mono16"}
YUV = {"yuv422": "UYVY", "uyvy": "UYVY", "yuv422_yuy2": "YUY2", "yuyv": "YUY2"}
MODELS = {"plumb_bob": (4, 5), "rational_polynomial": (8, 12, 14), "": (0, 4, 5)}
"""Numbers of coefficients of each model of distortion that OpenCV's pinhole camera has."""


def load_image(key: Key, source: Source, topic: str, kind: str, encoding: str, shift: int = 0) -> Image:
    """An image, (h, w) grey or (h, w, 3) in BGR order. Raises DataError, naming file, topic and place.

    shift: bits that numbers of 16 bits have more than 8.
    """
    where, message = place(key, source, topic), load(key, source, topic, kind, encoding)
    return _decoded(message, where) if kind == COMPRESSED else _converted(_pixels(message, where), message, shift)


def told_shift(key: Key, source: Source, topic: str, encoding: str) -> int:
    """Bits that the numbers of a 16-bit image use beyond 8, from one image; 0 for 8 bits. Raises DataError."""
    pixels = _pixels(load(key, source, topic, RAW, encoding), place(key, source, topic))
    return max(int(pixels.max(initial=0)).bit_length() - 8, 0) if pixels.dtype == np.uint16 else 0


def intrinsics(info: Any, rectified: bool) -> tuple[CameraIntrinsics | None, str]:
    """What a CameraInfo says, and why it can not be used if it can not.

    rectified: whether the images are, so that the projection is that of the left part of P.
    """
    lower = {name.lower(): getattr(info, name) for name in vars(info)}
    K, D, P = (np.asarray(lower[name], dtype=float).ravel() for name in "kdp")
    size = (info.width, info.height) if info.width and info.height else None
    if info.binning_x > 1 or info.binning_y > 1 or info.roi.x_offset or info.roi.y_offset:
        return None, "its images are a part of the sensor's, or binned, which intrinsics of the whole do not fit"
    K = P.reshape(3, 4)[:, :3] if rectified else K.reshape(3, 3)
    if not np.isfinite(K).all() or K[0, 0] <= 0 or K[1, 1] <= 0:
        return None, "its CameraInfo holds no camera matrix"
    if rectified:
        return CameraIntrinsics(K, size=size), ""
    model = info.distortion_model
    if not np.any(D):
        return CameraIntrinsics(K, size=size), ""
    if len(D) not in MODELS.get(model, ()) or not np.isfinite(D).all():
        return None, f"its distortion, {len(D)} numbers of '{model}', is none that a pinhole camera has; undistort it"
    return CameraIntrinsics(K, D, size), ""


def to_message(image: Image, header: Any, types: Any) -> Any:
    """An Image, ``mono8`` or ``bgr8``."""
    height, width = image.shape[:2]
    step = image[0].nbytes
    data = np.ascontiguousarray(image).reshape(-1)
    return types[RAW](header, height, width, "mono8" if image.ndim == 2 else "bgr8", 0, step, data)


def to_info(camera: CameraIntrinsics, size: tuple[int, int], header: Any, types: Any) -> Any:
    """A CameraInfo. size: (width, height) of the images."""
    D = np.asarray(camera.distortion, dtype=float)
    model = "plumb_bob" if len(D) <= 5 else "rational_polynomial"
    D = np.concatenate([D, np.zeros(5 - len(D))]) if len(D) < 5 else D
    K = np.asarray(camera.K, dtype=float)
    P = np.column_stack([K, np.zeros(3)])
    info = types["sensor_msgs/msg/CameraInfo"]
    roi = types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
    return info(header, size[1], size[0], model, D, K.ravel(), np.eye(3).ravel(), P.ravel(), 0, 0, roi)


def _pixels(message: Any, where: str) -> NDArray[Any]:
    """(h, w) or (h, w, channels) of 8 or 16 bits as they were sent. Raises DataError."""
    encoding = PLAIN.get(message.encoding, message.encoding)
    match = ENCODING.fullmatch(encoding)
    if match is None and encoding not in YUV:
        raise DataError(
            f"{where} is an image of encoding '{message.encoding}', which is not read; name another topic"
        )
    bayer = match is not None and match["name"].startswith("bayer")
    channels = 2 if match is None else 1 if bayer else CHANNELS[match["name"]]
    wide = match is not None and match["bits"] == "16"
    kind = np.dtype((">u2" if message.is_bigendian else "<u2") if wide else "u1")
    height, width, step = message.height, message.width, message.step
    row = width * channels * kind.itemsize
    if step < row or len(message.data) < step * height or not row or not height:
        raise DataError(
            f"{where} says it has {height} rows of {step} bytes with {width} pixels of '{message.encoding}', and "
            f"holds {len(message.data)} bytes; leave it out"
        )
    rows = np.asarray(message.data, dtype=np.uint8)[: step * height].reshape(height, step)[:, :row]
    pixels = np.ascontiguousarray(rows).view(kind).reshape(height, width, channels)
    return pixels.astype(np.uint16) if wide else pixels


def _converted(pixels: NDArray[Any], message: Any, shift: int) -> Image:
    import cv2

    if pixels.dtype == np.uint16:
        pixels = np.minimum(pixels >> shift, 255).astype(np.uint8)
    encoding = PLAIN.get(message.encoding, message.encoding)
    name = encoding.rstrip("0123456789") if encoding not in YUV else encoding
    if name == "mono":
        return np.asarray(pixels[..., 0], np.uint8)
    if name == "bgr":
        return np.asarray(pixels, np.uint8)
    if encoding in YUV:
        code = getattr(cv2, f"COLOR_YUV2BGR_{YUV[encoding]}")
    elif name.startswith("bayer_"):
        # OpenCV names a pattern by its second row's second and third pixel
        opencv = {"rggb": "BG", "bggr": "RG", "gbrg": "GR", "grbg": "GB"}
        code, pixels = getattr(cv2, f"COLOR_Bayer{opencv[name[6:]]}2BGR"), pixels[..., 0]
    else:
        code = getattr(cv2, f"COLOR_{name.upper()}2BGR")
    return np.asarray(cv2.cvtColor(np.ascontiguousarray(pixels), code), np.uint8)


def _decoded(message: Any, where: str) -> Image:
    """A jpeg or png."""
    if "compressedDepth" in message.format:
        raise DataError(f"{where} is an image of depth, which no camera here reads; name another topic")
    image = image_files.decode(np.asarray(message.data, dtype=np.uint8))
    if image is None:
        raise DataError(f"{where} is not a whole jpeg or png ('{message.format[:40]}'); leave it out")
    return image
