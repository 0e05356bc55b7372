"""Whether the estimator's sigmas hold, on rigs drawn at random: ``python docs/results/honesty.py EXPERIMENT``.

Every experiment is seeded, prints tables in Markdown, and judges nothing: the columns say what is ideal.
"""

from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import click
import numpy as np
from bound import information, instants, read_together
from bound import sigma as bound_sigma
from failures import HOUR, KINDS, LENGTHS, NORMAL_KINDS, draw_failures, look, tell_alarms, tell_failures
from rigs import CAMERAS, NORMAL, PLACES, Outcome, Rig, difference, draw, solve, solve_all
from scipy.spatial.transform import Rotation
from summaries import POSE, TURN, tell, tell_bound, tell_coverage, tell_nees, tell_outliers, tell_scale, tell_starts

from calib_toolkit import CalibrationError, Config, calibrate_motions, se3
from calib_toolkit.config import METHODS
from calib_toolkit.evaluation.baselines import least_squares
from calib_toolkit.sync import Steps
from calib_toolkit_datasets.simulated import truth

Key = TypeVar("Key", bound=Hashable)

SHARES = (0.0, 0.1, 0.2, 0.3)
STATED = (0.5, 0.7, 1.5, 2.0)


@click.group(context_settings={"show_default": True})
def main() -> None:
    """Statistics of the estimators over many simulated rigs."""


def options(rigs: int, method: bool = True) -> Callable[[Any], Any]:
    """What every experiment takes."""
    chosen = [
        click.option("--rigs", type=click.IntRange(1), default=rigs, help="How many of each."),
        click.option("--first", type=click.IntRange(0), default=0, help="The first seed."),
        click.option("--jobs", type=click.IntRange(1), default=2, help="Rigs at a time."),
        click.option("--out", type=click.Path(path_type=Path), callback=_in_a_folder, help="Write the tables, too."),
    ]
    if method:
        chosen.append(click.option("--method", type=click.Choice(METHODS), default=Config().method))

    def add(command: Any) -> Any:
        for option in reversed(chosen):
            command = option(command)
        return command

    return add


def _in_a_folder(context: click.Context, option: click.Parameter, file: Path | None) -> Path | None:
    if file is not None and (file.is_dir() or not file.parent.is_dir()):
        raise click.BadParameter(f"{file} is a folder, or in none; name a file in a folder that exists")
    return file


@main.command("nees")
@options(500)
@click.option("--cameras", is_flag=True, help="Rigs of cameras only, of which the turns are looked at.")
def nees_command(rigs: int, first: int, jobs: int, out: Path | None, method: str, cameras: bool) -> None:
    """Errors squared over what was stated: rigs of 2 to 6 sensors on normal drives."""
    places, axes = (CAMERAS, TURN) if cameras else (PLACES, POSE)
    groups = {
        n: [draw(seed, NORMAL[seed % 3], n, places=places) for seed in range(first, first + rigs)]
        for n in range(2, 7)
    }
    found = solve_groups(groups, method, jobs, "nees")
    tell(tell_nees(found, axes, f"{method}, {rigs} rigs each, 60 s of {', '.join(NORMAL)}"), out)


@main.command()
@options(2000)
def coverage(rigs: int, first: int, jobs: int, out: Path | None, method: str) -> None:
    """How often an axis lies within 1, 2 and 3 sigma: a lidar, an INS and a camera."""
    drawn = {3: [draw(seed, NORMAL[seed % 3], 3) for seed in range(first, first + rigs)]}
    outcomes = solve_groups(drawn, method, jobs, "coverage")[3]
    tell(tell_coverage(outcomes, f"{method}, {rigs} rigs"), out)


@main.command()
@options(100)
def outliers(rigs: int, first: int, jobs: int, out: Path | None, method: str) -> None:
    """Wrong readings, up to twenty sigma, of the INS or of all sensors."""
    groups = {
        (n, who, share): [
            change(draw(seed, NORMAL[seed % 3], n), who, outliers=share) for seed in range(first, first + rigs)
        ]
        for n in (2, 3)
        for who in ("ins", "all")
        for share in SHARES
    }
    found = solve_groups(groups, method, jobs, "outliers")
    tell(tell_outliers(found, f"{method}, {rigs} rigs each"), out)


@main.command()
@options(100)
def scale(rigs: int, first: int, jobs: int, out: Path | None, method: str) -> None:
    """The INS states a sigma that is not its own."""
    groups = {
        (n, stated): [
            change(draw(seed, NORMAL[seed % 3], n), "ins", stated=stated) for seed in range(first, first + rigs)
        ]
        for n in (2, 3, 4)
        for stated in STATED
    }
    found = solve_groups(groups, method, jobs, "scale")
    tell(tell_scale(found, f"{method}, {rigs} rigs each"), out)


