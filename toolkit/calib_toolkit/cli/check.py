"""``calib-toolkit check``: whether small moves would improve a calibration from any source."""

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

if TYPE_CHECKING:
    from rich.table import Table

    from calib_toolkit.appearance.checking import Check, Judgement, Look
    from calib_toolkit.config import Config
    from calib_toolkit.plugins import Registry
    from calib_toolkit.progress import Progress
    from calib_toolkit.types import Calibration, Log

AXES = ("x", "y", "z", "rx", "ry", "rz")
COLUMNS = ("x\ncm", "y\ncm", "z\ncm", "about x\ndeg", "about y\ndeg", "about z\ndeg")
DIGITS = (1,) * 3 + (2,) * 3


@click.command()
@click.argument("drive", type=click.Path(path_type=Path))
@click.argument("calibration", metavar="CALIBRATION.json", type=click.Path(path_type=Path))
@click.option("--json", "out", metavar="FILE", type=click.Path(path_type=Path, dir_okay=False), help="For programs.")
@click.option("--format", "format_id", metavar="ID", help="Reader to use; without it, the one that knows DRIVE.")
@click.option("--start", type=float, help="Seconds to skip.")
@click.option("--duration", type=float, help="Seconds to use.")
@click.option("--config", "config_file", type=click.Path(path_type=Path), help="TOML file of options.")
@click.option("--jobs", type=click.IntRange(min=1), help="Processes; one for each core by default.")
@click.option("--seed", type=int, help="Seed of everything random.")
@click.option("--plugin", "plugins", multiple=True, type=click.Path(path_type=Path), help="One-file plugin.")
@click.pass_context
def check(
    ctx: click.Context,
    /,
    drive: Path,
    calibration: Path,
    out: Path | None,
    format_id: str | None,
    config_file: Path | None,
    plugins: tuple[Path, ...],
    **given: object,
) -> None:
    """Tell whether moving a sensor a little would make CALIBRATION.json fit DRIVE better.

    The file may come from anywhere: it needs base and, of each sensor, T_base_sensor; a clock offset that is null or
    missing is estimated from the drive. The metrics of the configuration (im, matching and map by default) and
    those of --plugin look at every pair of sensors that see the same place, at moments that run would not choose.

    Exit status 0 if nothing better was found; 3 if a move would fit better or something could not be judged; 1 if
    there is nothing to check, with the reason.
    """
    from dataclasses import replace

    from calib_toolkit.cli.bars import bars
    from calib_toolkit.cli.screen import screen
    from calib_toolkit.config import Config, read_config
    from calib_toolkit.errors import DataError
    from calib_toolkit.pipeline import open_log
    from calib_toolkit.plugins import FILE, registry
    from calib_toolkit.result_file import read_calibration

    if out is not None and not out.absolute().parent.is_dir():
        raise DataError(f"{out} can not be written, for its folder does not exist; choose another file with --json")
    installed = registry(plugins)
    config = read_config(config_file) if config_file else Config()
    own = [e.id for e in installed.entries if (e.kind, e.distribution) == ("metric", FILE)]
    given["appearance"] = (*config.appearance, *own)
    given = {k: v for k, v in given.items() if v is not None}
    config = replace(config, **given)  # type: ignore[arg-type]  # click has seen to the types
    read = read_calibration(calibration)
    log = open_log(drive, format_id, installed)
    named, notes = _common(log, read, calibration)
    log = log.select(named.names).trim(config.start, config.duration)
    with bars() as progress:
        found, timed = _checked(log, named, config, installed, progress)
    notes += timed
    if out is not None:
        _write(found, notes, out)
    console = screen()
    if found.judgements:
        console.print(
            "\nHow far each metric would move the first sensor, in axes of the second, and by how many standard "
            "errors (se) that fits better where it clearly does:"
        )
        console.print(_table(found))
    alone = [f"{n}: can not be judged, for no metric sees what it and another sensor see" for n in found.alone]
    for sentence in (*(s for j in found.judgements for s in _sentences(j)), *alone, *notes):
        console.print(sentence, markup=False, soft_wrap=True)
    if not found.fine or len(named.names) < len(read.names):
        ctx.exit(3)


