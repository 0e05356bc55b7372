"""Motions that the paper's author stored: MATLAB files ``*VelData.mat``, ``*NavData.mat``, ``*Cam1Data.mat``, ...

Row k of ``T_Skm1_Sk`` is the inverse of the pose of frame k in frame k-1, whatever the help text in the files
says; it is inverted here, with its variances. Row 0 is a placeholder.
"""

import os
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib_toolkit import CameraIntrinsics, Dataset, Log, MotionReading, ReadContext, Stream, hookimpl, se3, tables
from calib_toolkit.errors import DataError
from calib_toolkit_datasets import mat_files

Array = NDArray[np.float64]

FAILED_VARIANCE = 1000.0
FARTHEST = 1e6
"""Metres from one frame to the next: beyond are damaged numbers, and nan is not below it either."""
_NAME = re.compile(r".*?(Vel|Nav|Cam(?P<number>\d+))Data\.mat", re.DOTALL)


@hookimpl
def calib_register_datasets() -> list[Dataset]:
    """The ``multi-array-calib`` reader."""
    looks_for = "a folder with *VelData.mat, *NavData.mat or *Cam1Data.mat"
    return [Dataset("multi-array-calib", looks_for, matches, open_log)]


def matches(path: Path) -> bool:
    """Whether a folder holds at least one file named as these are."""
    try:
        return any(_NAME.fullmatch(name) for name in os.listdir(path))
    except OSError:
        return False


def open_log(path: Path, context: ReadContext) -> Log:
    """Sensors ``velo``, ``ins`` and, in the order of their numbers, ``cam0``, ``cam1``, ...

    Cameras with identical stamps, the heads of a ladybug, were stamped by one trigger and share its clock.
    Raises DataError.
    """
    files = _files(path)
    contents = {name: _table(name, file) for name, file in files.items()}
    epoch_ns = min(int(ns[0]) for ns, _, _, _ in contents.values())
    streams: dict[str, Stream] = {}
    for name, (ns, readings, intrinsics, notes) in contents.items():
        times, scaled = tables.seconds(ns, epoch_ns), not name.startswith("cam")
        stream = Stream(name, "odometry", times, readings, intrinsics, has_scale=scaled, notes=notes)
        cameras = [] if scaled else [s for s in streams.values() if not s.has_scale]
        clocks = [s.clock for s in cameras if np.array_equal(s.stamps, times)]
        streams[name] = replace(stream, clock=clocks[0]) if clocks else stream
    return Log(path, streams, epoch_ns)


def inverted(vec: Array, variance: Array) -> tuple[Array, Array]:
    """Inverse motions and their covariance. (n, 6) and variances (n, 6) -> (n, 6) and (n, 6, 6).

    Noise is additive per component of the six-vectors, independent before inversion. With
    ``t' = -R^T t``, ``r' = -r``: ``dt' = -R^T dt + [t']x J(r') dr`` and ``dr' = -dr``, J the left Jacobian.
    """
    inverse = se3.vector(se3.invert(se3.matrix(vec)))
    J = np.zeros((len(vec), 6, 6))
    J[:, :3, :3] = -se3.exp_so3(inverse[:, 3:])
    J[:, :3, 3:] = se3.skew(inverse[:, :3]) @ se3.left_jacobian(inverse[:, 3:])
    J[:, 3:, 3:] = -np.eye(3)
    return inverse, (J * variance[:, None, :]) @ np.swapaxes(J, 1, 2)


def _files(path: Path) -> dict[str, Path]:
    found = [(m, p) for p in sorted(path.glob("*")) if (m := _NAME.fullmatch(p.name))]
    cameras = sorted((int(m["number"]), p) for m, p in found if m["number"])
    named = [("velo" if m[1] == "Vel" else "ins", p) for m, p in found if not m["number"]]
    named += [(f"cam{i}", p) for i, (_, p) in enumerate(cameras)]
    doubled = [name for i, (name, _) in enumerate(named) if name in [n for n, _ in named[:i]]]
    if doubled or len({number for number, _ in cameras}) < len(cameras):
        raise DataError(f"{path} holds two files of one sensor ({doubled[0] if doubled else 'a camera'}); keep one")
    if not named:
        raise DataError(f"{path} holds no *VelData.mat, *NavData.mat or *Cam1Data.mat; name a folder that does")
    order = {"velo": -2, "ins": -1}
    return dict(sorted(named, key=lambda item: order.get(item[0], 0)))