@main.command()
@options(200)
@click.option("--kind", "kinds", multiple=True, type=click.Choice([*KINDS, *NORMAL_KINDS]), help="All by default.")
@click.option("--shortest", type=click.FloatRange(0, HOUR), default=0.0, help="Shortest drive, seconds.")
@click.option("--longest", type=click.FloatRange(LENGTHS[0]), default=HOUR, help="Longest drive, seconds.")
def failures(
    rigs: int,
    first: int,
    jobs: int,
    out: Path | None,
    method: str,
    kinds: Sequence[str],
    shortest: float,
    longest: float,
) -> None:
    """What is flagged, and whether rightly: drives that leave directions open, and normal ones."""
    drawn = draw_failures(rigs, first, kinds or (*KINDS, *NORMAL_KINDS), shortest, longest)
    found = solve_all(partial(look, method=method), drawn, jobs, "failures")
    title = f"{method}, a lidar and an INS, {rigs} rigs of each kind"
    tell(tell_failures(found, title) + "\n" + tell_alarms(found, f"{title} and length"), out)


@main.command()
@options(500)
def starts(rigs: int, first: int, jobs: int, out: Path | None, method: str) -> None:
    """Clocks far off, sensors any way round, one rig in ten at exactly 180 degrees."""
    groups = {
        "1 s": [anyhow(seed, 1.0, 60.0) for seed in range(first, first + rigs)],
        "60 s": [anyhow(seed, 60.0, 120.0) for seed in range(first, first + (2 * rigs + 4) // 5)],
    }
    found = solve_groups(groups, method, jobs, "starts")
    tell(tell_starts(found, f"{method}, a lidar, an INS and a camera"), out)


@main.command()
@options(100, method=False)
def bound(rigs: int, first: int, jobs: int, out: Path | None) -> None:
    """Error over the Cramer-Rao bound of the true motion, by every method and least squares."""
    drawn = {n: [together(draw(seed, NORMAL[seed % 3], n)) for seed in range(first, first + rigs)] for n in (2, 3)}
    found = solve_groups(drawn, "", jobs, "bound", against_bound)
    tell(tell_bound(found, f"{rigs} rigs each, read at the same instants"), out)


def solve_groups(
    groups: Mapping[Key, Sequence[Rig]],
    method: str,
    jobs: int,
    what: str,
    task: Callable[..., Outcome] = solve,
) -> dict[Key, list[Outcome]]:
    """The outcomes of rigs that come in groups."""
    found = iter(solve_all(partial(task, method=method), [r for rigs in groups.values() for r in rigs], jobs, what))
    return {key: [next(found) for _ in rigs] for key, rigs in groups.items()}


def change(rig: Rig, who: str, **values: Any) -> Rig:
    """The rig with fields of one sensor changed, or of all."""
    return replace(rig, sensors=tuple(replace(s, **values) if who in (s.name, "all") else s for s in rig.sensors))


def anyhow(seed: int, most_dt: float, seconds: float) -> Rig:
    """A rig of three whose sensors but the base are turned at random; one in ten by 180 degrees about an axis."""
    rng, rig = np.random.default_rng([seed, 2]), draw(seed, NORMAL[seed % 3], 3, seconds)
    base, sensors = rig.sensors[0].T_vehicle_sensor, [rig.sensors[0]]
    for s in rig.sensors[1:]:
        half_way = Rotation.from_rotvec(np.pi * np.eye(3)[rng.integers(3)])
        R = half_way if seed % 10 == 0 else Rotation.random(rng=rng)
        T = se3.rigid(base[:3, :3] @ R.as_matrix(), s.T_vehicle_sensor[:3, 3])
        sensors.append(replace(s, T_vehicle_sensor=T, dt=float(rng.uniform(-most_dt, most_dt))))
    return replace(rig, sensors=tuple(sensors))


def together(rig: Rig) -> Rig:
    """The rig with all clocks right."""
    return change(rig, "all", dt=0.0)


def against_bound(rig: Rig, method: str = "") -> Outcome:
    """Errors (n, 7) of every method over the bound; nan where it was not determined."""
    true, reference = rig.path, truth(list(rig.sensors))
    motions = read_together(true, rig.sensors, rig.seed)
    limit, found = bound_sigma(information(true, rig.sensors)), {}
    for name in METHODS:
        try:
            c = calibrate_motions(motions, Config(method=name)).calibration
        except CalibrationError:
            found[name] = np.full(limit.shape, np.nan)
            continue
        found[name] = np.where(c.determined, difference(c, reference), np.nan)[1:] / limit
    ends, (base, *others) = np.column_stack([instants(true)[:-1], instants(true)[1:]]), motions.values()
    errors = np.full(limit.shape, np.nan)
    for i, m in enumerate(others):
        vec, cov = np.array([base.vec, m.vec]), np.array([base.cov, m.cov])
        T = least_squares(Steps(ends, vec, cov, np.array([base.has_scale, m.has_scale])))
        T_true = reference.T_base_sensor[i + 1]
        errors[i, :6] = np.concatenate([T_true[:3, 3] - T[:3, 3], se3.log_so3(T_true[:3, :3] @ T[:3, :3].T)])
    found["least squares"] = errors / limit
    return {"seed": rig.seed, "refused": "", "names": list(motions)[1:]} | {k: v.tolist() for k, v in found.items()}


if __name__ == "__main__":
    main()
