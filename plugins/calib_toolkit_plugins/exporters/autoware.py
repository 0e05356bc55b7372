"""Autoware: ``sensor_kit_calibration.yaml``, whose cameras are given by their bodies and not by their optics."""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from calib_toolkit import Calibration, CameraIntrinsics, Exporter, hookimpl, se3
from calib_toolkit.errors import DataError
from calib_toolkit_plugins.exporters import clocks, files, poses

FRAME = "sensor_kit_base_link"
BODY = "/camera_link"
"""How the key of a camera ends. Its axes are x ahead, y left, z up; Autoware adds the optical frame itself."""
T_LINK_OPTICAL = se3.rigid([[0, 0, 1], [-1, 0, 0], [0, -1, 0]], [0, 0, 0])
NUMBERS = ("x", "y", "z", "roll", "pitch", "yaw")


@hookimpl
def calib_register_exporters() -> list[Exporter]:
    """The ``autoware`` exporter."""
    looks_for = "YAML of frames with x, y, z, roll, pitch and yaw"
    return [Exporter("autoware", write, read, looks_for, matches, "sigmas")]


def matches(path: Path) -> bool:
    """Whether a file is YAML of frames with roll, pitch and yaw."""
    found = files.head(path)
    return all(re.search(rf"[\s,{{]{key}\s*:\s", found) for key in ("roll", "pitch", "yaw"))


def write(c: Calibration, path: Path, intrinsics: Mapping[str, CameraIntrinsics]) -> None:
    """Every sensor in ``sensor_kit_base_link``, where the base is; clock offsets beside it."""
    seen = poses.cameras(c, intrinsics)
    if bad := next((n for n in c.names if n.endswith(BODY) and n not in seen), None):
        raise DataError(f"{bad} is no camera but is called like the body of one in Autoware; rename it")
    if FRAME in c.names and c.base != FRAME:
        raise DataError(f"a sensor is called {FRAME}, which in Autoware is the frame of all; make it the base")
    body = next((n for n in seen if n != c.base), "")
    sentences = [
        "Sensor kit",
        f"x, y, z (metres), roll, pitch, yaw (radians, Rz(yaw) Ry(pitch) Rx(roll)) map points of a frame to {FRAME},",
        f"which is the frame of {c.base}: {poses.direction(c)}.",
        f"NAME{BODY} is the body of camera NAME: x ahead, y left, z up"
        + (f"; points of {body}'s optical frame (z ahead) are turned into it first." if body else "."),
        clocks.sentence(path),
    ]
    table = {}
    for name, T in zip(c.names, c.T_base_sensor, strict=True):
        if name == FRAME:
            continue
        key, T = (f"{name}{BODY}", T @ se3.invert(T_LINK_OPTICAL)) if name in seen else (name, T)
        table[key] = dict(zip(NUMBERS, [*T[:3, 3].tolist(), *poses.to_rpy(T)], strict=True))
    files.write_yaml(path, sentences, {FRAME: table})
    clocks.write(c, path)


def read(path: Path) -> Calibration:
    """Every frame of the file; cameras by their optics. A sensor that coincides with the kit is the base."""
    content = files.load_yaml(path)
    if not isinstance(content, dict) or not all(isinstance(t, dict) for t in content.values()):
        raise DataError(f"{path} is no table of frames in frames; name a sensor_kit_calibration.yaml")
    edges = [_edge(path, parent, key, table) for parent, tables in content.items() for key, table in tables.items()]
    seen = [key.removesuffix(BODY) for tables in content.values() for key in tables if key.endswith(BODY)]
    return clocks.read(poses.from_tree(path, edges, seen, FRAME), path)


def _edge(file: Path, parent: Any, key: Any, table: Any) -> poses.Edge:
    parent, key = files.name(file, "a frame", parent), files.name(file, "a frame", key)
    read = [files.number(file, f"{n} of {key}", files.entry(file, key, table, n)) for n in NUMBERS]
    T = poses.from_rpy(read[:3], read[3:])
    if not key.endswith(BODY):
        return parent, key, T
    return parent, files.name(file, "a camera", key.removesuffix(BODY)), T @ T_LINK_OPTICAL
