"""NeRF and Gaussian splats: ``transforms.json`` as nerfstudio and instant-ngp take it."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from calib_toolkit import Calibration, CameraIntrinsics, Exporter, hookimpl
from calib_toolkit.errors import DataError
from calib_toolkit_plugins.exporters import clocks, files, poses

OPENCV = ("k1", "k2", "p1", "p2", "k3")
"""Coefficients of distortion in OpenCV's order; nerfstudio takes all, instant-ngp all but k3."""
CENTRE = 0.5
"""The format's centre of the first pixel, which is COLMAP's; OpenCV's is 0."""
T_OPTICAL_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
"""From x right, y up, z backward to x right, y down, z ahead; its own inverse."""
WORLD = "world"
"""Frame of all, where a file does not name the sensor whose frame it is."""


@hookimpl
def calib_register_exporters() -> list[Exporter]:
    """The ``nerf`` exporter."""
    return [Exporter("nerf", write, read, "JSON with frames and transform_matrix", matches, "sigmas")]


def matches(path: Path) -> bool:
    """Whether a file is JSON of frames with a pose each."""
    found = files.head(path)
    return '"frames"' in found and '"transform_matrix"' in found


def write(c: Calibration, path: Path, intrinsics: Mapping[str, CameraIntrinsics]) -> None:
    """A frame for each camera, the world being the base; others in a key of their own; clock offsets beside it.

    Raises DataError for a rig without cameras.
    """
    seen = poses.cameras(c, intrinsics)
    if not seen:
        raise DataError(f"a NeRF is made of images, and none of {', '.join(c.names)} is a camera; export to yaml")
    T_base = dict(zip(c.names, c.T_base_sensor, strict=True))
    other = next((n for n in seen if n != c.base), "")
    said = (
        f"{files.WRITTEN}: transform_matrix (metres) maps points of a camera with x right, y up, z backward to the "
        f"world, which is the frame of {c.base}; with y down and z ahead, {poses.direction(c, c.base, other)}. "
        f"other_sensors have their own axes. {clocks.sentence(path)}"
    )
    frames: list[dict[str, Any]] = [
        {
            "file_path": f"{n}.png",
            "sensor": n,
            "transform_matrix": (T_base[n] @ T_OPTICAL_OPENGL).tolist(),
            **_camera(n, intrinsics.get(n)),
        }
        for n in seen
    ]
    if any("k3" in frame for frame in frames):
        said += " instant-ngp does not read k3: give it undistorted images."
    content = {
        "comment": said,
        "base": c.base,
        "camera_model": "OPENCV",
        "frames": frames,
        "other_sensors": [{"sensor": n, "T_base_sensor": T_base[n].tolist()} for n in c.names if n not in seen],
    }
    path.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    clocks.write(c, path)


def read(path: Path) -> Calibration:
    """Every camera, and what is beside them, in the base that is named, or else in ``world``. Raises DataError."""
    content = files.load_json(path)
    frames = _rows(path, "frames", files.entry(path, "it", content, "frames"))
    others = _rows(path, "other_sensors", content.get("other_sensors", []))
    if files.number(path, "applied_scale", content.get("applied_scale", 1.0)) != 1.0:
        raise DataError(
            f"{path} has an applied_scale, so its lengths are not metres; divide them by it and remove it"
        )
    T_world: dict[str, poses.Array] = {}
    for row in frames:
        name = files.name(path, "the sensor of a frame", row["sensor"] if "sensor" in row else _stem(row))
        T = _matrix(path, f"transform_matrix of {name}", row.get("transform_matrix")) @ T_OPTICAL_OPENGL
        _add(path, T_world, name, T)
    cameras = list(T_world)
    for row in others:
        name = files.name(path, "one of other_sensors", row.get("sensor"))
        _add(path, T_world, name, _matrix(path, f"T_base_sensor of {name}", row.get("T_base_sensor")))
    if "base" not in content:
        return clocks.read(poses.from_tree(path, [(WORLD, n, T) for n, T in T_world.items()], cameras, WORLD), path)
    base = files.name(path, "base", content["base"])
    if base not in T_world or not np.allclose(T_world.pop(base), np.eye(4), rtol=0, atol=poses.EXACT):
        raise DataError(f"{path}: its base {base} is not there, or not at the origin; fetch the file again")
    return clocks.read(poses.calibration(path, base, T_world, cameras), path)


def _camera(name: str, camera: CameraIntrinsics | None) -> dict[str, Any]:
    if camera is None:
        return {}
    K, distortion = camera.K, camera.distortion
    if np.any(distortion[len(OPENCV) :]) or K[0, 1] != 0:
        raise DataError(f"{name} has a distortion beyond {' '.join(OPENCV)}, or a skew; leave --intrinsics out")
    given = dict.fromkeys(OPENCV[:4], 0.0) | dict(zip(OPENCV, np.trim_zeros(distortion, "b").tolist(), strict=False))
    return {
        "fl_x": float(K[0, 0]),
        "fl_y": float(K[1, 1]),
        "cx": float(K[0, 2]) + CENTRE,
        "cy": float(K[1, 2]) + CENTRE,
        **(dict(zip("wh", camera.size, strict=True)) if camera.size else {}),
        **given,
    }


def _rows(file: Path, key: str, rows: Any) -> list[dict[str, Any]]:
    if not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
        raise DataError(f"{file}: {key} is not a list of tables; correct it")
    return rows


def _stem(row: dict[str, Any]) -> Any:
    """The image's path without its ending, as others name no sensors."""
    image = row.get("file_path")
    return str(Path(image).with_suffix("")) if isinstance(image, str) and Path(image).name else image


def _add(file: Path, found: dict[str, poses.Array], name: str, T: poses.Array) -> None:
    if name in found:
        raise DataError(f"{file} has the sensor {name} twice; keep one")
    found[name] = T


def _matrix(file: Path, what: str, rows: Any) -> poses.Array:
    if not isinstance(rows, list) or len(rows) != 4:
        raise DataError(f"{file}: {what} is no list of four rows; correct it")
    return poses.from_matrix(file, what, np.array([files.numbers(file, what, row, 4) for row in rows]))
