"""``calib-toolkit inspect``: what a recording holds and what is wrong with it."""

import math
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING

import click

if TYPE_CHECKING:
    from rich.console import Console

    from calib_toolkit.types import Log


@click.command()
@click.argument("drive", type=click.Path(path_type=Path))
@click.option("--format", "format_id", metavar="ID", help="Reader to use; without it, the one that knows DRIVE.")
@click.option("--plugin", "plugins", multiple=True, type=click.Path(path_type=Path), help="One-file plugin.")
@click.pass_context
def inspect(ctx: click.Context, drive: Path, format_id: str | None, plugins: tuple[Path, ...]) -> None:
    """Show the sensors of DRIVE, their rates, spans and gaps, and what is wrong with the recording.

    Exit status 0 if nothing is wrong, 3 if something is.
    """
    from rich.box import SIMPLE
    from rich.markup import escape
    from rich.table import Table

    from calib_toolkit.cli.screen import screen
    from calib_toolkit.inspection import inspect_log
    from calib_toolkit.pipeline import open_log
    from calib_toolkit.plugins import registry

    log = open_log(drive, format_id, registry(plugins))
    seen = inspect_log(log)
    console = screen()
    console.print(f"{seen.source}: {seen.duration:.1f} s{_date(log.epoch_ns)}", markup=False, soft_wrap=True)
    table = Table("sensor", "kind", box=SIMPLE)
    for column in ("readings", "rate Hz", "start s", "end s", "gaps", "longest s"):
        table.add_column(column, justify="right")
    for s in seen.sensors:
        numbers = (_number(x, 3) for x in (s.rate, s.start, s.end))
        table.add_row(
            escape(s.name), escape(s.kind), str(s.readings), *numbers, str(s.gaps), _number(s.largest_gap, 4)
        )
    console.print(table)
    if log.topics:
        _show_topics(log, console)
    for problem in seen.problems:
        console.print(f"- {problem}", markup=False, soft_wrap=True)
    if not seen.clean:
        ctx.exit(3)
    console.print("nothing wrong was found")


def _show_topics(log: "Log", console: "Console") -> None:
    """All that was recorded, what it is taken for, and how to name it."""
    from rich.box import SIMPLE
    from rich.markup import escape
    from rich.table import Table

    table = Table(box=SIMPLE)
    for column in ("topic", "type"):
        table.add_column(column, overflow="fold")
    for column in ("messages", "rate Hz"):
        table.add_column(column, justify="right")
    table.add_column("sensor, or why it is none", overflow="fold")
    for t in log.topics:
        cells = (t.name, t.type.replace("/msg/", "/"), str(t.messages), _number(t.rate, 2), t.sensor or t.unused)
        table.add_row(*map(escape, cells))
    console.print(table)
    names = ",".join(f"{s.name}={s.topic}" for s in log.streams.values())
    console.print(f"--sensors {names}", markup=False, soft_wrap=True)


def _date(epoch_ns: int) -> str:
    dated = 10**17 < epoch_ns < 10**19  # anything else counts from a start of its own, not from 1970
    return f", from {datetime.fromtimestamp(epoch_ns / 1e9, UTC):%F %T} UTC" if dated else ""


def _number(x: float, digits: int) -> str:
    return "-" if math.isnan(x) else f"{x:.{digits}f}"
