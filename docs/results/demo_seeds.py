"""The demo over several seeds: ``python docs/results/demo_seeds.py FOLDER SEED...``.

Runs ``calib-toolkit demo -o FOLDER/SEED --seed SEED`` where it was not run yet. Prints, as Markdown, every seed's
errors, and how many of all determined numbers lie within one, two and three stated sigma.
"""

import subprocess
import sys
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calib_toolkit import read_calibration, se3
from calib_toolkit_datasets.simulation import rigs

Array = NDArray[np.float64]
UNITS = np.array([1.0, 1.0, 1.0, *np.degrees([1.0, 1.0, 1.0]), 1e3])
LIMITS = np.array([0.3, 0.3, 0.3, 0.5, 0.5, 0.5, 5.0])
"""Metres, degrees, milliseconds."""


def main(folder: Path, seeds: list[int]) -> None:
    """Print one row for each seed and sensor, then the shares."""
    print("| seed | sensor | x, y, z m | roll, pitch, yaw deg | dt ms |\n|---|---|---|---|---|")
    ratios, beyond, total = [], 0, 0
    for seed in seeds:
        file = folder / str(seed) / "calibration.json"
        if not file.is_file():
            # status 3: something was not determined
            command = ["calib-toolkit", "demo", "-o", str(file.parent), "--seed", str(seed)]
            subprocess.run(command, check=False, stdout=subprocess.DEVNULL)
        for name, error, sigma in errors(file, seed):
            cells = ["-" if np.isnan(e) else f"{e:.{d}f}" for e, d in zip(error, (3, 3, 3, 2, 2, 2, 2), strict=True)]
            print(f"| {seed} | {name} | {', '.join(cells[:3])} | {', '.join(cells[3:6])} | {cells[6]} |")
            known = np.isfinite(error)
            ratios += list(np.abs(error / sigma)[known])
            beyond += int((np.abs(error) > LIMITS)[known].sum())
            total += int(known.sum())
    within = ", ".join(f"{100 * np.mean(np.array(ratios) < k):.0f} %" for k in (1, 2, 3))
    print(
        f"\nOf {total} determined numbers, {within} lie within 1, 2 and 3 stated sigma; {beyond} are off by more than"
    )
    print("0.3 m, 0.5 degrees or 5 ms.")


def errors(file: Path, seed: int) -> list[tuple[str, Array, Array]]:
    """Of each sensor but the base: estimate against truth and sigma, (7,) in metres, degrees and milliseconds."""
    found, true = read_calibration(file), rigs.truth(rigs.compact(seed), 0.0)
    told = []
    for name in found.names[1:]:
        i, T = found.index(name), true.between(found.base, name).T_a_b
        turn = se3.log_so3(found.T_base_sensor[i, :3, :3] @ T[:3, :3].T)
        dt = found.dt_base_sensor[i] - true.dt_between(found.base, name)[0]
        error = np.concatenate([found.T_base_sensor[i, :3, 3] - T[:3, 3], turn, [dt]])
        told.append((name, np.where(found.determined[i], error, np.nan) * UNITS, found.sigma[i] * UNITS))
    return told


if __name__ == "__main__":
    main(Path(sys.argv[1]), [int(s) for s in sys.argv[2:]])
