"""Sensors as they are named on the command line."""

import click


def sensor_names(sensors: str | None) -> list[str] | None:
    """The names in a list with commas; None for all, if there is no list."""
    if sensors is None:
        return None
    names = [n.strip() for n in sensors.split(",") if n.strip()]
    if not names:
        raise click.BadParameter("no sensor is named", param_hint="--sensors")
    return names
