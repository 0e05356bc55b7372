"""What combining pairs with motion is worth, and whether its sigmas hold: ``python docs/results/combination.py``.

Motion results and estimates of pairs are drawn from their covariances, which are exact; nothing is rendered.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import click
import numpy as np
from numpy.typing import NDArray
from rigs import Outcome, Place, Rig, difference, draw, nees, solve_all
from summaries import band, mean, rms, table, tell

from calib_toolkit import Calibration, PairEstimate, Transform, se3
from calib_toolkit.combine import combine, combine_paper
from calib_toolkit_datasets.simulated import truth

Array = NDArray[np.float64]

PLACES = (
    Place("velo", (0.0, 0.0, 1.7, 0, 0, 0), (10.0,)),
    Place("ins", (-0.8, 0.3, 0.9, 0, 0, 0), (20.0,)),
    Place("cam0", (0.4, 0.3, 1.5, -90, 0, -90), (10.0,), has_scale=False),
    Place("cam1", (0.4, -0.4, 1.5, -90, 0, -90), (10.0,), has_scale=False),
    Place("cam2", (0.2, 0.8, 1.4, -90, 0, -45), (10.0,), has_scale=False),
)
DEGREE = np.radians(1.0)
BY_MOTION = np.array([0.06, 0.06, 0.25, 0.2 * DEGREE, 0.15 * DEGREE, 0.1 * DEGREE, 0.8e-3])
"""Sigma of a sensor by motion: metres, radians, seconds; the base's own, which all share, is half of it."""
METRICS = {
    "im": np.array([0.04, 0.012, 0.015, 0.10 * DEGREE, 0.04 * DEGREE, 0.03 * DEGREE]),
    "nmi": np.array([0.08, 0.020, 0.020, 0.12 * DEGREE, 0.08 * DEGREE, 0.06 * DEGREE]),
}
"""Sigma of a camera in the lidar's axes: forward and roll are the weak ones."""
ACROSS = np.array([1.0 * DEGREE] * 3 + [0.05 * DEGREE] * 3)
"""Sigma of two cameras: direction and rotation."""
SPEED = 8.0
"""Metres a second ahead, by which an estimate moves with the clock offset."""
CASES = ((0.0, 0), (0.5, 0), (0.9, 0), (0.5, 1), (0.5, 2))
"""Part of the first metric's variance that is common to both metrics, of which a third each is the lidar's, the
camera's and the frames' own; and how many estimates of one pair failed."""
FAILED = np.array([0.3, 0.2, 0.2, 2 * DEGREE, 2 * DEGREE, 2 * DEGREE])
"""Size of the error of an estimate that failed."""


@click.command(context_settings={"show_default": True})
@click.option("--rigs", type=click.IntRange(1), default=200, help="How many of each.")
@click.option("--first", type=click.IntRange(0), default=0, help="The first seed.")
@click.option("--jobs", type=click.IntRange(1), default=2, help="Rigs at a time.")
@click.option("--paper", is_flag=True, help="Also by the paper's simplex, which takes seconds a rig.")
@click.option("--out", type=click.Path(path_type=Path, dir_okay=False), help="Write the tables, too.")
def main(rigs: int, first: int, jobs: int, paper: bool, out: Path | None) -> None:
    """Normalised errors of the combined rig, and errors of motion alone, of each pair alone and of all combined."""
    told = []
    drawn = [draw(seed, "street", len(PLACES), places=PLACES) for seed in range(first, first + rigs)]
    for shared, failed in CASES:
        what = f"{shared:.0%} of the variance shared, {failed} of 7 estimates failed"
        found = solve_all(partial(look, shared=shared, failed=failed, paper=paper), drawn, jobs, what)
        told.append(summary(found, f"{what}, {rigs} rigs"))
    tell("\n".join(told), out)


def look(rig: Rig, shared: float, failed: int, paper: bool) -> dict[str, Outcome]:
    """Outcomes (see :func:`rigs.solve`) by motion, by each metric alone and combined."""
    rng = np.random.default_rng([rig.seed, 7])
    true = truth(list(rig.sensors))
    motion = by_motion(true, rng)
    good = by_appearance(true, motion, shared, rng)
    wrong = [int(k) for k in rng.permutation(6)[:1]]
    wrong += [wrong[0] ^ 1]  # the other metric of the same pair
    estimates = [fail(e, rng) if k in wrong[:failed] else e for k, e in enumerate(good)]
    found = {"motion": outcome(rig, motion, true)}
    for k, metric in enumerate(METRICS):
        found[metric] = outcome(rig, alone(motion, estimates[k:6:2]), true)
    combined = combine(motion, estimates)
    kept = np.array(combined.used)
    bad = np.isin(np.arange(len(kept)), wrong[:failed])
    found["combined"] = outcome(rig, combined.calibration, true)
    found["combined"] |= {"missed": int(np.sum(kept & bad)), "lost": int(np.sum(~kept & ~bad))}
    if paper:
        found["paper"] = outcome(rig, combine_paper(motion, estimates).calibration, true)
    return found


