"""``calib-toolkit convert``: a recording in another format."""

import shutil
from pathlib import Path
from typing import TYPE_CHECKING

import click

from calib_toolkit.errors import ConfigError, DataError

if TYPE_CHECKING:
    from collections.abc import Mapping

    from calib_toolkit.hookspecs import Dataset, Written
    from calib_toolkit.progress import Progress
    from calib_toolkit.types import Log


@click.command()
@click.argument("src", type=click.Path(path_type=Path))
@click.argument("dst", type=click.Path(path_type=Path))
@click.option("--to", "target", metavar="ID", required=True, help="Format to write; a wrong one lists them.")
@click.option("--sensors", metavar="A,B=C,...", help="Sensors to convert; B=C writes C under the name B.")
@click.option("--format", "format_id", metavar="ID", help="Reader to use; without it, the one that knows SRC.")
@click.option("--start", type=float, default=0.0, help="Seconds to skip.")
@click.option("--duration", type=float, help="Seconds to convert.")
@click.option("--plugin", "plugins", multiple=True, type=click.Path(path_type=Path), help="One-file plugin.")
@click.pass_context
def convert(
    ctx: click.Context,
    src: Path,
    dst: Path,
    target: str,
    sensors: str | None,
    format_id: str | None,
    start: float,
    duration: float | None,
    plugins: tuple[Path, ...],
) -> None:
    """Write the recording SRC as DST in another format.

    DST is there once all of it is, and never before. Exit status 3 if something was not written; it is listed.
    """
    from calib_toolkit.cli.bars import bars
    from calib_toolkit.cli.run import _names
    from calib_toolkit.pipeline import open_log
    from calib_toolkit.plugins import registry

    installed = registry(plugins)
    dataset = _writer(installed.datasets, target)
    if dst.exists():
        raise DataError(f"{dst} is there already; remove it, or name another one")
    log = open_log(src, format_id, installed).select(_names(sensors)).trim(start, duration)
    if not any(len(s) for s in log.streams.values()):
        raise DataError(f"{src} holds no reading to convert")
    with bars() as progress:
        written = _whole(dataset, log, dst, progress)
    _report(log, written, dst)
    if log.notes or written.lost or any(s.notes for s in log.streams.values()):
        ctx.exit(3)


def _writer(datasets: "Mapping[str, Dataset]", target: str) -> "Dataset":
    able = [d.id for d in datasets.values() if d.write is not None]
    if target not in able:
        raise ConfigError(f"--to {target}: no plugin writes that; there are: {', '.join(able) or 'none'}")
    return datasets[target]


def _whole(dataset: "Dataset", log: "Log", dst: Path, progress: "Progress") -> "Written":
    """Write beside DST, then move it there: what a kill leaves is no recording, and the next call removes it."""
    assert dataset.write is not None
    folder = dst.absolute().with_name(f".{dst.name}.part")
    try:
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        written = dataset.write(log, folder / dst.name, progress)
        (folder / dst.name).replace(dst)
    except OSError as e:
        raise DataError(f"{dst} can not be written ({e.strerror or e}); make room, or name another place") from e
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    return written


def _report(log: "Log", written: "Written", dst: Path) -> None:
    for sentence in (*log.notes, *(n for s in log.streams.values() for n in s.notes)):
        click.echo(f"read: {sentence}")
    for sentence in written.lost:
        click.echo(f"not written: {sentence}")
    read = sum(len(s) for s in log.streams.values())
    parts = ", ".join(f"{name} {written.readings.get(name, 0)}" for name in log.streams)
    total = sum(written.readings.values())
    click.echo(f"{dst / written.inside}: {read} readings read, {total} written ({parts}), {read - total} skipped")
