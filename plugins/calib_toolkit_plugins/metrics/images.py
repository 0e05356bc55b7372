"""Images as they were taken, and freed of distortion when they are looked at: a moment holds them in few bytes."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib_toolkit import Stream
from calib_toolkit.errors import DataError

Array = NDArray[np.float64]
Image = NDArray[np.float32]


@dataclass(frozen=True)
class Straightener:
    """Frees images of one camera of their distortion.

    K: (3, 3). usable: (h, w) where a straight image may be used. maps: of ``cv2.remap``, none without distortion.
    """

    K: Array
    usable: NDArray[np.bool_]
    maps: tuple[Image, Image] | None

    def __call__(self, grey: NDArray[Any]) -> Image:
        """A grey image (h, w) from 0 to 255 as it was taken, straight and from 0 to 1."""
        image = np.asarray(grey / np.float32(255), np.float32)
        return image if self.maps is None else _remapped(image, self.maps)


def grey_images(camera: Stream, chosen: Sequence[int]) -> tuple[tuple[NDArray[Any], ...], Straightener]:
    """Grey images (h, w) as they were taken, and what straightens them. Raises DataError without intrinsics."""
    import cv2

    lens = camera.intrinsics
    if lens is None:
        raise DataError(f"sensor {camera.name} has no intrinsics; give its camera matrix")
    images = [np.asarray(camera.readings[i]) for i in chosen]
    grey = tuple(v if v.ndim == 2 else np.asarray(cv2.cvtColor(v, cv2.COLOR_BGR2GRAY)) for v in images)
    K, distortion = (np.asarray(v, np.float64).tobytes() for v in (lens.K, lens.distortion))
    mask = None if lens.mask is None else (lens.mask > 0).tobytes()
    return grey, _straightener(K, distortion, mask, grey[0].shape)


@lru_cache(maxsize=2)
def _straightener(K: bytes, distortion: bytes, mask: bytes | None, shape: tuple[int, int]) -> Straightener:
    """One for all images of a camera; its maps are larger than many of them."""
    import cv2

    matrix, D = np.frombuffer(K).reshape(3, 3), np.frombuffer(distortion)
    open_ = np.ones(shape, np.float32)
    if mask is not None:
        open_ = np.frombuffer(mask, np.bool_).reshape(shape).astype(np.float32)
    if not np.any(D):
        return Straightener(matrix, open_ > 0.5, None)
    x, y = cv2.initUndistortRectifyMap(matrix, D, np.eye(3), matrix, shape[::-1], cv2.CV_32FC1)
    maps = np.asarray(x, np.float32), np.asarray(y, np.float32)
    return Straightener(matrix, _remapped(open_, maps) > 0.99, maps)


def _remapped(image: Image, maps: tuple[Image, Image]) -> Image:
    import cv2

    return np.asarray(cv2.remap(image, *maps, cv2.INTER_LINEAR), np.float32)
