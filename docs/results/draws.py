"""One pair of sensors compared again and again: ``python docs/results/draws.py RECORDING A,B``.

Every draw starts somewhere near the recording's reference and looks at some of the frames in which both see
something. Prints, as Markdown, how far apart the answers lie and how far from the reference, beside what they state.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import click
import numpy as np
from numpy.typing import NDArray
from summaries import table, tell

from calib_toolkit import Calibration, Config, Pair, PairEstimate, Transform, open_log, se3
from calib_toolkit.appearance.pairs import select
from calib_toolkit.appearance.search import estimate
from calib_toolkit.cache import default_folder
from calib_toolkit.combine import combine
from calib_toolkit.pipeline import sensor_motions
from calib_toolkit.plugins import registry
from calib_toolkit.progress import Silent

Array = NDArray[np.float64]
Index = NDArray[np.int64]

UNITS = np.array([1e3, 1e3, 1e3, *np.degrees([1.0, 1.0, 1.0])])
TITLES = ("x mm", "y mm", "z mm", "rx deg", "ry deg", "rz deg")


@dataclass(frozen=True)
class Draw:
    """What one start led to. alone: by appearance; combined: with the start's own sigma. None if it was refused."""

    start: Array
    alone: PairEstimate
    combined: Calibration | None


@click.command(context_settings={"show_default": True})
@click.argument("recording", type=click.Path(exists=True, path_type=Path))
@click.argument("sensors")
@click.option("--metric", default="im", help="Which metric.")
@click.option("--draws", type=click.IntRange(2), default=50, help="How many starts.")
@click.option("--moments", type=click.IntRange(1), default=25, help="Frames of a draw.")
@click.option("--frames", type=click.IntRange(1), default=200, help="Frames of the recording to draw from, at most.")
@click.option("--shift", default=0.15, help="Sigma of a start, metres an axis; no further than twice that in all.")
@click.option("--turn", default=1.5, help="Sigma of a start, degrees an axis; no further than twice that in all.")
@click.option("--off", default=0.0, help="Degrees by which each start is turned besides, which nobody is told.")
@click.option("--seed", type=click.IntRange(0), default=0, help="Of all that is drawn.")
@click.option("--out", type=click.Path(path_type=Path, dir_okay=False), help="Write the table, too.")
def main(recording: Path, sensors: str, out: Path | None, **chosen: Any) -> None:
    """Starts drawn around the reference, and where each of them leads."""
    pair = pair_of(recording, sensors, chosen.pop("frames"), chosen["seed"])
    draws = list(drawn(pair, **chosen))
    options = ", ".join(f"{k} {v}" for k, v in chosen.items())
    tell(summary(draws, pair.prior.T_a_b, f"{sensors} of {recording.name}: {options}"), out)


def pair_of(recording: Path, sensors: str, frames: int, seed: int) -> Pair:
    """Two sensors as the recording's reference has them, with up to so many of its frames."""
    a, b = sensors.split(",")
    log = open_log(recording).select([a, b])
    if log.reference is None:
        raise click.BadParameter(f"{recording} has no reference to start from")
    late, prior = log.reference.dt_between(a, b)[0], log.reference.between(a, b)
    moved = sensor_motions(log, Config(), registry(), Silent(), default_folder())
    both, motion = (log.streams[a], log.streams[b]), (moved[a].motion, moved[b].motion)
    return Pair(*both, *motion, late, select(*both, motion[0], late, frames, seed), prior)


def found_by(metric: str, pair: Pair, rows: Index, start: Array, sigma: Array, seed: int) -> PairEstimate:
    """What a metric makes of some of a pair's frames, from a start (4, 4) that is told to be right to sigma (6,)."""
    chosen, prior = registry().metrics[metric], replace(pair.prior, T_a_b=start, cov=np.diag(sigma**2))
    return estimate(chosen, replace(pair, selected=pair.selected[np.sort(rows)], prior=prior), chosen.options(), seed)


