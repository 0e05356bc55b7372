"""``calib-toolkit plugins``: what is installed, and where from."""

from pathlib import Path

import click


@click.command()
@click.option("--plugin", "files", multiple=True, type=click.Path(path_type=Path), help="One-file plugin.")
def plugins(files: tuple[Path, ...]) -> None:
    """List every sensor, metric, dataset reader and exporter: its distribution, version and source file."""
    from rich.box import SIMPLE
    from rich.markup import escape
    from rich.table import Table

    from calib_toolkit.cli.screen import screen
    from calib_toolkit.plugins import registry

    table = Table("id", "kind", "distribution", "version", box=SIMPLE)
    table.add_column("source", overflow="fold")
    for e in sorted(registry(files).entries, key=lambda e: (e.kind, e.id)):
        table.add_row(*map(escape, (e.id, e.kind, e.distribution, e.version, e.source)))
    screen().print(table)
