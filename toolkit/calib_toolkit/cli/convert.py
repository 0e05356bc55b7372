"""``calib-toolkit convert``: a recording in another format."""

import shutil
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING

import click

from calib_toolkit.errors import ConfigError, DataError

if TYPE_CHECKING:
    from collections.abc import Mapping

    from calib_toolkit.hookspecs import Dataset, Written
    from calib_toolkit.progress import Progress
    from calib_toolkit.types import Log


PLAN = "plan"
"""File that tells what a conversion that was stopped was to write."""


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

    DST is there once all of it is, and never before; a call that was stopped goes on if it is made again (to rig
    and kitti-raw; other formats begin anew). Exit status 3 if something was not written; it is listed.
    """
    from calib_toolkit.cli.bars import bars
    from calib_toolkit.cli.chosen import sensor_names
    from calib_toolkit.pipeline import open_log
    from calib_toolkit.plugins import registry

    installed = registry(plugins)
    dataset = _writer(installed.datasets, target)
    if dst.exists():
        raise DataError(f"{dst} is there already; remove it, or name another one")
    log = open_log(src, format_id, installed).select(sensor_names(sensors)).trim(start, duration)
    if not any(len(s) for s in log.streams.values()):
        raise DataError(f"{src} holds no reading to convert")
    with bars() as progress:
        written = _whole(dataset, log, dst.absolute(), progress)
    _report(log, written, dst)
    if log.notes or written.lost or any(s.notes for s in log.streams.values()):
        ctx.exit(3)


def _writer(datasets: "Mapping[str, Dataset]", target: str) -> "Dataset":
    able = [d.id for d in datasets.values() if d.write is not None]
    if target not in able:
        raise ConfigError(f"--to {target}: no plugin writes that; there are: {', '.join(able) or 'none'}")
    return datasets[target]


def _whole(dataset: "Dataset", log: "Log", dst: Path, progress: "Progress") -> "Written":
    """Write beside DST, then move it there: what a kill leaves is no recording.

    The next call goes on from it if the format can and the readings to write are the same, and else removes it.
    """
    assert dataset.write is not None
    folder, plan, kept = dst.with_name(f".{dst.name}.part"), _plan(dataset, log), False
    try:
        if not dataset.resumes or not _holds(folder / PLAN, plan):
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir(parents=True)
            (folder / PLAN).write_text(plan)
        written = dataset.write(log, folder / dst.name, progress)
        (folder / dst.name).replace(dst)
    except OSError as e:
        kept = dataset.resumes
        raise DataError(f"{dst} can not be written ({e.strerror or e}); make room, or name another place") from e
    except KeyboardInterrupt:
        kept = dataset.resumes
        raise
    finally:
        if not kept:
            shutil.rmtree(folder, ignore_errors=True)
    return written


def _plan(dataset: "Dataset", log: "Log") -> str:
    """One word for everything that tells one conversion from others."""
    from calib_toolkit.cache import key_of

    streams = [(s.name, s.kind, s.stamps, s.has_scale, s.clock) for s in log.streams.values()]
    return key_of(dataset.id, version("calib-toolkit"), str(log.source.absolute()), log.epoch_ns, streams)


def _holds(file: Path, text: str) -> bool:
    try:
        return file.read_text() == text
    except (OSError, UnicodeDecodeError):
        return False


def _report(log: "Log", written: "Written", dst: Path) -> None:
    for sentence in (*log.notes, *(n for s in log.streams.values() for n in s.notes)):
        click.echo(f"read: {sentence}")
    for sentence in written.lost:
        click.echo(f"not written: {sentence}")
    read = sum(len(s) for s in log.streams.values())
    parts = ", ".join(f"{name} {written.readings.get(name, 0)}" for name in log.streams)
    total = sum(written.readings.values())
    click.echo(f"{dst / written.inside}: {read} readings read, {total} written ({parts}), {read - total} skipped")
