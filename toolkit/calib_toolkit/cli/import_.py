"""``calib-toolkit import``: a calibration out of the format of another program."""

from pathlib import Path
from typing import TYPE_CHECKING

import click

if TYPE_CHECKING:
    from calib_toolkit.types import Calibration


@click.command("import")
@click.argument("file", type=click.Path(path_type=Path))
@click.option("--from", "format_id", metavar="FORMAT", help="Format of FILE; without it, the one that knows FILE.")
@click.option("-o", "--out", type=click.Path(path_type=Path, dir_okay=False), required=True, help="calibration.json.")
@click.option(
    "--sigma",
    metavar="M,DEG,MS",
    help="How sure positions, angles and clock offsets are, in metres, degrees and milliseconds: 0.05,1,10.",
)
@click.option("--plugin", "plugins", multiple=True, type=click.Path(path_type=Path), help="One-file plugin.")
def import_(file: Path, format_id: str | None, out: Path, sigma: str | None, plugins: tuple[Path, ...]) -> None:
    """Read FILE, a calibration in the format of another program, as a calibration.json.

    The result can be given to compare, check, export and run --prior. Most formats do not say how sure their numbers
    are: compare then takes them as exact, and run --prior refuses them, unless --sigma says it. Clock offsets are
    null where neither FILE nor a clocks.yaml beside it has them.
    """
    from calib_toolkit.errors import DataError
    from calib_toolkit.plugins import registry
    from calib_toolkit.result_file import write_calibration

    installed = registry(plugins)
    if not file.exists():
        raise DataError(f"{file} does not exist; name the file or folder of a calibration")
    exporter = installed.exporter(format_id) if format_id else installed.exporter_of(file)
    read = exporter.read(file)
    if sigma is not None:
        read = _with_sigma(read, sigma)
    stated = bool(read.covariance.any()) or not read.determined[:, :6].all()
    try:
        write_calibration(read, out, sigmas=stated)
    except OSError as e:
        raise DataError(f"{out} can not be written ({e.strerror or e}); choose another file with -o") from e
    others = [n for n in read.names if n != read.base]
    click.echo(f"read as {exporter.id}: {', '.join(others) or 'nothing else'} in the frame of {read.base}")
    if exporter.loses:
        click.echo(f"not kept by {exporter.id}: {exporter.loses}")
    click.echo(f"written: {out}")


def _with_sigma(c: "Calibration", given: str) -> "Calibration":
    """The calibration with one standard deviation for all positions, one for all angles, one for all offsets."""
    from dataclasses import replace

    import numpy as np

    try:
        metres, degrees, milliseconds = (float(x) for x in given.split(","))
    except ValueError:
        raise click.BadParameter("give three numbers: metres,degrees,milliseconds", param_hint="--sigma") from None
    sigma = np.array([metres] * 3 + [np.radians(degrees)] * 3 + [milliseconds / 1e3])
    if not np.all(np.isfinite(sigma)) or not np.all(sigma > 0):
        raise click.BadParameter("each of the three must be above zero", param_hint="--sigma")
    sigmas = np.where([[n == c.base] for n in c.names], 0.0, sigma)
    return replace(c, covariance=np.diag(sigmas.ravel() ** 2))
