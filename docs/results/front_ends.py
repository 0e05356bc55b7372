"""Each sensor's own motion on simulated drives, against the truth: ``python docs/results/front_ends.py DRIVE...``.

A DRIVE is a folder that ``calib-toolkit simulate`` made. Its files go through the real reader and the real plugin of
each sensor; the true motion is that of the exact path between the true instants of the stamps. Prints one Markdown
table; motions are taken from the toolkit's cache where they are there already.
"""

import argparse
import json
import os
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from calib_toolkit import Config, DataError, Log, Motions, bars, cache, open_log, se3
from calib_toolkit.errors import CalibrationError
from calib_toolkit.pipeline import sensor_motions
from calib_toolkit.plugins import registry
from calib_toolkit.progress import Progress
from calib_toolkit_datasets.simulation import vehicle
from calib_toolkit_datasets.simulation.rigs import START_NS, Mounted
from calib_toolkit_datasets.simulation.vehicle import TruePath
from calib_toolkit_datasets.simulation.writing import Wish, build_rig

Array = NDArray[np.float64]

STEP = 0.005
"""Seconds by which both ends of a motion are shifted to see how it changes with time."""
MOVED = 0.1
"""Metres between two images, below which a direction is not asked for."""
KNOWN = 0.5
"""Radians of stated sigma, above which a camera says that it saw no direction."""
OUTLIER = 5.0
"""Robust sigmas, beyond which an error does not count for the lag and the correlation."""
TITLES = (
    *("drive", "sensor", "steps", "error of", "sd x, y, z", "bias x, y, z", "stated sigma x, y, z"),
    *("NEES/dof mean", "median", "late by ms", "lag-1 correlation x, y, z"),
)


@dataclass(frozen=True)
class Errors:
    """Errors of some motions in one quantity.

    what: its name. unit: one over the unit it is shown in. error, rate: (n, 3), axes of the sensor, and how the true
    value changes with time, per second. cov: (n, 3, 3) as stated. dof: degrees of freedom of each error.
    """

    what: str
    unit: float
    error: Array
    rate: Array
    cov: Array
    dof: int

    @property
    def sd(self) -> Array:
        """(3,) robust standard deviations about the median."""
        return 1.4826 * np.median(np.abs(self.error - np.median(self.error, axis=0)), axis=0)

    @property
    def nees(self) -> Array:
        """(n,) normalised squared errors, per degree of freedom."""
        information = np.linalg.pinv(self.cov, rcond=1e-6, hermitian=True)
        return np.einsum("ni,nij,nj->n", self.error, information, self.error) / self.dof

    @property
    def usual(self) -> NDArray[np.bool_]:
        """(n,) errors that are no outliers."""
        away = np.abs(self.error - np.median(self.error, axis=0))
        return np.all(away <= OUTLIER * np.maximum(self.sd, 1e-12), axis=1)

    def late(self) -> tuple[float, float]:
        """Seconds by which the motion seems to lag behind the truth, and their sigma: least squares of the error
        on the rate of change, each axis weighted by its own noise."""
        weight = 1 / np.maximum(self.sd, 1e-12)
        error, rate = (
            ((x - x.mean(axis=0)) * weight).ravel() for x in (self.error[self.usual], self.rate[self.usual])
        )
        information = float(rate @ rate)
        if information <= 1e-12 * len(self.error):  # nothing changes, so nothing can be late
            return float("nan"), float("nan")
        dt = -float(rate @ error) / information
        return dt, float(np.std(error + dt * rate) / np.sqrt(information))

    def correlation(self) -> Array:
        """(3,) of each error with the next one's."""
        both = self.usual[1:] & self.usual[:-1]
        x = self.error - np.median(self.error, axis=0)
        a, b = x[:-1][both], x[1:][both]
        return np.sum(a * b, axis=0) / np.maximum(np.sqrt(np.sum(a**2, axis=0) * np.sum(b**2, axis=0)), 1e-300)

    def row(self) -> list[str]:
        """As cells of the table."""
        dt, sigma = self.late()
        stated = np.sqrt(np.median(np.diagonal(self.cov, axis1=1, axis2=2), axis=0))
        median = np.median(self.nees) * self.dof / chi2.median(self.dof)
        return [
            *(f"{len(self.error)}", self.what),
            *(_three(x * self.unit) for x in (self.sd, np.median(self.error, axis=0), stated)),
            *(_number(self.nees.mean()), _number(median)),
            *(f"{1e3 * dt:.2f} ({1e3 * sigma:.2f})", _three(self.correlation())),
        ]


