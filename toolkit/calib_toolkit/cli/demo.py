"""``calib-toolkit demo``: a simulated drive, calibrated, with the truth beside the estimate."""

from pathlib import Path

import click

DRIVE = """\
seconds = {seconds}
seed = {seed}

# pose: x y z in metres, roll pitch yaw in degrees, in the vehicle (x forward, y left, z up)
[sensors.velo]
pose = [0.0, 0.0, 1.7, 0.0, 0.0, 0.0]
sigma = [0.008, 0.008, 0.008, 3e-4, 3e-4, 3e-4]

[sensors.ins]
pose = [-0.8, 0.3, 0.9, 0.8, -0.1, 1.0]
dt = -0.060
rate = 50.0
sigma = [0.002, 0.002, 0.002, 1e-4, 1e-4, 1e-4]

[sensors.cam0]
pose = [0.3, 0.1, 1.6, -90.0, 0.0, -90.0]
dt = 0.025
has_scale = false
sigma = [0.01, 0.01, 0.01, 2e-4, 2e-4, 2e-4]

[sensors.cam1]
pose = [-0.2, -0.6, 1.6, -91.0, 1.0, -135.0]
dt = 0.031
rate = 12.0
has_scale = false
sigma = [0.01, 0.01, 0.01, 2e-4, 2e-4, 2e-4]
"""


@click.command()
@click.option("-o", "--out", type=click.Path(path_type=Path, file_okay=False), default=Path("calib-out-demo"))
@click.option("--seconds", type=float, default=120.0, show_default=True, help="Length of the drive.")
@click.option("--seed", type=int, default=1, show_default=True, help="Seed of the drive and its noise.")
@click.pass_context
def demo(ctx: click.Context, out: Path, seconds: float, seed: int) -> None:
    """Simulate two minutes of driving with a lidar, an INS and two cameras, and calibrate them.

    The readings are each sensor's own motion with noise; where the sensors really sit is known, and shown.
    """
    drive = out / "drive"
    drive.mkdir(parents=True, exist_ok=True)
    (drive / "simulated.toml").write_text(DRIVE.format(seconds=seconds, seed=seed))
    click.echo(f"A simulated drive of {seconds:g} s in {drive}; the reference below is the truth.")
    from calib_toolkit.cli.run import run

    ctx.invoke(run, drive=drive, out=out)
