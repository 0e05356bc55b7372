"""Levinson's metric: where the lidar's distance falls off, the image has an edge (paper, VII-A and [1])."""

from math import radians
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib_toolkit import Scan, hookimpl
from calib_toolkit_plugins.metrics.images import Image
from calib_toolkit_plugins.metrics.points import steps_behind
from calib_toolkit_plugins.metrics.views import Array, Index, LidarCamera, Moment, average

STEP = 0.3
"""Metres that what lies beside a point is farther behind, at least."""
FAINTER = 0.98
"""Of an edge's strength, a pixel away from it."""
REACH = 50
"""Pixels that an edge is felt."""
OWN = 1 / 3
"""Share of a pixel's own edge; the rest is that of the strongest nearby."""
FAINT = 0.05
"""Of full brightness: an edge that counts half where there is no other."""


class Levinson(LidarCamera):
    """Nearness to edges of the image of the lidar's points before a step in depth, negated."""

    id = "levinson"
    version = "2"
    own = (0.02, 0.02, 0.05, radians(0.03), radians(0.1), radians(0.03))
    """It draws points up: on simulated drives cameras end 4 to 6 cm too low and 0.1 degrees off in pitch."""
    points = 2000
    candidates = 100_000
    """All of a scan's, for few are before a step."""

    def facts(self, scan: Scan, chosen: Index) -> tuple[NDArray[np.bool_], dict[str, Array]]:
        """The root of the step in depth behind each point, where there is one."""
        step = steps_behind(scan.points, chosen)
        return step > STEP, {"step": np.sqrt(step)}

    def pictures(self, image: Image, blur: float) -> tuple[Image, ...]:
        """Edges and what they spread to, next to what is usual around, so that no pose gains by moving points to
        foliage. Blur: of the distance over which they fade.
        """
        import cv2

        around = np.ones((3, 3), np.uint8)
        edge = np.maximum(cv2.dilate(image, around) - image, image - cv2.erode(image, around)).astype(np.float32)
        spread, fainter = edge, np.float32(FAINTER ** (1 / blur))
        for _ in range(round(REACH * blur)):
            spread = np.maximum(edge, fainter * np.asarray(cv2.dilate(spread, around)))
        made = np.float32(OWN) * edge + np.float32(1 - OWN) * spread
        usual = cv2.blur(made, (2 * REACH + 1, 2 * REACH + 1))
        return (made / (usual + np.float32(FAINT)),)

    def costs(self, T_a_b: Array, moment: Moment) -> Array:
        """(k,) minus the mean of edges, each weighted by the step in depth that it is looked up for."""
        ((edge,),), weight = moment.read(T_a_b)
        return -average(edge, (weight * moment.facts["step"]).astype(np.float32))


@hookimpl
def calib_register_metrics() -> list[Any]:
    """The ``levinson`` metric."""
    return [Levinson()]
