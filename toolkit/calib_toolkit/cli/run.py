"""``calib-toolkit run``: from a recorded drive to its calibration."""

from pathlib import Path
from tempfile import TemporaryFile
from time import time
from typing import TYPE_CHECKING

import click

from calib_toolkit.errors import ConfigError, DataError

if TYPE_CHECKING:
    from calib_toolkit.config import Config


@click.command()
@click.argument("drive", type=click.Path(path_type=Path))
@click.option(
    "--sensors", metavar="A,B=C,...", help="Sensors to calibrate, all by default; B=C calls C (a name or a topic) B."
)
@click.option("-o", "--out", type=click.Path(path_type=Path, file_okay=False), help="Folder for calibration.json.")
@click.option("--format", "format_id", metavar="ID", help="Reader to use; without it, the one that knows DRIVE.")
@click.option("--base", metavar="NAME", help="Sensor whose frame the poses are in; the first that has scale.")
@click.option("--start", type=float, help="Seconds to skip.")
@click.option("--duration", type=float, help="Seconds to use.")
@click.option("--method", type=click.Choice(["joint", "paper"]), help="Estimator; joint by default.")
@click.option(
    "--appearance",
    metavar="M,M,...",
    help="Metrics that refine the motion's result where sensors see the same; none stops after motion.",
)
@click.option("--config", "config_file", type=click.Path(path_type=Path), help="TOML file of options.")
@click.option(
    "--prior",
    "prior_file",
    metavar="FILE",
    type=click.Path(path_type=Path),
    help="TOML of measured numbers, or a JSON calibration.",
)
@click.option("--jobs", type=click.IntRange(min=1), help="Processes; one for each core by default.")
@click.option("--seed", type=int, help="Seed of everything random.")
@click.option("--plugin", "plugins", multiple=True, type=click.Path(path_type=Path), help="One-file plugin.")
@click.pass_context
def run(
    ctx: click.Context,
    /,
    drive: Path,
    sensors: str | None,
    out: Path | None,
    format_id: str | None,
    appearance: str | None,
    config_file: Path | None,
    prior_file: Path | None,
    plugins: tuple[Path, ...],
    **chosen: object,
) -> None:
    """Calibrate the sensors of DRIVE: where each sits, how late its clock is, and how sure that is.

    Exit status 0 when everything was determined; 3 when data were skipped or a direction was not determined; 1 when
    nothing could be told, with the reason; 2 for wrong usage.
    """
    from dataclasses import replace

    from calib_toolkit.cli.bars import bars
    from calib_toolkit.cli.chosen import sensor_names
    from calib_toolkit.cli.screen import screen
    from calib_toolkit.cli.tables import show_result
    from calib_toolkit.config import Config, read_config
    from calib_toolkit.pipeline import calibrate, open_log
    from calib_toolkit.plugins import registry
    from calib_toolkit.result_file import write_result

    given = {name: value for name, value in chosen.items() if value is not None}
    # click has seen to the types
    config = replace(read_config(config_file) if config_file else Config(), **given)  # type: ignore[arg-type]
    if appearance is not None:
        config = replace(config, appearance=tuple(m.strip() for m in appearance.split(",") if m.strip()))
    if prior_file:
        config = _with_prior(config, prior_file)
    installed, started = registry(plugins), time()
    log = open_log(drive, format_id, installed).select(sensor_names(sensors))
    file = _writable(out) if out else None
    pictures = out / "overlay" if out else None
    with bars() as progress:
        result = calibrate(log, config, installed, progress, pictures=pictures)
    if file is not None:
        write_result(result, file)
    span = log.trim(config.start, config.duration).span
    show_result(result, screen(), log.reference, sum(span) / 2)
    if file is not None:
        click.echo(f"written: {file}")
    if pictures and any(p.stat().st_mtime >= started for p in pictures.glob("*")):  # not those of an earlier run
        click.echo(f"written: {pictures}, pictures to judge it by")
    if not result.complete:
        ctx.exit(3)


def _with_prior(config: "Config", file: Path) -> "Config":
    """The configuration with a file's measured numbers, in the base that the file names."""
    from dataclasses import replace

    from calib_toolkit.cli import prior as prior_files

    prior = prior_files.read(file)
    if prior.base and config.base and prior.base != config.base:
        raise ConfigError(
            f"the numbers in {file} are given in {prior.base}, and the base of this run is {config.base}; choose one"
        )
    return replace(config, base=config.base or prior.base, prior=prior.numbers)


def _writable(out: Path) -> Path:
    """The result's file in a folder that exists and can be written, found out before the work and not after."""
    file = out / "calibration.json"
    try:
        out.mkdir(parents=True, exist_ok=True)
        if file.is_dir():
            raise IsADirectoryError(f"{file} is a folder")
        with TemporaryFile(dir=out):
            return file
    except OSError as e:
        raise DataError(f"{out} can not take the result ({e.strerror or e}); choose another folder with -o") from e
