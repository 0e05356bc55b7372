"""``calib-toolkit evaluate``: the paper's experiments on drives whose truth is known."""

import os
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import click

if TYPE_CHECKING:
    from calib_toolkit.types import Calibration

NAMES = ("timing", "pair", "panoramic", "appearance", "full")
LEFT_TO_THE_FILE = ("mean", "RMS", "sigma", "sections", "no truth", "paper")
"""Columns of the summary that a terminal has no room for, those of a sigma with whatever follows."""
WORDS = ("estimator", "sensor", "metric", "search")
"""Columns that hold no numbers."""


def _methods(ctx: click.Context, param: click.Parameter, given: tuple[str, ...]) -> tuple[str, ...]:
    """The methods named, each once, or all there are; asked of the configuration only when the command runs."""
    from calib_toolkit.config import METHODS

    for name in given:
        if name not in METHODS:
            raise click.BadParameter(f"there is no method '{name}'; there are: {', '.join(METHODS)}", ctx, param)
    return tuple(dict.fromkeys(given)) or tuple(METHODS)


@click.command()
@click.argument("protocol", type=click.Choice(NAMES))
@click.argument("drives", metavar="DRIVE...", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option(
    "-o",
    "--out",
    required=True,
    type=click.Path(path_type=Path, file_okay=False),
    help="Folder for table and figure.",
)
@click.option("--sensors", metavar="A,B,...", help="Sensors to compare; the cameras, or for 'pair' the first two.")
@click.option("--truth", type=click.Path(path_type=Path), help="calibration.json to compare with, for all drives.")
@click.option(
    "--repeats", type=click.IntRange(min=1), default=100, show_default=True, help="Sections of each length."
)
@click.option("--seconds", metavar="A,B,...", help="Lengths of the sections; the paper's by default.")
@click.option(
    "--baseline", is_flag=True, help="Baselines beside: OpenCV's for 'pair', least squares for 'panoramic'."
)
@click.option(
    "--method",
    "methods",
    metavar="NAME",
    multiple=True,
    callback=_methods,
    help="Estimator to compare, again for each; all of them by default. Baselines use the first one's clock offsets, "
    "'appearance' its sigmas.",
)
@click.option(
    "--appearance",
    "metrics",
    metavar="A,B,...",
    help="Metrics of 'appearance' (all that search a pose by default) and 'full' (those of a run by default).",
)
@click.option(
    "--wider",
    type=click.FloatRange(min=0.0, min_open=True),
    default=1.0,
    show_default=True,
    help="Times the motion's sigma that the starts of 'appearance' are drawn with.",
)
@click.option("--jobs", type=click.IntRange(min=1), help="Processes; one for each core by default.")
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True, help="Seed of the sections.")
@click.pass_context
def evaluate(
    ctx: click.Context,
    /,
    protocol: str,
    drives: tuple[Path, ...],
    out: Path,
    sensors: str | None,
    truth: Path | None,
    repeats: int,
    seconds: str | None,
    baseline: bool,
    methods: tuple[str, ...],
    metrics: str | None,
    wider: float,
    jobs: int | None,
    seed: int,
) -> None:
    """Repeat one of the paper's experiments on random sections of drives whose truth is known.

    PROTOCOL is timing (clock offsets), pair (two sensors), panoramic (a ring of cameras), appearance (a lidar and a
    camera, by each metric) or full (all sensors by motion and appearance). Writes a table, a summary and a figure to
    the folder; the same command goes on where a killed one stopped. Exit status 0 when every repeat has its rows,
    refused ones included; 3 when some failed in a way that nobody foresaw; 1 when nothing can be compared, with the
    reason; 2 for wrong usage.
    """
    from calib_toolkit.cli.bars import bars
    from calib_toolkit.config import Config
    from calib_toolkit.evaluation import experiment, figures, panorama, shares, store, summary
    from calib_toolkit.evaluation.drives import open_drives
    from calib_toolkit.evaluation.errors import UNEXPECTED, UNITS
    from calib_toolkit.evaluation.protocols import protocol as named
    from calib_toolkit.evaluation.sights import asked, metrics_of
    from calib_toolkit.plugins import registry
    from calib_toolkit.result_file import read_calibration

    chosen = named(protocol)
    lengths = _lengths(seconds) or chosen.seconds
    config = Config(seed=seed, jobs=jobs or os.cpu_count() or 1)
    known = read_calibration(truth) if truth else None
    names = _names(sensors)
    if metrics is not None:
        config = replace(config, appearance=tuple(m.strip() for m in metrics.split(",") if m.strip()))
    if chosen.sees:
        asked(config, registry())
    choices = experiment.Choices(repeats, lengths, methods, baseline, wider)
    chosen.estimators(methods, baseline)  # refuses what does not go together

    def check(truths: "Mapping[str, Calibration]") -> None:
        experiment.check(chosen, truths)
        store.writable(out)

    with bars() as progress:
        opened = open_drives(drives, (lambda _: names) if names else chosen.choose, known, check, config, progress)
        if chosen.by_metric:
            config = replace(config, appearance=metrics_of(opened[0].log, config, registry()))
        done = experiment.run(protocol, opened, out, choices, config, progress)
    notes = [f"{d.name}: {note}" for d in opened for note in d.notes] + experiment.notes(protocol, choices)
    if protocol == "panoramic":
        notes.append(panorama.draw(opened[0], done.rows, out / "panorama.png"))
    figures.draw(protocol, done.rows, out / f"{protocol}.png")
    (out / f"{protocol}.md").write_text(summary.markdown(protocol, done, notes), encoding="utf-8")
    for title, lines in shares.tables(protocol, done.rows):
        _show(title, lines)
    for parameter in chosen.short:
        _show(f"{parameter}, {UNITS[parameter]}", summary.table(protocol, done.rows, parameter))
    refused = sum(row["status"] == "refused" for row in done.rows)
    click.echo(f"{len(done.rows)} rows, {refused} of them refused")
    for note in (*done.skipped, *notes):
        click.echo(note)
    click.echo(f"written: {', '.join(str(out / f'{protocol}.{end}') for end in ('csv', 'md', 'png'))}")
    if failed := sum(row["note"].startswith(UNEXPECTED) for row in done.rows):
        click.echo(
            f"{failed} row{'s' * (failed > 1)} failed unexpectedly, a fault of this program: see the table's notes",
            err=True,
        )
        ctx.exit(3)