def measure(folder: Path, jobs: int, progress: Progress) -> list[list[str]]:
    """Rows of the table for one drive. Raises CalibrationError."""
    log, wish = open_log(folder), read_wish(folder)
    path, rig = vehicle.path(wish.seconds, wish.seed, wish.drive), build_rig(wish)
    moved = sensor_motions(log, Config(jobs=jobs), registry(), progress, cache.default_folder())
    name = f"{wish.rig} {wish.scene}/{wish.drive} {wish.seconds:g} s"
    return [
        [name, sensor, *errors.row()]
        for sensor, motion in moved.items()
        for errors in compare(motion.motions, log, rig.sensor(sensor), path)
    ]


def read_wish(folder: Path) -> Wish:
    """What a simulated drive was made from. Raises DataError."""
    file = folder / "drive.json"
    try:
        held = json.loads(file.read_text())
        values = {f.name: held[f.name] for f in fields(Wish)}
    except (OSError, ValueError, KeyError, TypeError) as e:
        raise DataError(f"{file} does not say how the drive was made ({e}); name a folder of simulate's") from e
    return Wish(**{**values, "sensors": tuple(values["sensors"])})


def compare(motions: Motions, log: Log, sensor: Mounted, path: TruePath) -> list[Errors]:
    """Errors of translation (or of its direction, where a sensor has no scale) and of rotation."""
    start, end = (
        sensor.instants(np.round(s * 1e9).astype(np.int64) + log.epoch_ns - START_NS)
        for s in (motions.start, motions.end)
    )

    def true(shift: float) -> Array:
        a, b = (path.at(t + shift) @ sensor.T_vehicle_sensor for t in (start, end))
        vec = se3.vector(se3.relative(a, b))
        if not motions.has_scale:
            vec[:, :3] /= np.maximum(np.linalg.norm(vec[:, :3], axis=1, keepdims=True), 1e-9)
        return vec

    error, rate = motions.vec - true(0.0), (true(STEP) - true(-STEP)) / (2 * STEP)
    shift, turn = slice(0, 3), slice(3, 6)
    turned = Errors("rotation, mrad", 1e3, error[:, turn], rate[:, turn], motions.cov[:, turn, turn], 3)
    cov = motions.cov[:, shift, shift]
    if motions.has_scale:
        return [Errors("translation, mm", 1e3, error[:, shift], rate[:, shift], cov, 3), turned]
    far = np.linalg.norm((path.at(end) - path.at(start))[:, :3, 3], axis=1) > MOVED
    seen = far & (np.linalg.eigvalsh(cov)[:, -1] < KNOWN**2)
    direction = Errors("direction, degrees", np.degrees(1.0), error[seen, shift], rate[seen, shift], cov[seen], 2)
    return [direction, turned]


def _three(x: Array) -> str:
    return ", ".join(map(_number, x))


def _number(v: float) -> str:
    """Three digits, fewer of what is next to nothing."""
    return f"{v:.2f}" if 0.1 <= abs(v) < 10 else f"{v:.0f}" if abs(v) >= 100 else f"{v:.{3 if abs(v) >= 10 else 1}g}"


def main() -> None:
    """Print the table of the drives named."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("drives", nargs="+", type=Path, metavar="DRIVE")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="processes")
    arguments = parser.parse_args()
    rows: list[list[str]] = []
    try:
        for folder in arguments.drives:
            with bars() as progress:
                rows += measure(folder, arguments.jobs, progress)
    except CalibrationError as e:
        raise SystemExit(f"error: {e}") from e
    for cells in (list(TITLES), ["---"] * len(TITLES), *rows):
        print(f"| {' | '.join(cells)} |")


if __name__ == "__main__":
    main()
