"""Whether errors of motions cancel or add up: ``python docs/results/growth.py RECORDING SENSOR,... [SECONDS]``.

Prints, as Markdown, the squared residual of so many successive steps of a sensor and the base together, over that of
as many independent steps, by axis of the sensor: 1 if errors are independent, towards one over the number if both
measure poses with independent errors, above 1 if errors add up.
"""

import sys
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from calib_toolkit import Calibration, Config, calibrate_motions, open_log, se3, sync
from calib_toolkit.cache import default_folder
from calib_toolkit.pipeline import sensor_motions
from calib_toolkit.plugins import registry
from calib_toolkit.progress import Silent
from calib_toolkit.types import Motions

Array = NDArray[np.float64]
TOGETHER = (3, 10, 30)
USUAL = 4.0
"""Times the median above which a residual does not count."""


def main(recording: str, sensors: Sequence[str], seconds: float = 100.0) -> None:
    """Rows for the travel and the turns of each sensor but the base."""
    log = open_log(recording).select(list(sensors)).trim(0.0, seconds)
    moved = sensor_motions(log, Config(), registry(), Silent(), default_folder())
    motions = {name: moved[name].motions for name in log.streams}
    found = calibrate_motions(motions).calibration
    print(f"{recording}, {seconds:g} s\n\n| sensor | |", *(f"{k} steps: x, y, z |" for k in TOGETHER))
    print("|---|---|", *("---|" for _ in TOGETHER))
    for name in found.names[1:]:
        left = residuals(motions[found.base], motions[name], found, name)
        for title, part in (("travel", slice(3)), ("turns", slice(3, 6))):
            cells = [", ".join(f"{g:.2f}" for g in growth(left[:, part], k)) for k in TOGETHER]
            print(f"| {name} | {title} | {' | '.join(cells)} |")


def residuals(base: Motions, sensor: Motions, found: Calibration, name: str) -> Array:
    """(m, 6) of the sensor's motions over common steps, less what its pose and the base's motions predict."""
    i = found.index(name)
    steps = sync.synchronise([sync.chain(base), sync.chain(sensor).shifted(found.dt_base_sensor[i])])
    T = found.T_base_sensor[i]
    return np.asarray(steps.vec[1] - se3.vector(se3.invert(T) @ se3.matrix(steps.vec[0]) @ T))


def growth(residual: Array, together: int) -> Array:
    """(d,) by axis, of (m, d) residuals in order."""
    size = np.linalg.norm(residual, axis=1)
    left = residual[size < USUAL * np.median(size)]
    whole = len(left) // together * together
    summed = left[:whole].reshape(-1, together, left.shape[1]).sum(axis=1)
    return np.asarray(np.mean(summed**2, axis=0) / (together * np.mean(left**2, axis=0)))


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2].split(","), *map(float, sys.argv[3:4]))