def _show(title: str, lines: list[list[str]]) -> None:
    from rich.table import Table

    from calib_toolkit.cli.screen import screen

    if not lines:
        return
    told = [any(cells) for cells in zip(*lines[1:], strict=True)]
    shown = [k for k, column in enumerate(lines[0]) if told[k] and not column.startswith(LEFT_TO_THE_FILE)]
    table = Table(title=title, title_justify="left", box=None, padding=(0, 2, 0, 0))
    for k in shown:
        side: Literal["left", "right"] = "left" if lines[0][k] in WORDS else "right"
        table.add_column(lines[0][k].replace(" ", "\n"), justify=side, no_wrap=True)
    for cells in lines[1:]:
        table.add_row(*(cells[k] for k in shown))
    screen(markup=False).print(table, "")


def _names(sensors: str | None) -> list[str]:
    names = [n.strip() for n in (sensors or "").split(",") if n.strip()]
    if sensors is not None and not names:
        raise click.BadParameter("no sensor is named", param_hint="--sensors")
    return names


def _lengths(seconds: str | None) -> tuple[float, ...]:
    try:
        lengths = tuple(float(s) for s in (seconds or "").split(",") if s.strip())
    except ValueError as e:
        raise click.BadParameter(f"{seconds!r} is not a list of numbers", param_hint="--seconds") from e
    if seconds is not None and not lengths:
        raise click.BadParameter("no length is given", param_hint="--seconds")
    if not all(1.0 <= s < float("inf") for s in lengths) or len({f"{s:g}" for s in lengths}) < len(lengths):
        raise click.BadParameter(
            "each length is at least one second, and given once (to six digits)", param_hint="--seconds"
        )
    return lengths
