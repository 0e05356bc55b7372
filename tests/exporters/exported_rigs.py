"""Rigs that every format can hold, and a way out and back in."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calib_toolkit import Calibration, se3
from calib_toolkit.exporting import export
from calib_toolkit.plugins import Registry

FORMATS = ("autoware", "colmap", "csv", "kalibr", "kitti", "nerf", "nuscenes", "ros2", "urdf", "yaml")
ENDING = {"csv": ".csv", "urdf": ".urdf", "colmap": ".json", "nerf": ".json", "nuscenes": ".json", "kitti": ""}
SENSORS = {
    **dict.fromkeys(FORMATS, ("velo", "ins", "cam0", "cam1")),
    "colmap": ("cam0", "cam1", "cam2"),
    "kalibr": ("ins", "cam0", "cam1", "cam2"),
    **dict.fromkeys(
        ("autoware", "csv", "kitti", "nerf", "nuscenes", "ros2", "urdf", "yaml"), ("velo", "ins", "cam0", "cam1")
    ),
}
"""A rig that each format can hold, the base first."""


def make_rig(names, vec, dt=None, skew=None, t_ref=0.0):
    """A calibration without errors. vec: (n - 1, 6) of the sensors after the first; dt: (n - 1,) or None."""
    n = len(names)
    known = np.ones((n, 7), dtype=bool)
    known[1:, 6] = dt is not None
    return Calibration(
        names[0],
        tuple(names),
        se3.matrix(np.concatenate([np.zeros((1, 6)), vec])),
        np.append(0.0, np.zeros(n - 1) if dt is None else dt),
        np.zeros((7 * n, 7 * n)),
        np.array([not name.startswith("cam") for name in names]),
        known,
        clock_skew=np.append(0.0, np.zeros(n - 1) if skew is None else skew),
        t_ref=t_ref,
    )


def ordinary(format_id):
    """Such a rig with unremarkable numbers."""
    names = SENSORS[format_id]
    rng = np.random.default_rng(7)
    return make_rig(names, rng.normal(size=(len(names) - 1, 6)), rng.normal(0, 0.05, len(names) - 1))


def same(a, b, within=1e-9):
    """Whether two calibrations place the same sensors alike, seen from the first one's base."""
    assert set(a.names) == set(b.names)
    for name in a.names:
        assert np.allclose(a.between(a.base, name).T_a_b, b.between(a.base, name).T_a_b, rtol=0, atol=within), name
    return True


@dataclass(frozen=True)
class Exporting:
    """Every installed exporter, and a folder."""

    folder: Path
    installed: Registry

    def write(self, c, format_id, name="rig", intrinsics=None):
        """The main file that was written."""
        path = self.folder / f"{name}{ENDING.get(format_id, '.yaml')}"
        files = export(c, path, self.exporter(format_id), intrinsics, overwrite=True)
        assert all(f.is_file() for f in files)
        return path

    def read(self, path, format_id):
        """What stands in a file."""
        return self.exporter(format_id).read(path)

    def exporter(self, format_id):
        """The installed one of that name."""
        return self.installed.exporters[format_id]
