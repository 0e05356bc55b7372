"""GOM: lidar intensity and image brightness change in the same directions (paper, VII-A and [3])."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib_toolkit import Scan, hookimpl
from calib_toolkit_plugins.metrics.images import Image
from calib_toolkit_plugins.metrics.points import evened, intensity_gradients, may_be_hidden
from calib_toolkit_plugins.metrics.views import Array, Index, LidarCamera, Moment, blurred

STRONG = 0.5
"""Share of the points, those with the strongest gradient of intensity, that are compared."""
SHARPEST = 1.5
"""Blur: a sharper image would show edges finer than the lidar's points do, and draw them all to one side."""
AROUND = 101
"""Pixels across."""
FAINT = 0.02
"""Of full brightness: a gradient that counts half where there is no other."""


class Gom(LidarCamera):
    """Agreement of the orientations of gradients, each pair weighted by both magnitudes, negated."""

    id = "gom"

    def facts(self, scan: Scan, chosen: Index) -> tuple[NDArray[np.bool_], dict[str, Array]]:
        """Gradient of intensity on the sphere around the lidar, where it is strong and nothing may hide the point."""
        if scan.intensity is None or np.ptp(scan.intensity[chosen]) == 0:
            return np.zeros(len(chosen), dtype=bool), {}
        gradient = intensity_gradients(scan.points, evened(scan), chosen)
        strength = np.linalg.norm(gradient, axis=1)
        seen = ~may_be_hidden(scan.points, chosen)
        strong = strength >= max(np.quantile(strength[seen], 1 - STRONG), 1e-6) if seen.any() else seen
        return seen & strong, {"gradient": gradient}

    def pictures(self, image: Image, blur: float) -> tuple[Image, ...]:
        """Gradient of brightness along x and y, next to what is usual around, so that no pose gains by moving points
        to where it is strong.
        """
        import cv2

        smooth = blurred(image, max(blur, SHARPEST))
        slopes = [np.asarray(cv2.Sobel(smooth, cv2.CV_32F, dx, 1 - dx), np.float32) for dx in (1, 0)]
        usual = cv2.blur(np.hypot(*slopes), (AROUND, AROUND))
        return tuple(slope / (usual + np.float32(FAINT)) for slope in slopes)

    def costs(self, T_a_b: Array, moment: Moment) -> Array:
        """(k,) minus ``sum m1 m2 (cos 2 dphi + 1) / (2 sum m1 m2)``: from 0 of gradients at right angles to -1.

        What is constant along each ray has its image gradient along ``(g_x / f_x, g_y / f_y)``, g in the camera's
        axes; its length is taken as it is on the sphere, so that no point counts more at the image's rim.
        """
        (image,), weight = moment.read(T_a_b)
        turned = np.swapaxes(T_a_b[:, :3, :2], 1, 2) @ moment.facts["gradient"].T
        lidar = turned / np.diag(moment.K)[:2, None]
        along = lidar[:, 0] * image[0] + lidar[:, 1] * image[1]
        both = np.hypot(lidar[:, 0], lidar[:, 1]) * np.hypot(image[0], image[1])
        # m1 m2 (cos 2 dphi + 1) / 2 = m1 m2 cos^2 dphi
        agreed = np.sum(weight * along**2 / np.maximum(both, 1e-12), axis=1)
        return np.asarray(-agreed / np.maximum(np.sum(weight * both, axis=1), 1e-12))


@hookimpl
def calib_register_metrics() -> list[Any]:
    """The ``gom`` metric."""
    return [Gom()]
