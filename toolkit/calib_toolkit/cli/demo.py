"""``calib-toolkit demo``: a simulated drive, calibrated from its raw files, with the truth beside the estimate."""

from pathlib import Path

import click

from calib_toolkit.errors import PluginError

RIG = "compact"


@click.command()
@click.option("-o", "--out", type=click.Path(path_type=Path, file_okay=False), default=Path("calib-out-demo"))
@click.option(
    "--seconds", type=click.FloatRange(min=10.0), default=70.0, show_default=True, help="Length of the drive."
)
@click.option(
    "--seed",
    type=click.IntRange(min=0),
    default=1,
    show_default=True,
    help="Each seed is another vehicle on another street.",
)
@click.pass_context
def demo(ctx: click.Context, out: Path, seconds: float, seed: int) -> None:
    """Make a drive with a lidar, a camera and a GPS/INS, and calibrate them from the raw files.

    Where the sensors really sit and how late their clocks really are is known exactly, and is shown. The drive is
    kept: the next call with the same seconds and seed only calibrates.
    """
    from calib_toolkit.cli import main
    from calib_toolkit.cli.run import run

    simulate = main.get_command(ctx, "simulate")
    if simulate is None:
        raise PluginError("no installed plugin brings the command 'simulate'; install calib-toolkit again")
    drive = out / f"drive-{seconds:g}s-seed{seed}"
    ctx.invoke(simulate, dst=drive, rig=RIG, seconds=seconds, seed=seed)
    click.echo("\nCalibrating; the reference below is the truth.")
    ctx.invoke(run, drive=drive, out=out)
