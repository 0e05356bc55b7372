"""A panoramic camera of several heads that are triggered together: one clock, each head a sensor of its own."""

from calib_toolkit import Log, Sensor, SensorTable, hookimpl, tables
from calib_toolkit.errors import DataError
from calib_toolkit_plugins.image_tables import open_cameras
from calib_toolkit_plugins.monocular import MonocularOptions, estimate


@hookimpl
def calib_register_sensors() -> list[Sensor]:
    """The ``ladybug`` sensor: a head moves as a monocular camera does."""
    return [Sensor("ladybug", estimate, MonocularOptions, open_table)]


def open_table(table: SensorTable) -> Log:
    """The heads of one ladybug table of a rig.toml: streams NAME0, NAME1, ... with one clock, called NAME.

    Keys: ``times`` (see :func:`~calib_toolkit_plugins.image_tables.open_cameras`) and ``heads``, a list of tables
    with ``images``, ``camera_matrix``, and at will ``distortion`` and ``mask``. Raises DataError.
    """
    tables.refuse_unknown(table, ["times", "heads"])
    heads = table.values.get("heads")
    if not isinstance(heads, list) or not heads or not all(isinstance(head, dict) for head in heads):
        raise DataError(
            f"sensor {table.name} needs 'heads', a list with a table {{images = ..., camera_matrix = ...}} a head"
        )
    return open_cameras(table, "ladybug", {f"{table.name}{k}": head for k, head in enumerate(heads)})