def _common(log: "Log", read: "Calibration", file: Path) -> tuple["Calibration", list[str]]:
    """The calibration of the sensors that the recording has too, and what is left out. Raises DataError."""
    from dataclasses import replace

    from calib_toolkit import se3
    from calib_toolkit.errors import DataError

    placed = [n for n, known in zip(read.names, read.determined, strict=True) if known[:6].all()]
    names = [n for n in placed if n in log.streams]
    if len(names) < 2:
        raise DataError(
            f"{file} has a place for {', '.join(placed) or 'no sensor'}, and {log.source} holds "
            f"{', '.join(log.streams) or 'nothing'}; to check takes two sensors that both have, so name them alike"
        )
    notes = [f"not checked: {n}, of which {file} does not know the place" for n in read.names if n not in placed]
    notes += [f"not checked: {n}, which {log.source} does not hold" for n in placed if n not in names]
    notes += [f"not checked: {n}, which {file} does not name" for n in log.streams if n not in read.names]
    names.sort(key=lambda n: n != read.base)
    rows = [read.index(n) for n in names]
    T = read.T_base_sensor[rows]
    n, known = len(rows), read.determined[rows]
    known[:, 6] &= known[0, 6] | (names[0] == read.base)
    known[0, 6] = True
    part = replace(
        read,
        base=names[0],
        names=tuple(names),
        T_base_sensor=se3.invert(T[0]) @ T,
        dt_base_sensor=read.dt_base_sensor[rows] - read.dt_base_sensor[rows[0]],
        covariance=read.covariance.reshape(len(read.names), 7, -1, 7)[rows][:, :, rows].reshape(7 * n, 7 * n),
        has_scale=read.has_scale[rows],
        determined=known,
        undetermined=(),
        clock_skew=read.clock_skew[rows] - read.clock_skew[rows[0]],
    )
    return part, notes


def _checked(
    log: "Log", calibration: "Calibration", config: "Config", installed: "Registry", progress: "Progress"
) -> tuple["Check", list[str]]:
    """What is found, and how clocks that the file does not know were set."""
    from calib_toolkit import cache
    from calib_toolkit.appearance.checking import check
    from calib_toolkit.pipeline import sensor_motions

    moved = sensor_motions(log, config, installed, progress, cache.default_folder())
    calibration, notes = _timed(log, calibration, {n: moved[n].motions for n in calibration.names}, config)
    notes += [note for n in calibration.names for note in moved[n].notes]
    motion = {n: moved[n].motion for n in calibration.names}
    return check(log, motion, calibration, config, installed, progress), notes


def _timed(log: "Log", calibration: "Calibration", motions: Any, config: "Config") -> tuple["Calibration", list[str]]:
    """The calibration with the drive's own clock offsets where it has none."""
    from dataclasses import replace

    import numpy as np

    from calib_toolkit.errors import CalibrationError
    from calib_toolkit.pipeline import clock_offsets

    unknown = ~calibration.determined[:, 6]
    if not unknown.any():
        return calibration, []
    try:
        told = clock_offsets(motions, config, [log.streams[n].clock for n in calibration.names])
        known = told.determined[:, 6]
        dt, cov = np.where(known, told.dt_base_sensor, 0.0), told.covariance
    except CalibrationError:
        known, dt, cov = ~unknown, np.zeros(len(unknown)), calibration.covariance
    nothing = f"taken for that of {calibration.base}, for the drive tells nothing of it"
    notes = [
        f"clock of {n}: {'estimated from the drive' if k else nothing}"
        for n, k, missing in zip(calibration.names, known, unknown, strict=True)
        if missing
    ]
    used = np.tile(np.arange(7) == 6, len(known)) & np.repeat(known & unknown, 7)
    return replace(
        calibration,
        dt_base_sensor=np.where(unknown, dt, calibration.dt_base_sensor),
        covariance=np.where(np.outer(used, used), cov, calibration.covariance),
    ), notes


def _table(found: "Check") -> "Table":
    from rich.box import SIMPLE
    from rich.markup import escape
    from rich.table import Table

    table = Table("sensor", "metric", "", box=SIMPLE, padding=(0, 1, 0, 0))
    for column in COLUMNS:
        table.add_column(column, justify="right", no_wrap=True)
    for j in found.judgements:
        for k, look in enumerate(j.looks):
            who = "" if k else f"{j.b} in {j.a}"
            favours = [f"{abs(v):.1f} se" if v else "" for v in look.favours]
            table.add_row(escape(who), escape(look.metric), "move", *_cells(look.move))
            table.add_row("", "", "sigma", *_cells(look.sigma))
            table.add_row("", "", "better by", *favours, end_section=look is j.looks[-1])
    return table


def _cells(values: Any) -> list[str]:
    return ["-" if v != v else f"{round(v, d) + 0.0:.{d}f}" for v, d in zip(_plain(values), DIGITS, strict=True)]