def by_motion(true: Calibration, rng: np.random.Generator) -> Calibration:
    """A motion result: each sensor's own error and the base's, which all sensors see turned about it."""
    n = len(true.names)
    root = np.zeros((n, 7, n, 7))
    for i in range(1, n):
        sigma = BY_MOTION * rng.uniform(0.7, 1.5, 7)
        root[i, :, i] = np.diag(sigma)
        root[i, :6, 0, :6] = se3.relative_jacobians(np.eye(4), true.T_base_sensor[i])[0] @ np.diag(sigma[:6] / 2)
    root = root.reshape(7 * n, 7 * n)
    error = (root @ rng.normal(size=7 * n)).reshape(n, 7)
    T = np.array([off_by(T, e[:6]) for T, e in zip(true.T_base_sensor, error, strict=True)])
    return replace(true, T_base_sensor=T, dt_base_sensor=true.dt_base_sensor - error[:, 6], covariance=root @ root.T)


def by_appearance(
    true: Calibration, motion: Calibration, shared: float, rng: np.random.Generator
) -> list[PairEstimate]:
    """Both metrics of each camera and the lidar, and two cameras without scale; covariances are true."""
    size = METRICS["im"]
    of_sensor = [np.sqrt(shared / 3) * size * rng.normal(size=6) for _ in true.names]
    found = []
    for i in (2, 3, 4):
        T = true.T_base_sensor[i]
        R = T[:3, :3]
        of_frames = np.sqrt(shared / 3) * size * rng.normal(size=6)
        # the lidar's and the camera's own part, the camera's in axes of the lidar
        common = of_sensor[0] + of_sensor[i] + of_frames
        by_clock = np.array([SPEED * rng.uniform(0.5, 1.5), 0, 0, 0, 0, 0])
        late = motion.dt_base_sensor[i] - true.dt_base_sensor[i]
        for metric, sigma in METRICS.items():
            own = np.sqrt(sigma**2 - shared * size**2)
            T_ab = off_by(se3.rigid(R, T[:3, 3]), common + own * rng.normal(size=6) - by_clock * late)
            transform = Transform("velo", true.names[i], T_ab, np.diag(sigma**2))
            found.append(PairEstimate(metric, transform, by_clock))
    T = se3.relative(true.T_base_sensor[2], true.T_base_sensor[3])
    T[:3, 3] /= np.linalg.norm(T[:3, 3])
    T = off_by(T, ACROSS * rng.normal(size=6))
    T[:3, 3] /= np.linalg.norm(T[:3, 3])
    found.append(PairEstimate("features", Transform("cam0", "cam1", T, np.diag(ACROSS**2), has_scale=False)))
    return found


def off_by(T_true: Array, error: Array) -> Array:
    """The transform whose truth is off by ``(dt, delta)``."""
    return se3.rigid(se3.exp_so3(-error[3:]) @ T_true[:3, :3], T_true[:3, 3] - error[:3])


def fail(estimate: PairEstimate, rng: np.random.Generator) -> PairEstimate:
    """The estimate at some other minimum of its cost, as sure of itself as ever."""
    error = FAILED * rng.choice([-1, 1], 6) * rng.uniform(0.5, 1.5, 6)
    return replace(estimate, transform=replace(estimate.transform, T_a_b=off_by(estimate.transform.T_a_b, error)))


def alone(motion: Calibration, estimates: Sequence[PairEstimate]) -> Calibration:
    """The cameras where one metric puts them, with its covariance and the clock's error."""
    T, cov = motion.T_base_sensor.copy(), motion.covariance.copy()
    for e in estimates:
        i = motion.index(e.transform.b)
        T[i] = e.transform.T_a_b
        pose = slice(7 * i, 7 * i + 6)
        cov[pose, pose] = e.transform.cov + np.outer(e.by_clock, e.by_clock) * cov[7 * i + 6, 7 * i + 6]
    return replace(motion, T_base_sensor=T, covariance=cov)


def outcome(rig: Rig, found: Calibration, true: Calibration) -> Outcome:
    """In the form of :func:`rigs.solve`."""
    return {
        "seed": rig.seed,
        "names": list(found.names[1:]),
        "error": difference(found, true)[1:].tolist(),
        "covariance": found.covariance[7:, 7:].tolist(),
        "determined": found.determined[1:].tolist(),
    }


def summary(found: Sequence[dict[str, Outcome]], title: str) -> str:
    """A row for each sensor of each way; and how often a failed estimate was kept and a good one lost."""
    rows = []
    low, high = band(6, len(found))
    for way in found[0]:
        for i, name in enumerate(found[0][way]["names"]):
            if way in METRICS and not name.startswith("cam"):
                continue
            squares = [nees(o[way], [i], range(6)) for o in found]
            error = np.array([o[way]["error"][i] for o in found])
            size = [100 * rms(error[:, k]) for k in range(3)] + [np.degrees(rms(error[:, k])) for k in (3, 4, 5)]
            rows.append([way, name, mean(squares), float(np.median(squares)), *map(float, size)])
    missed, lost = (sum(o["combined"][k] for o in found) for k in ("missed", "lost"))
    title += f"; failed estimates that were used: {missed}, good ones that were not: {lost}. "
    title += f"Mean NEES of 6 lies within {low:.2f} and {high:.2f} 99 times in 100."
    header = ("by", "sensor", "NEES (6)", "median (5.35)", "x cm", "y cm", "z cm", "rx deg", "ry deg", "rz deg")
    return table(title, header, rows)


if __name__ == "__main__":
    main()
