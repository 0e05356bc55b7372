"""IM: two images that follow each other colour one scan alike where the pose is right (paper, section VII-A)."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib_toolkit import Pair, Scan, hookimpl
from calib_toolkit.errors import ConfigError
from calib_toolkit_plugins.metrics.images import Image
from calib_toolkit_plugins.metrics.points import may_be_hidden
from calib_toolkit_plugins.metrics.views import Array, Index, LidarCamera, Moment, average, blurred

FORMS = ("contrast", "squared", "absolute")
FAINT = 0.3
"""Of an image's mean gradient: added before the logarithm, so that noise in plain walls counts little."""
EMPTY = 0.02
"""Of the same: below it a point has nothing to compare."""


@dataclass(frozen=True)
class ImOptions:
    """form: what is compared. "squared": mean squared difference of gradient images, as the paper has it; "absolute":
    mean absolute difference, as the author's program; "contrast": mean squared difference of their logarithms, each
    made of mean zero and variance one over the points, so that no pose gains by moving points to plain places.
    """

    form: str = "contrast"

    def __post_init__(self) -> None:
        if self.form not in FORMS:
            raise ConfigError(f"im: form = '{self.form}' does not exist; there are: {', '.join(FORMS)}")


@dataclass(frozen=True)
class Coloured(Moment):
    """A moment and how it is compared."""

    form: str = "contrast"


class Im(LidarCamera):
    """Mean squared difference of two gradient images at a scan's points."""

    id = "im"
    options = ImOptions
    images = 2

    def prepare(self, pair: Pair, options: ImOptions) -> Coloured | None:
        """The scan and two images of a row."""
        made = super().prepare(pair, options)
        return None if made is None else Coloured(**vars(made), form=(options or ImOptions()).form)

    def facts(self, scan: Scan, chosen: Index) -> tuple[NDArray[np.bool_], dict[str, Array]]:
        """Points that nothing may hide from the camera."""
        return ~may_be_hidden(scan.points, chosen), {}

    def pictures(self, image: Image, blur: float) -> tuple[Image, ...]:
        """Strength of the gradient, one on average."""
        import cv2

        smooth = blurred(image, blur)
        strength = np.hypot(*(cv2.Sobel(smooth, cv2.CV_32F, dx, 1 - dx) for dx in (0, 1)))
        return (np.asarray(strength / max(float(strength.mean()), 1e-6), np.float32),)

    def worth(self, moment: Moment, uv: Array, reach: Array) -> NDArray[np.bool_]:
        """Where there is some gradient as far as the point may lie."""
        import cv2

        size = 2 * int(np.ceil(min(float(np.median(reach)), 30.0))) + 1 if len(reach) else 1
        keep = np.zeros(uv.shape[2], dtype=bool)
        for (picture,), (x, y) in zip(moment.pictures, uv, strict=True):
            near = cv2.dilate(picture, np.ones((size, size), np.uint8))
            keep |= near[y.astype(int), x.astype(int)] > EMPTY
        return keep

    def costs(self, T_a_b: Array, moment: Coloured) -> Array:
        """(k,)."""
        ((a,), (b,)), weight = moment.read(T_a_b)
        if moment.form == "absolute":
            return average(np.abs(a - b), weight)
        if moment.form == "squared":
            return average(np.square(a - b), weight)
        a, b = (np.log(v + FAINT) for v in (a, b))
        a, b = (v - average(v, weight)[:, None] for v in (a, b))
        return 2 - 2 * average(a * b, weight) / np.sqrt(average(a * a, weight) * average(b * b, weight) + 1e-12)


@hookimpl
def calib_register_metrics() -> list[Any]:
    """The ``im`` metric."""
    return [Im()]