def _table(
    name: str, file: Path
) -> tuple[tables.Nanoseconds, list[MotionReading], CameraIntrinsics | None, tuple[str, ...]]:
    """Stamps, readings, intrinsics and notes of one file, readings with unusable stamps dropped."""
    data = _loaded(name, file)
    vec, variance = (_rows(data, field, name, file) for field in ("T_Skm1_Sk", "T_Var_Skm1_Sk"))
    # unsigned microseconds: cast first, or differences wrap around
    ns = np.atleast_1d(data.time).astype(np.int64) * 1000
    if not len(ns) or len(ns) != len(vec) or len(ns) != len(variance):
        raise DataError(
            f"{file}: sensor {name} has {len(ns)} stamps, {len(vec)} motions and {len(variance)} variances; "
            "all must be as many"
        )
    usable = np.all((np.abs(vec) < FARTHEST) & (variance > 0) & (variance < FAILED_VARIANCE), axis=1)
    keep = tables.increasing(ns)
    usable[1:] &= keep[:-1]  # what follows a dropped reading is not the motion since the reading kept before it
    usable[0] = False
    silent = ~usable & keep
    silent[0] = False  # a placeholder, not a failure
    notes = _note(name, file, "dropped because stamps repeat or go back", ~keep)
    notes += _note(name, file, "without a motion (failed, not a number or without variance)", silent)
    vec, variance = (np.where(usable[:, None], x, 0.0) for x in (vec, variance))
    inverse, cov = inverted(vec, variance)
    readings = [MotionReading(inverse[k], cov[k]) if usable[k] else MotionReading(None) for k in np.flatnonzero(keep)]
    return ns[keep], readings, _intrinsics(name, data, file), notes


def _loaded(name: str, file: Path) -> Any:
    from scipy.io import loadmat

    try:
        mat_files.refuse_damage(file.read_bytes())
        variables = loadmat(file, squeeze_me=True, struct_as_record=False)
        (data,) = [v for v in variables.values() if hasattr(v, "T_Skm1_Sk")]
        _ = data.T_Var_Skm1_Sk, data.time
    except Exception as e:  # a damaged file makes SciPy raise anything, zlib's and struct's errors included
        raise DataError(
            f"{file}: sensor {name} can not be read ({type(e).__name__}): the file must hold one MATLAB struct "
            "with time, T_Skm1_Sk and T_Var_Skm1_Sk; fetch it again"
        ) from e
    return data


def _rows(data: Any, field: str, name: str, file: Path) -> Array:
    rows = np.atleast_2d(np.asarray(getattr(data, field), dtype=float))
    if rows.ndim != 2 or rows.shape[1] != 6:
        raise DataError(f"{file}: sensor {name}: {field} has shape {rows.shape}, expected (n, 6)")
    return rows


def _intrinsics(name: str, data: Any, file: Path) -> CameraIntrinsics | None:
    if not name.startswith("cam") or not hasattr(data, "K"):
        return None
    K = np.atleast_2d(np.asarray(data.K, dtype=float))
    if K.shape not in ((3, 3), (3, 4)):
        raise DataError(f"{file}: sensor {name}: K has shape {K.shape}, expected (3, 3) or (3, 4)")
    distortion = np.atleast_1d(np.asarray(getattr(data, "D", []), dtype=float))
    mask = np.asarray(data.mask, dtype=np.uint8) if hasattr(data, "mask") else None
    size = (mask.shape[1], mask.shape[0]) if mask is not None and mask.ndim == 2 else None
    return CameraIntrinsics(K[:, :3], distortion, size, mask if size else None)


def _note(name: str, file: Path, what: str, rows: NDArray[np.bool_]) -> tuple[str, ...]:
    if not np.any(rows):
        return ()
    return (f"{name}: {rows.sum()} reading(s) of {file.name} {what}, the first is row {rows.argmax()}",)
