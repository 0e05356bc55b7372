"""``calibration.json``: the result for programs, out and back in."""

import json
import platform
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np

from calib_toolkit.errors import DataError
from calib_toolkit.types import Calibration, Result, Undetermined
from calib_toolkit.types.calibration import PARAMETERS

PACKAGES = ("calib-toolkit", "numpy", "scipy", "opencv-contrib-python-headless", "open3d-cpu", "open3d", "small-gicp")
CONVENTION = (
    "T_base_sensor maps points in the sensor to the base; metres, radians, seconds; dt_base_sensor is added to the "
    "sensor's stamps; rotation errors are delta in R_true = Exp(delta) R_est, base axes; null is not determined"
)


def write_result(result: Result, file: Path) -> None:
    """Write a result as JSON, whole or not at all."""
    _write(result_dict(result), file)


def write_calibration(calibration: Calibration, file: Path, sigmas: bool = True) -> None:
    """Write one calibration alone (a truth, a measured rig) as JSON, whole or not at all.

    sigmas: False where nobody states how sure the numbers are; the file then has neither sigma nor covariance.
    """
    content = {"convention": CONVENTION, **calibration_dict(calibration)}
    if not sigmas:
        del content["covariance"]
        for sensor in content["sensors"].values():
            del sensor["sigma"]
    _write(content, file)


def result_dict(result: Result) -> dict[str, Any]:
    """The result in plain numbers, lists and dictionaries."""
    return {
        "convention": CONVENTION,
        **calibration_dict(result.calibration),
        "stages": {name: calibration_dict(c) for name, c in result.stages.items()},
        "statistics": dict(result.statistics),
        "warnings": list(result.warnings),
        "configuration": dict(result.configuration),
        "versions": _versions(),
    }


def calibration_dict(c: Calibration) -> dict[str, Any]:
    """One calibration in plain numbers; what is not determined is None."""
    known = c.determined.ravel()
    cov = np.where(np.outer(known, known), c.covariance, np.nan)
    pose_known = np.ones((len(c.names), 4, 4), dtype=bool)
    pose_known[:, :3, 3] = c.determined[:, :3]
    poses = np.where(pose_known, c.T_base_sensor, np.nan)
    return {
        "base": c.base,
        "sensors": {
            name: {
                "T_base_sensor": _plain(poses[i]),
                "dt_base_sensor": _plain(np.where(c.determined[i, 6], c.dt_base_sensor[i], np.nan)),
                "clock_skew": float(c.clock_skew[i]),
                "t_ref": float(c.t_ref),
                "sigma": dict(zip(PARAMETERS, _plain(c.sigma[i]), strict=True)),
                "has_scale": bool(c.has_scale[i]),
            }
            for i, name in enumerate(c.names)
        },
        "covariance": {"order": [f"{n}.{p}" for n in c.names for p in PARAMETERS], "matrix": _plain(cov)},
        "undetermined": [{"direction": dict(u.direction), "sentence": u.sentence} for u in c.undetermined],
    }


def read_calibration(file: Path) -> Calibration:
    """The best calibration of a file in the schema of :func:`write_result`. Raises DataError.

    ``base`` and each sensor's ``T_base_sensor`` with a rotation must be there. Without sigma and covariance the
    values are taken as exact, except those that are null or missing, which are then not determined.
    """
    try:
        return _calibration(json.loads(file.read_text()))
    except (OSError, KeyError, TypeError, ValueError, AttributeError, RecursionError) as e:
        raise DataError(f"{file} is not a calibration this program can read ({type(e).__name__}: {e})") from e


def _calibration(d: dict[str, Any]) -> Calibration:
    names, sensors = tuple(d["sensors"]), list(d["sensors"].values())
    n, order = len(names), [f"{name}.{p}" for name in d["sensors"] for p in PARAMETERS]
    poses = np.array([s["T_base_sensor"] for s in sensors], dtype=float)
    dt = np.array([s.get("dt_base_sensor") for s in sensors], dtype=float)
    sigma = np.array(
        [[s["sigma"][p] for p in PARAMETERS] if "sigma" in s else [0.0] * 7 for s in sensors], dtype=float
    )
    covariance = d.get("covariance") or {"order": order, "matrix": np.diag(sigma.ravel() ** 2)}
    cov = np.array(covariance["matrix"], dtype=float)
    if d["base"] not in names or covariance["order"] != order:
        raise ValueError("its base or the order of its covariance does not fit its sensors")
    if poses.shape != (n, 4, 4) or cov.shape != (7 * n, 7 * n):
        raise ValueError(f"poses of shape {poses.shape} and a covariance of shape {cov.shape} for {n} sensors")
    R = poses[:, :3, :3]
    if not np.allclose(R @ np.swapaxes(R, 1, 2), np.eye(3), atol=1e-3) or not np.all(np.linalg.det(R) > 0):
        raise ValueError("the rotation of a T_base_sensor is not one")
    if not np.allclose(poses[:, 3], [0, 0, 0, 1]):
        raise ValueError("the last row of a T_base_sensor is not 0 0 0 1; is the matrix transposed?")
    skew = np.array([s.get("clock_skew", 0.0) for s in sensors], dtype=float)
    t_ref = {float(s.get("t_ref", 0.0)) for s in sensors}
    if not np.all(np.isfinite(skew)) or len(t_ref) > 1 or not np.all(np.isfinite(list(t_ref))):
        raise ValueError("clock_skew and t_ref must be numbers, and t_ref the same for all sensors")
    known = np.column_stack([np.isfinite(poses[:, :3, 3]), np.ones((n, 3), dtype=bool), np.isfinite(dt)])
    known &= np.isfinite(sigma)
    return Calibration(
        d["base"],
        names,
        poses,
        np.nan_to_num(dt),
        np.nan_to_num(cov),
        np.array([s.get("has_scale", True) for s in sensors], dtype=bool),
        known,
        tuple(Undetermined(dict(u["direction"]), str(u["sentence"])) for u in d.get("undetermined", [])),
        skew,
        t_ref.pop(),
    )


def _write(content: dict[str, Any], file: Path) -> None:
    part = file.with_suffix(".part")
    part.write_text(json.dumps(content, indent=1, allow_nan=False) + "\n")
    part.replace(file)


def _plain(a: Any) -> Any:
    """Nested lists, with None for nan (which JSON does not have)."""
    a = np.asarray(a, dtype=float)
    if a.ndim:
        return [_plain(x) for x in a]
    return float(a) if np.isfinite(a) else None


def _versions() -> dict[str, str]:
    found = {"python": platform.python_version()}
    for package in PACKAGES:
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            continue
    return found
