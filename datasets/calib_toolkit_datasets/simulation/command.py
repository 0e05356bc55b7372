"""``calib-toolkit simulate``: a drive whose truth is exact, in files as a real one leaves them."""

from pathlib import Path
from typing import TYPE_CHECKING

import click

if TYPE_CHECKING:
    from calib_toolkit_datasets.simulation.writing import Wish, Written

RIGS = ("kitti", "shrimp", "fleet-car", "compact")
SCENES = ("street", "court", "highway", "open")
DRIVES = ("street", "rough", "court", "highway", "planar", "straight", "turn", "static")
LAYOUTS = ("extract", "sync")


@click.command()
@click.argument("dst", type=click.Path(path_type=Path, file_okay=False))
@click.option("--rig", type=click.Choice(RIGS), default="kitti", show_default=True, help="Which vehicle.")
@click.option("--seconds", type=float, default=100.0, show_default=True, help="Length of the drive.")
@click.option("--seed", type=click.IntRange(min=0), default=1, show_default=True, help="Each seed is another drive.")
@click.option("--scene", type=click.Choice(SCENES), help="What stands beside the road; the rig's own by default.")
@click.option("--drive", type=click.Choice(DRIVES), help="How the vehicle moves; the rig's own by default.")
@click.option(
    "--layout",
    type=click.Choice(LAYOUTS),
    help="Of the kitti rig: images as taken, each sensor with its own clock (extract, the default), or rectified "
    "and on one clock (sync).",
)
@click.option("--sensors", metavar="A,B,...", help="Those of the rig's sensors that are wanted; all by default.")
@click.option("--jobs", type=click.IntRange(min=1), help="Processes; one for each core by default.")
def simulate(
    dst: Path,
    rig: str,
    seconds: float,
    seed: int,
    scene: str | None,
    drive: str | None,
    layout: str | None,
    sensors: str | None,
    jobs: int | None,
) -> None:
    """Make a drive whose truth is known.

    The folder DST gets raw scans, images and fixes in files as a real drive leaves them, and truth.json with what is
    to be found. Where a call was interrupted the same command goes on.
    """
    import os

    from calib_toolkit import bars
    from calib_toolkit_datasets.simulation import rigs
    from calib_toolkit_datasets.simulation.writing import Wish, write

    usual = rigs.RIGS[rig](seed)
    wish = Wish(
        rig,
        seconds,
        seed,
        drive or usual.drive,
        scene or usual.scene,
        layout or ("extract" if rig == "kitti" else "folders"),
        tuple(name.strip() for name in sensors.split(",")) if sensors else (),
    )
    with bars() as progress:
        written = write(dst, wish, progress, jobs or os.cpu_count() or 1)
    _report(dst, wish, written)


def _report(dst: Path, wish: "Wish", written: "list[Written]") -> None:
    click.echo(
        f"{wish.seconds:g} s of {wish.drive} with the {wish.rig} rig, scene {wish.scene}, seed {wish.seed}, in {dst}:"
    )
    width = max(len(w.sensor) for w in written)
    for w in written:
        speed = f"{w.made / w.seconds:8.1f} a second on one core" if w.made and w.seconds else "  all there already"
        click.echo(f"  {w.sensor:<{width}} {w.readings:7d} readings {speed}")
    size = sum(f.stat().st_size for f in dst.rglob("*") if f.is_file())
    click.echo(f"  {size / 1e9:.2f} GB; the truth is in {dst / 'truth.json'}")
    click.echo(f"next: calib-toolkit run {dst} -o {dst.resolve().with_name(dst.resolve().name + '-out')}")
