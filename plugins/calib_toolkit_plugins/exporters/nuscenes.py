"""nuScenes: ``calibrated_sensor.json`` and the ``sensor.json`` that names its sensors."""

import json
from collections.abc import Mapping
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np

from calib_toolkit import Calibration, CameraIntrinsics, Exporter, hookimpl
from calib_toolkit.errors import DataError
from calib_toolkit_plugins.exporters import clocks, files, poses

FRAME = "ego"
SENSORS = "sensor.json"


@hookimpl
def calib_register_exporters() -> list[Exporter]:
    """The ``nuscenes`` exporter."""
    looks_for = "a calibrated_sensor.json beside a sensor.json"
    loses = "sigmas, distortion (nuScenes has undistorted images)"
    return [Exporter("nuscenes", write, read, looks_for, matches, loses)]


def matches(path: Path) -> bool:
    """Whether a file is a table of calibrated sensors."""
    return '"sensor_token"' in files.head(path) and '"rotation"' in files.head(path)


def write(c: Calibration, path: Path, intrinsics: Mapping[str, CameraIntrinsics]) -> None:
    """Both tables, the ego frame being that of the base; clock offsets beside them."""
    if path.name == SENSORS:
        raise DataError(f"{SENSORS} will be written, too; choose another name, such as calibrated_sensor.json")
    if FRAME in c.names and c.base != FRAME:
        raise DataError(f"a sensor is called {FRAME}, which in nuScenes is the frame of all; make it the base")
    seen = poses.cameras(c, intrinsics)
    said = (
        f"{files.WRITTEN}: translation (metres) and rotation (quaternion w x y z) map points of the sensor to the "
        f"ego frame, which is that of {c.base}: {poses.direction(c)}. {clocks.sentence(path)}"
    )
    rows, sensors = [], []
    for name, T in zip(c.names, c.T_base_sensor, strict=True):
        if name == FRAME:
            continue
        x, y, z, w = poses.quaternion_xyzw(T)
        row = {
            "token": _token("calibrated", name),
            "sensor_token": _token("sensor", name),
            "translation": T[:3, 3].tolist(),
            "rotation": [w, x, y, z],
            "camera_intrinsic": _matrix(name, intrinsics.get(name)),
            "comment": said,
        }
        rows.append(row)
        modality = "camera" if name in seen else "lidar"
        sensors.append({"token": row["sensor_token"], "channel": name, "modality": modality, "comment": said})
    path.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")
    path.with_name(SENSORS).write_text(json.dumps(sensors, indent=1) + "\n", encoding="utf-8")
    clocks.write(c, path)


def read(path: Path) -> Calibration:
    """Every sensor in the ego frame; one that coincides with it is the base. Raises DataError."""
    names_file = path.with_name(SENSORS)
    if not names_file.is_file():
        raise DataError(f"{path} has tokens for sensors, and {names_file}, which names them, is missing; add it")
    rows, sensors = _rows(path), _rows(names_file)
    names = {_text(names_file, s, "token"): files.name(names_file, "a channel", s.get("channel")) for s in sensors}
    if len(set(names.values())) < len(sensors):
        raise DataError(f"{names_file} has a sensor twice; keep one")
    found: dict[str, poses.Array] = {}
    for row in rows:
        token = _text(path, row, "sensor_token")
        if token not in names:
            raise DataError(f"{path} tells of the sensor {token}, which {names_file} does not name; add it there")
        name, T = names[token], _pose(path, names[token], row)
        if name in found and not np.allclose(found[name], T, atol=1e-9):
            raise DataError(
                f"{path} has several poses of {name}, for nuScenes has one for each log; keep the rows of one log"
            )
        found.setdefault(name, T)
    seen = [_text(names_file, s, "channel") for s in sensors if s.get("modality") == "camera"]
    edges = [(FRAME, name, T) for name, T in found.items()]
    return clocks.read(poses.from_tree(path, edges, seen, FRAME), path)


def _token(table: str, name: str) -> str:
    """32 hexadecimal digits, the same for the same sensor."""
    return sha256(f"{table} {name}".encode()).hexdigest()[:32]


def _matrix(name: str, camera: CameraIntrinsics | None) -> list[list[float]]:
    if camera is not None and np.any(camera.distortion):
        raise DataError(
            f"nuScenes has undistorted images, and {name} has a distortion; undistort them or leave --intrinsics out"
        )
    return [] if camera is None else camera.K.tolist()


def _rows(file: Path) -> list[dict[str, Any]]:
    rows = files.load_json(file)
    if not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
        raise DataError(f"{file} is no list of rows, as the tables of nuScenes are; fetch it again")
    return rows


def _text(file: Path, row: dict[str, Any], key: str) -> str:
    return files.name(file, key, row.get(key))


def _pose(file: Path, name: str, row: dict[str, Any]) -> poses.Array:
    t = files.numbers(file, f"translation of {name}", row.get("translation"), 3)
    w, x, y, z = files.numbers(file, f"rotation of {name}", row.get("rotation"), 4)
    return poses.from_quaternion(file, name, [x, y, z, w], t)
