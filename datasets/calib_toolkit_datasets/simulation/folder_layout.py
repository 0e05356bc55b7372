"""A simulated drive as plain folders of scans and images, with a ``rig.toml`` that says what they are."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from calib_toolkit import CameraIntrinsics, Fix, Scan
from calib_toolkit_datasets.simulation.camera import CameraModel
from calib_toolkit_datasets.simulation.lidar import LidarModel
from calib_toolkit_datasets.simulation.rigs import START_NS, Mounted, Nanoseconds, Rig
from calib_toolkit_datasets.simulation.vehicle import TruePath

FIXES = "fixes.csv"
STAMPS = "times.txt"
COLUMNS = (
    *("stamp", "lat_deg", "lon_deg", "alt", "roll_deg", "pitch_deg", "yaw_deg"),
    *("sigma_east", "sigma_north", "sigma_up", "sigma_roll_deg", "sigma_pitch_deg", "sigma_yaw_deg"),
)


@dataclass(frozen=True)
class FolderLayout:
    """A folder for each sensor."""

    def reading(self, sensor: Mounted, k: int) -> str:
        """Path of reading k; all fixes are in one file."""
        if isinstance(sensor.model, CameraModel):
            return f"{sensor.name}/images/{k:06d}.png"
        return (
            f"{sensor.name}/scans/{k:06d}.bin" if isinstance(sensor.model, LidarModel) else f"{sensor.name}/{FIXES}"
        )

    def scan(self, scan: Scan) -> bytes:
        """A ``.bin``: float32 x, y, z and intensity."""
        assert scan.intensity is not None
        return np.column_stack([scan.points, scan.intensity]).astype("<f4").tobytes()

    def fixes(self, sensor: Mounted, fixes: list[Fix], ns: Nanoseconds, path: TruePath) -> dict[str, str]:
        """One table with a line of titles."""
        place = np.degrees([[f.lat, f.lon] for f in fixes])
        attitude = np.degrees([[f.roll, f.pitch, f.yaw] for f in fixes])
        sigma = np.array([f.sigma_position for f in fixes], dtype=float)
        sigma_rpy = np.degrees(np.array([f.sigma_rpy for f in fixes], dtype=float))
        rows = np.column_stack([place, [f.alt for f in fixes], attitude, sigma, sigma_rpy])
        lines = [",".join([t, *(f"{x:.14g}" for x in row)]) for t, row in zip(_seconds(ns), rows, strict=True)]
        return {self.reading(sensor, 0): "\n".join([",".join(COLUMNS), *lines]) + "\n"}

    def texts(self, rig: Rig, stamps: Mapping[str, Nanoseconds]) -> dict[str, str]:
        """The stamps of scans and images, by path; those of fixes are in their table."""
        stamped = [s.name for s in rig.sensors if s.kind != "gps_ins"]
        return {f"{name}/{STAMPS}": "\n".join(_seconds(stamps[name])) + "\n" for name in stamped}

    def rig_toml(self, rig: Rig) -> str:
        """A table for each sensor, and one for all heads of a ladybug together."""
        tables: dict[str, dict[str, Any]] = {}
        for s in rig.sensors:
            if isinstance(s.model, LidarModel):
                values = {"scans": f"{s.name}/scans", "times": f"{s.name}/{STAMPS}", "turns": "clockwise"}
                tables[s.name] = {"kind": s.kind, **values}
            elif not isinstance(s.model, CameraModel):
                tables[s.name] = {"kind": s.kind, "fixes": f"{s.name}/{FIXES}"}
            elif s.kind == "ladybug":
                whole = tables.setdefault(s.trigger, {"kind": s.kind, "times": f"{s.name}/{STAMPS}", "heads": []})
                whole["heads"].append(_lens(s, s.model.intrinsics))
            else:
                tables[s.name] = {"kind": s.kind, "times": f"{s.name}/{STAMPS}", **_lens(s, s.model.intrinsics)}
        return "\n".join(
            f"[sensors.{name}]\n" + "".join(f"{k} = {_toml(v)}\n" for k, v in values.items())
            for name, values in tables.items()
        )


def _seconds(ns: Nanoseconds) -> list[str]:
    """Unix seconds to the nanosecond. ns: since the start of the drive."""
    return [f"{t // 10**9}.{t % 10**9:09d}" for t in (START_NS + ns).tolist()]


def _lens(sensor: Mounted, intrinsics: CameraIntrinsics) -> dict[str, Any]:
    K, distortion = intrinsics.K.ravel().tolist(), intrinsics.distortion.tolist()
    return {"images": f"{sensor.name}/images", "camera_matrix": K, "distortion": distortion}


def _toml(value: Any) -> str:
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{k} = {_toml(v)}" for k, v in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(_toml, value)) + "]"
    return f'"{value}"' if isinstance(value, str) else repr(value)
