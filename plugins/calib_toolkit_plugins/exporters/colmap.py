"""COLMAP (3.12 and later): ``rig_config.json`` for ``colmap rig_configurator``."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from calib_toolkit import Calibration, CameraIntrinsics, Exporter, hookimpl, se3
from calib_toolkit.errors import DataError
from calib_toolkit_plugins.exporters import clocks, files, poses

MODELS = {0: "PINHOLE", 4: "OPENCV", 8: "FULL_OPENCV"}
"""COLMAP's cameras by the number of their distortion coefficients, which are OpenCV's in OpenCV's order."""
CENTRE = 0.5
"""COLMAP's centre of the first pixel; OpenCV's is 0."""


@hookimpl
def calib_register_exporters() -> list[Exporter]:
    """The ``colmap`` exporter."""
    return [Exporter("colmap", write, read, "JSON with image_prefix", matches, "sigmas, sensors that are no cameras")]


def matches(path: Path) -> bool:
    """Whether a file is JSON of rigs of cameras."""
    return '"image_prefix"' in files.head(path)


def write(c: Calibration, path: Path, intrinsics: Mapping[str, CameraIntrinsics]) -> None:
    """One rig of cameras, images of NAME being in the folder NAME; clock offsets beside it. Raises DataError."""
    seen = poses.cameras(c, intrinsics)
    if others := [n for n in c.names if n not in seen]:
        raise DataError(
            f"COLMAP holds cameras only, and {', '.join(others)} is none; leave it out with --sensors "
            f"{','.join(seen) or 'A,B'}"
        )
    prefixes = [f"{n}/" for n in c.names]
    if clash := [(a, b) for a in prefixes for b in prefixes if a != b and b.startswith(a)]:
        raise DataError(f"images in {clash[0][1]} would belong to {clash[0][0]}, too; rename one of the sensors")
    said = (
        f"{files.WRITTEN}: cam_from_rig (quaternion w x y z, metres) maps points of the reference camera to the "
        f"camera: {poses.direction(c, next(n for n in c.names if n != c.base), c.base)}. {clocks.sentence(path)}"
    )
    cameras = [
        {"image_prefix": f"{n}/", **_pose(n == c.base, T), **_camera(n, intrinsics.get(n))}
        for n, T in zip(c.names, c.T_base_sensor, strict=True)
    ]
    path.write_text(json.dumps([{"comment": said, "cameras": cameras}], indent=1) + "\n", encoding="utf-8")
    clocks.write(c, path)


def read(path: Path) -> Calibration:
    """The cameras of one rig, in its reference camera. Raises DataError."""
    rigs = files.load_json(path)
    if not isinstance(rigs, list) or len(rigs) != 1:
        raise DataError(f"{path} is no list of one rig; keep the one to read")
    rows = files.entry(path, "the rig", rigs[0], "cameras")
    if not isinstance(rows, list):
        raise DataError(f"{path}: cameras is not a list; correct it")
    T_base: dict[str, poses.Array] = {}
    bases = []
    for row in rows:
        prefix = files.entry(path, "a camera", row, "image_prefix")
        name = files.name(path, "an image_prefix", prefix.removesuffix("/") if isinstance(prefix, str) else prefix)
        if name in bases or name in T_base:
            raise DataError(f"{path} has the camera {name} twice; keep one")
        if row.get("ref_sensor") is True:
            if "cam_from_rig_rotation" in row or "cam_from_rig_translation" in row:
                raise DataError(f"{path}: {name} is the reference, so it can not have a cam_from_rig; remove one")
            bases.append(name)
        else:
            T_base[name] = se3.invert(_read_pose(path, name, row))
    if len(bases) != 1:
        raise DataError(f"{path} has {len(bases)} reference cameras, where one belongs; set ref_sensor of one")
    return clocks.read(poses.calibration(path, bases[0], T_base, {*bases, *T_base}), path)


def _pose(reference: bool, T_base_sensor: poses.Array) -> dict[str, Any]:
    if reference:
        return {"ref_sensor": True}
    T = se3.invert(T_base_sensor)
    x, y, z, w = poses.quaternion_xyzw(T)
    return {"cam_from_rig_rotation": [w, x, y, z], "cam_from_rig_translation": T[:3, 3].tolist()}


def _camera(name: str, camera: CameraIntrinsics | None) -> dict[str, Any]:
    """Intrinsics as COLMAP has them, as few coefficients as there are."""
    if camera is None:
        return {}
    K, distortion = camera.K, np.trim_zeros(camera.distortion, "b")
    size = next((n for n in MODELS if n >= len(distortion)), None)
    if size is None or K[0, 1] != 0:
        raise DataError(f"COLMAP has no camera with the intrinsics of {name}; leave --intrinsics out")
    centre = [float(K[0, 2]) + CENTRE, float(K[1, 2]) + CENTRE]
    padded = np.pad(distortion, (0, size - len(distortion))).tolist()
    return {"camera_model_name": MODELS[size], "camera_params": [float(K[0, 0]), float(K[1, 1]), *centre, *padded]}


def _read_pose(file: Path, name: str, row: dict[str, Any]) -> poses.Array:
    w, x, y, z = files.numbers(
        file, f"cam_from_rig_rotation of {name}", files.entry(file, name, row, "cam_from_rig_rotation"), 4
    )
    t = files.numbers(
        file, f"cam_from_rig_translation of {name}", files.entry(file, name, row, "cam_from_rig_translation"), 3
    )
    return poses.from_quaternion(file, name, [x, y, z, w], t)
