"""Kalibr: ``camchain-imucam.yaml``, or ``camchain.yaml`` without an IMU."""

import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from calib_toolkit import Calibration, CameraIntrinsics, Exporter, hookimpl, se3
from calib_toolkit.errors import DataError
from calib_toolkit_plugins.exporters import clocks, files, poses

RADTAN = 4
"""Numbers of its distortion: OpenCV's first four."""
AGREE = 1e-3
"""Metres, and elements of rotations, within which a camera's two poses in one file agree."""


@hookimpl
def calib_register_exporters() -> list[Exporter]:
    """The ``kalibr`` exporter."""
    looks_for = "YAML of cam0, cam1, ... with T_cam_imu or T_cn_cnm1"
    return [Exporter("kalibr", write, read, looks_for, matches, "sigmas, sensors beside cameras and one IMU")]


def matches(path: Path) -> bool:
    """Whether a file is YAML of a camera chain."""
    found = files.head(path)
    return bool(re.search(r"^cam\d+\s*:", found, re.MULTILINE) and re.search("T_cam_imu|T_imu_cam|T_cn_cnm1", found))


def write(c: Calibration, path: Path, intrinsics: Mapping[str, CameraIntrinsics]) -> None:
    """A chain of cameras, and of the one other sensor as its IMU. Raises DataError if there are more."""
    seen = poses.cameras(c, intrinsics)
    others = [n for n in c.names if n not in seen]
    if len(others) > 1 or not seen:
        raise DataError(
            f"Kalibr holds cameras and one IMU, and {', '.join(others)} are no cameras; choose one of them and the "
            f"cameras with --sensors {','.join([others[-1], *seen] if seen else ['A', 'B'])}"
        )
    imu = others[0] if others else None
    sentences, chain = [f"Camera chain{' and IMU' if imu else ''}"], {}
    for k, name in enumerate(seen):
        # the names ours had are kept in keys that Kalibr does not look at
        entry: dict[str, Any] = {"sensor": name, **({"imu": imu} if imu else {})}
        if imu:
            entry["T_cam_imu"] = c.between(name, imu).T_a_b.tolist()
            sentences.append(f"cam{k}: T_cam_imu: {poses.direction(c, name, imu)}.")
            if c.determined[[c.index(name), c.index(imu)], 6].all():
                entry["timeshift_cam_imu"] = c.dt_between(imu, name)[0]
                sentences.append(f"cam{k}: timeshift_cam_imu (s) is added to {name}'s stamp to get {imu}'s time.")
            else:
                sentences.append(f"cam{k}: timeshift_cam_imu was not determined, so it is missing. It is not zero.")
        if k:
            entry["T_cn_cnm1"] = c.between(name, seen[k - 1]).T_a_b.tolist()
            sentences.append(f"cam{k}: T_cn_cnm1: {poses.direction(c, name, seen[k - 1])}.")
        chain[f"cam{k}"] = {**entry, **_camera(name, intrinsics.get(name))}
    sentences.append(f"Clock offsets: also in {clocks.beside(path).name}, with what this format has no place for.")
    clocks.write(c, path)
    files.write_yaml(path, [*sentences, "Metres; frames of cameras are optical (x right, y down, z ahead)."], chain)