def _sentences(j: "Judgement") -> Iterator[str]:
    """The verdict on one pair."""
    import numpy as np

    who, lead = f"{j.b} in {j.a}", j.lead
    if lead is None:
        yield f"{who}: can not be judged: {'; '.join(f'{look.metric}: {look.note}' for look in j.looks)}"
        return
    wanted, told, disputed = (np.flatnonzero(axes).tolist() for axes in (j.better, j.told, j.disputed))
    if told:
        yield f"{who}: would fit better {' and '.join(_by(lead, k) for k in told)} ({_votes(j, told)})"
    elif wanted:
        moves = " or ".join(f"{'-' if j.better[k] < 0 else '+'} {_axis(j, k)}" for k in wanted)
        yield f"{who}: a move would fit better, but which and how far is not clear: {moves} ({_votes(j, wanted)})"
    if disputed:
        axes = ", ".join(_axis(j, k) for k in disputed)
        yield f"{who}: metrics do not agree whether a move would fit better: {axes} ({_votes(j, disputed)})"
    shown = lead.shown
    if shown[:3].any() and shown[3:].any() and not wanted and not disputed:
        largest = _plain(np.where(shown, lead.sigma, 0.0))
        within = f"{largest[:3].max():.1f} cm and {largest[3:].max():.2f} deg"
        rest = "" if j.shown.all() else " in what shows"
        yield f"{who}: as good as it gets{rest}, within {within} (one sigma, {lead.metric})"
    if not j.shown.all():
        axes = ", ".join(_axis(j, k) for k in range(6) if not j.shown[k])
        yield f"{who}: not shown, and so not judged: {axes}"
    yield from (f"{who}, {look.metric}: {look.note}" for look in j.looks if not look.found)
    if not lead.held_out:
        yield f"{who}: the drive is too short for moments that a run would not look at; these are all it has"


def _by(look: "Look", k: int) -> str:
    by = float(_plain(look.move)[k])
    return f"moved by {by:+.1f} cm {_axis(look, k)}" if k < 3 else f"turned by {by:+.2f} deg {_axis(look, k)}"


def _axis(pair: "Look | Judgement", k: int) -> str:
    return f"{'along' if k < 3 else 'about'} {pair.a}'s {'xyz'[k % 3]}"


def _votes(j: "Judgement", axes: Sequence[int]) -> str:
    """By how many standard errors each metric wants a move along one of the axes."""
    largest = {look.metric: max(abs(look.favours[axes])) for look in j.looks}
    said = [f"{metric}: {times:.0f} standard errors" for metric, times in largest.items() if times]
    others = [metric for metric, times in largest.items() if not times]
    return ", ".join([*said, *([f"not {' or '.join(others)}"] if others else [])])


def _plain(move: Any) -> Any:
    """Centimetres and degrees."""
    import numpy as np

    return np.concatenate([100 * move[:3], np.degrees(move[3:])])


def _write(found: "Check", notes: list[str], file: Path) -> None:
    """For programs: every number, and the verdicts."""
    from calib_toolkit.appearance.checking import STEPS

    content = {
        "fine": found.fine,
        "steps": _by_axis(STEPS),
        "pairs": [
            {
                "a": j.a,
                "b": j.b,
                **{name: _by_axis(getattr(j, name)) for name in ("better", "disputed", "shown")},
                "verdict": list(_sentences(j)),
                "metrics": {look.metric: _numbers(look) for look in j.looks},
            }
            for j in found.judgements
        ],
        "not_compared": list(found.alone),
        "not_judged": list(found.open_),
        "notes": notes,
    }
    file.write_text(json.dumps(content, indent=1, allow_nan=False) + "\n")


def _numbers(look: "Look") -> dict[str, Any]:
    """One metric's, in metres and radians."""
    return {
        "moments": look.moments,
        "held_out": look.held_out,
        "cost": look.cost if look.cost == look.cost else None,
        **{name: _by_axis(getattr(look, name)) for name in ("costs", "gain", "move", "sigma", "favours")},
        "on_the_way": [float(v) if v == v else None for v in look.on_the_way],
        "note": look.note,
    }


def _by_axis(values: Any) -> dict[str, Any]:
    """Of an array (6,) or (s, 6) plain values, None where there is none."""
    plain = [[v if v == v else None for v in row] for row in values.T.reshape(len(AXES), -1).tolist()]
    return dict(zip(AXES, plain if values.ndim > 1 else [v for (v,) in plain], strict=True))