def drawn(
    pair: Pair, metric: str, draws: int, moments: int, shift: float, turn: float, off: float, seed: int
) -> Sequence[Draw]:
    """All draws of one recording."""
    rng, found, reference = np.random.default_rng(seed), [], pair.prior.T_a_b
    sigma = np.array([shift] * 3 + [np.radians(turn)] * 3)
    for k in range(draws):
        error = _within(rng, sigma)
        error[3:] += np.radians(off) * _direction(rng)
        start = se3.rigid(se3.exp_so3(error[3:]) @ reference[:3, :3], reference[:3, 3] + error[:3])
        rows = rng.permutation(len(pair.selected))[:moments]
        alone = found_by(metric, pair, rows, start, sigma, k)
        prior = replace(pair.prior, T_a_b=start, cov=np.diag(sigma**2))
        found.append(Draw(start, alone, together(prior, alone) if alone.converged else None))
        click.echo(f"{k}: {alone.note or _line(found[-1], reference)}", err=True)
    return found


def together(prior: Transform, alone: PairEstimate) -> Calibration | None:
    """The start with its sigma and what the pair looks like, as a run combines them; None if that was left out."""
    cov = np.zeros((14, 14))
    cov[7:13, 7:13] = prior.cov
    T = np.array([np.eye(4), prior.T_a_b])
    motion = Calibration(prior.a, (prior.a, prior.b), T, np.zeros(2), cov, np.ones(2, bool), np.ones((2, 7), bool))
    found = combine(motion, [replace(alone, by_clock=np.zeros(6))])
    return found.calibration if all(found.used) else None


def summary(draws: Sequence[Draw], reference: Array, title: str) -> str:
    """Spread, distance to the reference and stated sigma, by axis; alone and combined."""
    told = [d for d in draws if d.combined is not None]
    if len(told) < 2:
        return f"{title}\n\n{len(draws) - len(told)} of {len(draws)} refused\n"
    rows: list[list[Any]] = [["start", "standard deviation", *_spread(errors([d.start for d in draws], reference))]]
    for name in ("alone", "combined"):
        poses = [d.alone.transform.T_a_b if name == "alone" else _pose(d.combined) for d in told]
        covs = [d.alone.transform.cov if name == "alone" else _cov(d.combined) for d in told]
        e, sigma = errors(poses, reference), np.array([np.sqrt(np.diag(c)) for c in covs]) * UNITS
        away = np.abs(e - np.median(e, axis=0))
        rows.append([name, "standard deviation", *_spread(e)])
        rows.append([name, "by median absolute deviation", *1.4826 * np.median(away, axis=0)])
        rows.append([name, "median less reference", *np.median(e, axis=0)])
        rows.append([name, "stated sigma, median", *np.median(sigma, axis=0)])
        rows.append([name, "from the median by over 3 sigma, of all", *(away > 3 * sigma).sum(axis=0)])
    e = errors([_pose(d.combined) for d in told], reference)
    escaped = np.sum((np.linalg.norm(e[:, :3], axis=1) > 300) | (np.linalg.norm(e[:, 3:], axis=1) > 2))
    what = f"{title}\n\n{len(draws)} draws, {len(draws) - len(told)} refused, {escaped} end beyond 0.3 m or 2 degrees"
    return table(what, ("", "", *TITLES), rows)


def _within(rng: np.random.Generator, sigma: Array) -> Array:
    """(6,) of these sigmas, position and rotation no further than twice those in all."""
    while True:
        error = rng.normal(size=6) * sigma
        if np.linalg.norm(error[:3]) < 2 * sigma[0] and np.linalg.norm(error[3:]) < 2 * sigma[3]:
            return np.asarray(error)


def _direction(rng: np.random.Generator) -> Array:
    v = rng.normal(size=3)
    return np.asarray(v / np.linalg.norm(v))


def errors(poses: Sequence[Array], reference: Array) -> Array:
    """(k, 6) less the reference, millimetres and degrees."""
    T = np.array(poses)
    turn = se3.log_so3(T[:, :3, :3] @ reference[:3, :3].T)
    return np.concatenate([T[:, :3, 3] - reference[:3, 3], turn], axis=1) * UNITS


def _spread(errors: Array) -> Array:
    return np.asarray(errors.std(axis=0, ddof=1))


def _pose(c: Calibration | None) -> Array:
    assert c is not None
    return c.T_base_sensor[1]


def _cov(c: Calibration | None) -> Array:
    assert c is not None
    return c.covariance[7:13, 7:13]


def _line(draw: Draw, reference: Array) -> str:
    if draw.combined is None:
        return "left out: it contradicts the start"
    return " ".join(f"{v:.3g}" for v in errors([_pose(draw.combined)], reference)[0])


if __name__ == "__main__":
    main()