def read(path: Path) -> Calibration:
    """The chain, seen from the IMU or else from cam0. Raises DataError, also where two of its poses contradict."""
    content = files.load_yaml(path)
    if not isinstance(content, dict) or list(content) != [f"cam{k}" for k in range(len(content))]:
        raise DataError(f"{path} is no chain cam0, cam1, ... without a gap; name a camchain")
    tables = [files.entry(path, "it", content, key) for key in content]
    names = [
        files.name(path, f"sensor of cam{k}", t.get("sensor", f"cam{k}") if isinstance(t, dict) else None)
        for k, t in enumerate(tables)
    ]
    imus = [files.name(path, f"imu of {n}", t.get("imu", "imu0")) for n, t in zip(names, tables, strict=True)]
    if len(set(names)) < len(names) or len(set(imus)) > 1 or imus[0] in names:
        raise DataError(f"{path} has a sensor twice, or two IMUs; correct its keys 'sensor' and 'imu'")
    T_imu_cam = [_imu_pose(path, n, t) for n, t in zip(names, tables, strict=True)]
    if all(T is None for T in T_imu_cam):
        T_base = [np.eye(4)]
        for n, t in zip(names[1:], tables[1:], strict=True):
            T_base.append(T_base[-1] @ se3.invert(_matrix(path, f"T_cn_cnm1 of {n}", t.get("T_cn_cnm1"))))
        others = dict(zip(names[1:], T_base[1:], strict=True))
        return clocks.read(poses.calibration(path, names[0], others, names), path)
    found = {n: T for n, T in zip(names, T_imu_cam, strict=True) if T is not None}
    for before, n, t in zip(names, names[1:], tables[1:], strict=False):
        if "T_cn_cnm1" in t and before in found:
            T = found[before] @ se3.invert(_matrix(path, f"T_cn_cnm1 of {n}", t["T_cn_cnm1"]))
            if not np.allclose(T, found.setdefault(n, T), atol=AGREE):
                raise DataError(f"{path}: T_cam_imu and T_cn_cnm1 of {n} contradict each other; correct one of them")
    if missing := [n for n in names if n not in found]:
        raise DataError(f"{path}: {missing[0]} has neither T_cam_imu nor T_cn_cnm1; add one")
    return _with_clocks(poses.calibration(path, imus[0], found, names), path, tables)


def _imu_pose(file: Path, name: str, table: Any) -> poses.Array | None:
    """``T_imu_cam``, which OpenVINS writes and Kalibr the inverse of."""
    if "T_imu_cam" in table:
        return _matrix(file, f"T_imu_cam of {name}", table["T_imu_cam"])
    given = table.get("T_cam_imu")
    return None if given is None else se3.invert(_matrix(file, f"T_cam_imu of {name}", given))


def _matrix(file: Path, what: str, rows: Any) -> poses.Array:
    if not isinstance(rows, list) or len(rows) != 4:
        raise DataError(f"{file}: {what} is no list of four rows; correct it")
    return poses.from_matrix(file, what, np.array([files.numbers(file, what, row, 4) for row in rows]))


def _with_clocks(c: Calibration, path: Path, tables: list[Any]) -> Calibration:
    """The offsets of the file, or those beside it, where clocks drift; the two must agree."""
    determined, dt = c.determined.copy(), c.dt_base_sensor.copy()
    for i, table in enumerate(tables, 1):
        if table.get("timeshift_cam_imu") is not None:
            dt[i] = files.number(path, f"timeshift_cam_imu of {c.names[i]}", table["timeshift_cam_imu"])
            determined[i, 6] = True
    found = replace(c, dt_base_sensor=dt, determined=determined)
    both = clocks.read(found, path)
    if not np.allclose(np.where(determined[:, 6], both.dt_base_sensor - dt, 0.0), 0.0, atol=1e-9):
        raise DataError(
            f"{path} and {clocks.beside(path).name} beside it tell different clock offsets; export both again, or "
            "remove the second"
        )
    return both


def _camera(name: str, camera: CameraIntrinsics | None) -> dict[str, Any]:
    if camera is None:
        return {}
    K, distortion = camera.K, camera.distortion
    if np.any(distortion[RADTAN:]) or K[0, 1] != 0:
        raise DataError(
            f"{name} has more than Kalibr's four coefficients of distortion, or a skew; leave --intrinsics out"
        )
    radtan = np.pad(distortion[:RADTAN], (0, max(RADTAN - len(distortion), 0))).tolist()
    return {
        "camera_model": "pinhole",
        "distortion_model": "radtan",
        "distortion_coeffs": radtan,
        "intrinsics": [float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])],
        **({"resolution": list(camera.size)} if camera.size else {}),
    }
