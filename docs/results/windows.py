"""One drive in parts that do not overlap: ``python docs/results/windows.py RECORDING SENSOR,... SECONDS [METHOD]``.

Prints, as Markdown, how much each number differs from part to part (standard deviation), beside the sigma that the
parts state, and the mean difference to the reference that the recording comes with.
"""

import sys
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from calib_toolkit import Calibration, CalibrationError, Config, calibrate, open_log, se3

Array = NDArray[np.float64]
UNITS = np.array([1e3, 1e3, 1e3, *np.degrees([1.0, 1.0, 1.0]), 1e3])
TITLES = ("x mm", "y mm", "z mm", "rx deg", "ry deg", "rz deg", "dt ms")


def main(recording: str, sensors: Sequence[str], seconds: float, method: str = "joint") -> None:
    """One table for all sensors but the base."""
    log = open_log(recording).select(list(sensors))
    first, last = log.span
    found = []
    for start in np.arange(0.0, last - first - seconds, seconds):
        try:
            found.append(calibrate(log, Config(method=method, start=float(start), duration=seconds)).calibration)
        except CalibrationError as e:
            print(f"{start:g} s: {e}", file=sys.stderr)
    print(f"{method}, {len(found)} parts of {seconds:g} s of {recording}\n")
    print(f"| sensor | | {' | '.join(TITLES)} |\n|---|---|{'---|' * len(TITLES)}")
    for name in found[0].names[1:]:
        apart, sigma = differences(found, name)
        rows = {"sd of parts": np.nanstd(apart, axis=0, ddof=1), "stated sigma, median": np.nanmedian(sigma, axis=0)}
        if log.reference is not None and {name, found[0].base} <= set(log.reference.names):
            shifts = np.nanmean([against(c, log.reference, name) for c in found], axis=0)
            rows["mean less reference"] = np.append(shifts, np.nan)
        for title, values in rows.items():
            cells = ["-" if np.isnan(v) else f"{v:.3g}" for v in values * UNITS]
            print(f"| {name} | {title} | {' | '.join(cells)} |")


def differences(found: Sequence[Calibration], name: str) -> tuple[Array, Array]:
    """(k, 7) of each part to the first, and (k, 7) the sigma that it states; nan where it is not determined."""
    i = found[0].index(name)
    return np.array([_less(c, found[0], i, i) for c in found]), np.array([c.sigma[i] for c in found])


def against(c: Calibration, reference: Calibration, name: str) -> Array:
    """(6,) of a part's pose, less the reference."""
    T = reference.between(c.base, name).T_a_b
    i = c.index(name)
    turn = se3.log_so3(c.T_base_sensor[i, :3, :3] @ T[:3, :3].T)
    return np.where(c.determined[i, :6], np.concatenate([c.T_base_sensor[i, :3, 3] - T[:3, 3], turn]), np.nan)


def _less(a: Calibration, b: Calibration, i: int, j: int) -> Array:
    turn = se3.log_so3(a.T_base_sensor[i, :3, :3] @ b.T_base_sensor[j, :3, :3].T)
    shift, late = a.T_base_sensor[i, :3, 3] - b.T_base_sensor[j, :3, 3], a.dt_base_sensor[i] - b.dt_base_sensor[j]
    known = a.determined[i] & b.determined[j]
    return np.where(known, np.concatenate([shift, turn, [late]]), np.nan)


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2].split(","), float(sys.argv[3]), *sys.argv[4:5])
