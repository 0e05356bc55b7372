"""A panoramic camera of several heads that are triggered together: one clock, each head a sensor of its own."""

from calib_toolkit import Log, Sensor, SensorTable, hookimpl, tables
from calib_toolkit.errors import DataError
from calib_toolkit_plugins.image_tables import open_cameras
from calib_toolkit_plugins.monocular import MonocularOptions, estimate


@hookimpl
def calib_register_sensors() -> list[Sensor]:
    """The ``ladybug`` sensor: a head moves as a monocular camera does."""
    return [Sensor("ladybug", estimate, MonocularOptions, open_table, version="3")]


def open_table(table: SensorTable) -> Log:
    """The heads of one ladybug table of a rig.toml: streams NAME0, NAME1, ... with one clock, called NAME.

    Keys: ``times`` (see :func:`~calib_toolkit_plugins.image_tables.open_cameras`) and ``heads``, a list of tables
    with ``images``, ``camera_matrix``, and at will ``distortion``, ``mask`` and a ``name``. Raises DataError.
    """
    tables.refuse_unknown(table, ["times", "heads"])
    heads = table.values.get("heads")
    if not isinstance(heads, list) or not heads or not all(isinstance(head, dict) for head in heads):
        raise DataError(
            f"sensor {table.name} needs 'heads', a list with a table {{images = ..., camera_matrix = ...}} a head"
        )
    lenses = {}
    for k, head in enumerate(heads):
        name = head.get("name", f"{table.name}{k}")
        if not isinstance(name, str) or name in lenses:
            raise DataError(f"sensor {table.name}: a head is called {name!r}; give each a name of its own")
        lenses[name] = {key: value for key, value in head.items() if key != "name"}
    return open_cameras(table, "ladybug", lenses)
