"""Two halves of the frames that share none, compared: ``python docs/results/halves.py RECORDING A,B``.

Both start from the recording's reference. If sigmas are honest, NEES of the difference is 6 on average; what a metric
is off on any drive is in both halves and left out. Prints one row, as Markdown, for every other frame against the
rest, and one for each split that is drawn.
"""

from pathlib import Path

import click
import numpy as np
from draws import TITLES, UNITS, Array, Index, errors, found_by, pair_of
from summaries import table, tell

from calib_toolkit import Pair
from calib_toolkit.plugins import registry


@click.command(context_settings={"show_default": True})
@click.argument("recording", type=click.Path(exists=True, path_type=Path))
@click.argument("sensors")
@click.option("--metric", default="im", help="Which metric.")
@click.option("--splits", type=click.IntRange(1), default=8, help="How many are drawn.")
@click.option("--frames", type=click.IntRange(1), default=200, help="Frames of the recording to split, at most.")
@click.option("--shift", default=0.15, help="Sigma of the start, metres an axis.")
@click.option("--turn", default=1.5, help="Sigma of the start, degrees an axis.")
@click.option("--seed", type=click.IntRange(0), default=0, help="Of all that is drawn.")
@click.option("--out", type=click.Path(path_type=Path, dir_okay=False), help="Write the table, too.")
def main(
    recording: Path, sensors: str, metric: str, splits: int, frames: int, shift: float, turn: float, seed: int,
    out: Path | None,
) -> None:  # fmt: skip
    """How far apart the answers of two halves of the frames lie, in what they state."""
    pair = pair_of(recording, sensors, frames, seed)
    rng, count = np.random.default_rng(seed), len(pair.selected)
    every_other = np.concatenate([np.arange(0, count, 2), np.arange(1, count, 2)])
    sigma = np.array([shift] * 3 + [np.radians(turn)] * 3)
    rows, told = [], []
    for k in range(splits + 1):
        order = rng.permutation(count) if k else every_other
        found = _difference(metric, pair, order[: count // 2], order[count // 2 :], sigma, seed + 2 * k)
        if isinstance(found, str):
            rows.append([_name(k), *[""] * len(TITLES), found])
            continue
        apart, cov = found
        nees = float(apart @ np.linalg.solve(cov, apart))
        rows.append([_name(k), *apart * UNITS, f"{nees:.1f}"])
        told += [nees] if k else []
        click.echo(f"{_name(k)}: NEES {nees:.1f}", err=True)
    what = f"{sensors} of {recording.name} by {metric}: {count} frames, starts to {shift} m and {turn} degrees"
    mean = f"NEES of {len(told)} that are drawn: {np.mean(told):.1f} on average (6)" if told else "none compared"
    tell(table(f"{what}. {mean}", ("split", *TITLES, "NEES"), rows), out)


def _name(k: int) -> str:
    return f"drawn {k}" if k else "every other"


def _difference(
    metric: str, pair: Pair, one: Index, other: Index, sigma: Array, seed: int
) -> tuple[Array, Array] | str:
    """(6,) and covariance, metres and radians; or why a half was refused."""
    T = pair.prior.T_a_b
    halves = [found_by(metric, pair, rows, T, sigma, seed + k) for k, rows in enumerate((one, other))]
    if not all(h.converged for h in halves):
        return next(h.note for h in halves if not h.converged)
    own = np.diag(np.square(getattr(registry().metrics[metric], "own", np.zeros(6))))
    found = errors([h.transform.T_a_b for h in halves], T) / UNITS
    return found[0] - found[1], sum(h.transform.cov - own for h in halves)


if __name__ == "__main__":
    main()
