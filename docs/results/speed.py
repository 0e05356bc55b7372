"""How long the joint solve takes: ``OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 python docs/results/speed.py [DRIVE]``.

Prints, as Markdown, processor seconds over numbers of steps and of sensors, beside the paper's method on the same
motions in the same run, and the exponent of its growth; and the same for a recording's own motions.
"""

import sys
import time
from collections.abc import Mapping, Sequence

import numpy as np
from rigs import draw, measured

from calib_toolkit import Config, Motions, calibrate_motions, open_log
from calib_toolkit.cache import default_folder
from calib_toolkit.config import METHODS
from calib_toolkit.pipeline import sensor_motions
from calib_toolkit.plugins import registry
from calib_toolkit.progress import Silent

SECONDS = (50.0, 100.0, 200.0, 400.0, 800.0)
SENSORS = (2, 3, 4, 5, 6)
REPEATS = 3


def main(recording: str | None = None) -> None:
    """All tables."""
    print("| steps of the base | sensors | joint s | paper s | joint / paper |\n|---|---|---|---|---|")
    by_steps = [row(measured(draw(0, "street", 3, s))) for s in SECONDS]
    by_sensors = [row(measured(draw(0, "street", n, 200.0))) for n in SENSORS]
    if recording is not None:
        log = open_log(recording)
        moved = sensor_motions(log, Config(), registry(), Silent(), default_folder())
        row({name: moved[name].motions for name in log.streams})
    print(
        f"\ngrowth with steps: exponent {exponent(by_steps):.2f}; with sensors' readings: {exponent(by_sensors):.2f}"
    )


def row(motions: Mapping[str, Motions]) -> tuple[float, float]:
    """Print one; the number of readings and joint's seconds."""
    took = {m: min(seconds(motions, m) for _ in range(REPEATS if m == "joint" else 1)) for m in METHODS}
    steps = len(next(iter(motions.values())))
    cells = f"{took['joint']:.2f} | {took['paper']:.2f} | {took['joint'] / took['paper']:.2f}"
    print(f"| {steps} | {len(motions)} | {cells} |", flush=True)
    return float(sum(len(m) for m in motions.values())), took["joint"]


def seconds(motions: Mapping[str, Motions], method: str) -> float:
    """Processor time of one calibration."""
    start = time.process_time()
    calibrate_motions(motions, Config(method=method))
    return time.process_time() - start


def exponent(rows: Sequence[tuple[float, float]]) -> float:
    """Of the power with which seconds grow with readings."""
    readings, took = np.log(rows).T
    return float(np.polyfit(readings, took, 1)[0])


if __name__ == "__main__":
    main(*sys.argv[1:2])
