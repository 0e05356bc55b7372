"""Rendered drives, each run as a user would: ``python docs/results/rendered.py OUT DRIVE...``.

Runs ``calib-toolkit run DRIVE -o OUT/NAME`` where it was not run yet. Prints, as Markdown, each sensor's errors
against the drive's exact truth and their square over what was stated, 6 on average if that is honest.
"""

import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calib_toolkit import Calibration, read_calibration, se3

Array = NDArray[np.float64]


def main(out: Path, drives: Sequence[Path]) -> None:
    """A row for each sensor of each drive, and the means."""
    print("| drive | sensor | x, y, z mm | rx, ry, rz deg | NEES (6) | dt ms (sigma) |\n|---|---|---|---|---|---|")
    found, pulls = list[float](), list[Array]()
    for drive in drives:
        folder = out / "-".join(drive.parts[-2:])
        if not (folder / "calibration.json").is_file():
            # status 3: something was not determined
            subprocess.run(["calib-toolkit", "run", drive, "-o", folder], check=False, stdout=subprocess.DEVNULL)
        c, true = read_calibration(folder / "calibration.json"), read_calibration(drive / "truth.json")
        for name in c.names[1:]:
            e, nees, dt = compared(c, true, name)
            if np.isfinite(nees):
                found.append(nees)
                pulls.append(np.abs(e) / c.sigma[c.index(name), :6])
            mm, deg = ", ".join(f"{v:.0f}" for v in 1e3 * e[:3]), ", ".join(f"{v:.3f}" for v in np.degrees(e[3:]))
            sigma = 1e3 * c.sigma[c.index(name), 6]
            print(f"| {drive.name} | {name} | {mm} | {deg} | {nees:.1f} | {1e3 * dt:.2f} ({sigma:.2f}) |", flush=True)
    print(f"\n{len(found)} sensors: NEES {np.mean(found):.1f} on average, median {np.median(found):.1f} (5.3)")
    for k in (1, 2, 3):
        within = 100 * (np.array(pulls) < k).mean(axis=0)
        print(
            f"within {k} sigma: {within.mean():.0f} %; {', '.join(f'{w:.0f}' for w in within)} by x, y, z, rx, ry, rz"
        )


def compared(c: Calibration, true: Calibration, name: str) -> tuple[Array, float, float]:
    """Truth less estimate ``(dt, delta)`` (6,), its normalised square (nan if anything is open), and of the clock."""
    i, T = c.index(name), true.between(c.base, name).T_a_b
    found, cov = c.T_base_sensor[i], c.covariance[7 * i : 7 * i + 6, 7 * i : 7 * i + 6]
    e = np.concatenate([T[:3, 3] - found[:3, 3], se3.log_so3(T[:3, :3] @ found[:3, :3].T)])
    nees = float(e @ np.linalg.solve(cov, e)) if c.determined[i, :6].all() else np.nan
    return e, nees, float(true.dt_between(c.base, name)[0] - c.dt_base_sensor[i])


if __name__ == "__main__":
    main(Path(sys.argv[1]), [Path(d) for d in sys.argv[2:]])
