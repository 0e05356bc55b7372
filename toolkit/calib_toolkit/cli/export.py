"""``calib-toolkit export``: a calibration in the format of another program."""

from pathlib import Path

import click


@click.command()
@click.argument("calibration", metavar="CALIBRATION.json", type=click.Path(path_type=Path))
@click.option("--to", "format_id", metavar="FORMAT", required=True, help="Such as ros2, urdf or kalibr.")
@click.option("-o", "--out", type=click.Path(path_type=Path), required=True, help="File, or folder for kitti.")
@click.option("--sensors", metavar="A,B,...", help="Sensors to write, by their names; all by default.")
@click.option(
    "--intrinsics",
    "drive",
    metavar="DRIVE",
    type=click.Path(path_type=Path),
    help="Recording whose cameras' intrinsics go into the file, where the format has a place for them.",
)
@click.option("--overwrite", is_flag=True, help="Replace files that are there already.")
@click.option("--plugin", "plugins", multiple=True, type=click.Path(path_type=Path), help="One-file plugin.")
def export(
    calibration: Path,
    format_id: str,
    out: Path,
    sensors: str | None,
    drive: Path | None,
    overwrite: bool,
    plugins: tuple[Path, ...],
) -> None:
    """Write CALIBRATION.json in the format of another program.

    FORMAT is autoware, colmap, csv, kalibr, kitti, nerf, nuscenes, ros2, urdf, yaml, or what a plugin brings. The
    file says in a comment which way its transforms go, and where the clock offsets are: in the file, or in one that
    ends in clocks.yaml beside it.

    What the drive did not determine is null in csv and yaml; other formats refuse a sensor with an unknown pose,
    which --sensors can leave out. Without the base among them, all is given in the first of the sensors.
    """
    from calib_toolkit.errors import DataError
    from calib_toolkit.exporting import export as exported
    from calib_toolkit.exporting import selected
    from calib_toolkit.pipeline import open_log
    from calib_toolkit.plugins import registry
    from calib_toolkit.result_file import read_calibration

    installed = registry(plugins)
    exporter = installed.exporter(format_id)
    read = read_calibration(calibration)
    try:
        if sensors is not None:
            read = selected(read, [n.strip() for n in sensors.split(",") if n.strip()] or [""])
        streams = open_log(drive, None, installed).streams if drive else {}
        intrinsics = {n: s.intrinsics for n, s in streams.items() if s.intrinsics is not None and n in read.names}
        if drive and not intrinsics:
            raise DataError(f"{drive} has intrinsics of none of its sensors; leave --intrinsics out")
        files = exported(read, out, exporter, intrinsics, overwrite)
    except DataError as e:
        raise DataError(f"{calibration} can not be exported: {e}") from e
    click.echo(f"written: {', '.join(map(str, files))}")
    if exporter.loses:
        click.echo(f"not kept by {exporter.id}: {exporter.loses}")
