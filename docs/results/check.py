"""How often ``check`` cries wolf, and what it notices: ``python docs/results/check.py DRIVE TRUTH.json``.

Every trial is one ``check`` with a seed of its own, of the truth or of the truth with every other sensor moved along
or about one axis. Prints a row, as Markdown, for each size of the move and each pair that the base is part of.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import click
import numpy as np
from numpy.typing import NDArray
from scipy.stats import binomtest
from summaries import table, tell

from calib_toolkit import Calibration, Config, open_log, read_calibration, se3
from calib_toolkit.appearance.checking import Judgement, check
from calib_toolkit.cache import default_folder
from calib_toolkit.pipeline import sensor_motions
from calib_toolkit.plugins import registry
from calib_toolkit.progress import Silent

Array = NDArray[np.float64]

SHIFTS, TURNS_DEG = (0.02, 0.05, 0.1), (0.2, 0.5, 1.0)
"""Metres and degrees."""
NOTHING = "nothing"
AXES = ("x", "y", "z", "about x", "about y", "about z")


@dataclass(frozen=True)
class Trial:
    """One pair of one check. moved: (6,) how far b was moved, ``(dt, delta)`` in axes of the base."""

    what: str
    seed: int
    moved: Array
    judgement: Judgement


@click.command(context_settings={"show_default": True})
@click.argument("drive", type=click.Path(exists=True, path_type=Path))
@click.argument("calibration", metavar="TRUTH.json", type=click.Path(exists=True, path_type=Path))
@click.option("--seeds", type=click.IntRange(0), default=20, help="Trials of the truth itself.")
@click.option("--moves", type=click.IntRange(0), default=6, help="Trials of each size of a move.")
@click.option("--metrics", default="im,matching,map", help="Which metrics look.")
@click.option(
    "--moments", type=click.IntRange(8), default=25, help="As run looks at; check looks at four times as many."
)
@click.option("--jobs", type=click.IntRange(1), default=2, help="Pairs at a time.")
@click.option("--out", type=click.Path(path_type=Path, dir_okay=False), help="Write the tables, too.")
def main(drive: Path, calibration: Path, seeds: int, moves: int, metrics: str, out: Path | None, **more: int) -> None:
    """False alarms and faults noticed."""
    installed, config = registry(), Config(appearance=tuple(metrics.split(",")), **more)
    truth = read_calibration(calibration)
    log = open_log(drive).select(truth.names)
    moved = sensor_motions(log, config, installed, Silent(), default_folder())
    motion = {n: moved[n].motion for n in truth.names}
    trials = []
    for what, seed, change in drawn(seeds, moves):
        found = check(log, motion, off(truth, change), replace(config, seed=seed), installed, Silent())
        new = [Trial(what, seed, change, j) for j in found.judgements if j.a == truth.base]
        trials += new
        for t in new:
            print(line(t), flush=True)
    tell(summary(trials, f"{drive.name}: a fault counts as noticed if status 3 follows from it"), out)


def drawn(seeds: int, moves: int) -> Iterator[tuple[str, int, Array]]:
    """What is moved, the seed, and the move (6,); of each size every axis in turn, one way or the other."""
    for seed in range(seeds):
        yield NOTHING, seed, np.zeros(6)
    sizes = [(f"{100 * s:g} cm", s, 0) for s in SHIFTS] + [(f"{d:g} deg", np.radians(d), 3) for d in TURNS_DEG]
    for k, (what, size, first) in enumerate(sizes):
        for seed in range(moves):
            sign = np.random.default_rng([k, seed]).choice([-1.0, 1.0])
            yield what, seed, sign * size * np.eye(6)[first + seed % 3]


def off(truth: Calibration, change: Array) -> Calibration:
    """The truth with every sensor but the base moved (6,): ``(dt, delta)`` in axes of the base."""
    T = truth.T_base_sensor.copy()
    others = np.array(truth.names) != truth.base
    T[others, :3, :3] = se3.exp_so3(change[3:]) @ T[others, :3, :3]
    T[others, :3, 3] += change[:3]
    return replace(truth, T_base_sensor=T)


def noticed(j: Judgement) -> bool:
    """Whether the pair is said to be better elsewhere, or metrics not to agree on it."""
    return bool(np.any(j.better != 0) or j.disputed.any())


def right(t: Trial) -> bool:
    """Whether the whole move that the sharpest metric proposes leads nearer to the truth than the fault was."""
    lead = t.judgement.lead
    if lead is None:
        return False
    scale = np.array([1.0] * 3 + [5.0] * 3)  # a degree is as bad as 9 cm
    return bool(np.linalg.norm(scale * (lead.move + t.moved)) < np.linalg.norm(scale * t.moved))


def line(t: Trial) -> str:
    """A trial, for whoever waits or wants to know more."""
    lead, j = t.judgement.lead, t.judgement
    said = "no pose found" if lead is None else f"move {_plain(lead.move)} sigma {_plain(lead.sigma)}"
    says = {
        look.metric: " ".join(f"{AXES[k]} {look.favours[k]:+.1f}" for k in np.flatnonzero(look.favours))
        for look in j.looks
    }
    return f"{j.b} in {j.a}, seed {t.seed}, {t.what} {_plain(t.moved)}: better {j.better.tolist()} {says}; {said}"


def summary(trials: list[Trial], title: str) -> str:
    """A row for each pair and size of a move, with Wilson intervals."""
    groups: dict[tuple[str, str], list[Trial]] = {}
    for t in trials:
        groups.setdefault((f"{t.judgement.b} in {t.judgement.a}", t.what), []).append(t)
    rows = []
    for (pair, what), of in groups.items():
        count = sum(noticed(t.judgement) for t in of)
        chance = binomtest(count, len(of)).proportion_ci(method="wilson")
        led = sum(right(t) for t in of)
        unseen = sum(not t.judgement.shown.all() for t in of)
        rows.append([pair, what, len(of), count, f"{100 * chance.low:.0f} to {100 * chance.high:.0f}"])
        rows[-1] += ["" if what == NOTHING else led, unseen]
    header = ("pair", "moved by", "trials", "noticed", "% (95 % interval)", "led nearer", "some axis not shown")
    return table(title, header, rows)


def _plain(move: Array) -> str:
    return " ".join(f"{v:.2f}" for v in (*100 * move[:3], *np.degrees(move[3:])))


if __name__ == "__main__":
    main()
