"""Argoverse 2, the sensor dataset: the cameras and the vehicle's poses of one log.

Wilson et al., "Argoverse 2", NeurIPS 2021. Its lidar is refused: a sweep holds the points of two scanners,
straightened and moved to the vehicle's frame with the calibration that is to be found. Undoing that takes the same
calibration, and would only return it.
"""

import re
from collections.abc import Mapping, Sequence
from functools import partial
from os.path import isdir, isfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from calib_toolkit import CameraIntrinsics, Dataset, LazyReadings, Log, ReadContext, Stream, hookimpl, se3, tables
from calib_toolkit.errors import DataError
from calib_toolkit.types import Calibration, PoseReading, Topic
from calib_toolkit_datasets import image_files, stamps

Array = NDArray[np.float64]

EGO, LIDAR = "ego", "lidar"
POSES = "city_SE3_egovehicle.feather"
MOUNTS, LENSES = "calibration/egovehicle_SE3_sensor.feather", "calibration/intrinsics.feather"
CAMERAS, SWEEPS = "sensors/cameras", "sensors/lidar"
POSE = ("qw", "qx", "qy", "qz", "tx_m", "ty_m", "tz_m")
LENS = ("fx_px", "fy_px", "cx_px", "cy_px", "width_px", "height_px")
SPACING_NS = 45_000_000
"""Least time between two poses: there is one for the reading of every sensor, some hardly apart."""
FARTHEST = 1e7
"""Metres along an axis; what is farther is damaged."""
UNIT = 1e-3
"""By how much the length of a quaternion may differ from one."""
MERGED = (
    "its sweeps are those of two scanners together, straightened and moved to the vehicle's frame with the "
    "calibration that is to be found, so they tell nothing of it"
)


@hookimpl
def calib_register_datasets() -> list[Dataset]:
    """The ``argoverse2`` reader."""
    return [Dataset("argoverse2", f"the folder of a log with {POSES}, or with {MOUNTS}", matches, open_log)]


def matches(path: Path) -> bool:
    """Whether a folder has the poses or the calibration of a log."""
    return isfile(path / POSES) or isfile(path / MOUNTS)


def open_log(path: Path, context: ReadContext) -> Log:
    """The cameras that have images, under the names of their folders, and ``ego``. Raises DataError."""
    path = path.absolute()
    lenses = _lenses(path / LENSES) if isfile(path / LENSES) else {}
    made: dict[str, tuple[tables.Nanoseconds, Sequence[Any], tuple[str, ...]]] = {}
    for folder in _folders(path / CAMERAS):
        ns, files, said = _images(folder)
        if len(ns):
            lens = lenses.get(folder.name)
            said += () if lens else (f"{folder.name} has no intrinsics: {path / LENSES} does not have it",)
            load = partial(image_files.load, sensor=folder.name, size=lens.size if lens else None)
            made[folder.name] = ns, LazyReadings(load, files), said
    notes: tuple[str, ...] = ()
    listed: list[Topic] = []
    if isfile(path / POSES):
        made[EGO] = _poses(path / POSES)
    else:
        notes += (f"{EGO} is left out: {path / POSES} is missing",)
    if isdir(path / SWEEPS):
        listed.append(Topic(LIDAR, "sweeps", len(_listing(path / SWEEPS)), float("nan"), "", MERGED))
        notes += (f"{LIDAR} is left out: {MERGED}",)
    if not made:
        raise DataError(f"{path} holds no images and no poses: {'; '.join(notes)}")
    epoch_ns = min(int(ns[0]) for ns, _, _ in made.values())
    streams = {
        name: Stream(
            name,
            "odometry" if name == EGO else "monocular",
            tables.seconds(ns, epoch_ns),
            readings,
            lenses.get(name),
            has_scale=name == EGO,
            notes=said,
            topic=name,
        )
        for name, (ns, readings, said) in made.items()
    }
    listed += [Topic(n, "poses" if n == EGO else "images", len(s), 1 / s.period, n) for n, s in streams.items()]
    return Log(path, streams, epoch_ns, _reference(path / MOUNTS, streams), notes, tuple(listed))


def _listing(folder: Path) -> list[Path]:
    try:
        return sorted(folder.iterdir())
    except OSError as e:
        raise DataError(f"{folder} can not be listed ({e.strerror or e}); make it readable") from e


def _folders(cameras: Path) -> list[Path]:
    """A folder for each camera, whose name is none that a command line takes for something else."""
    folders = [f for f in _listing(cameras) if f.is_dir()] if isdir(cameras) else []
    odd = next((f for f in folders if not re.fullmatch(r"[\w-]+", f.name) or f.name in (EGO, LIDAR)), None)
    if odd is not None:
        raise DataError(f"{odd} can not be a camera's name; rename it by letters, digits, - and _")
    return folders


def _images(folder: Path) -> tuple[tables.Nanoseconds, list[Path], tuple[str, ...]]:
    """Images by the nanoseconds that they are called, and a sentence on those that are called otherwise."""
    files = [f for f in _listing(folder) if f.suffix in (".jpg", ".png")]
    named = {int(f.stem): f for f in files if re.fullmatch("[0-9]{1,19}", f.stem)}
    usable = {ns: f for ns, f in named.items() if 0 < ns <= tables.LATEST * 10**9}
    if beyond := next((f for ns, f in named.items() if ns > tables.LATEST * 10**9), None):
        raise DataError(f"{beyond}: the stamp in its name is beyond any clock; name images by nanoseconds")
    gone = len(files) - len(usable)
    said = (f"{folder.name}: {gone} of {len(files)} images are not called by a stamp of their own",) if gone else ()
    ns = np.array(sorted(usable), dtype=np.int64)
    return ns, [usable[t] for t in ns.tolist()], said


def _poses(file: Path) -> tuple[tables.Nanoseconds, list[PoseReading], tuple[str, ...]]:
    """``T_city_ego`` at least ``SPACING_NS`` apart."""
    table = _table(file, ("timestamp_ns", *POSE))
    ns = table["timestamp_ns"].astype(np.int64)
    if np.any((ns <= 0) | (ns > tables.LATEST * 10**9)):
        raise DataError(f"{file}: 'timestamp_ns' must be nanoseconds of a clock; fetch the file again")
    T = _matrices(file, table)
    order = np.argsort(ns, kind="stable")
    order = order[tables.increasing(ns[order])]
    kept = order[stamps.spaced(ns[order], SPACING_NS)]
    if not len(kept):
        raise DataError(f"{file} holds no poses; fetch the file again")
    return ns[kept], [PoseReading(T[k]) for k in kept], ()


def _lenses(file: Path) -> dict[str, CameraIntrinsics]:
    """Each camera's matrix. Images are published undistorted, so that k1 to k3 are not theirs."""
    table = _table(file, ("sensor_name", *LENS))
    fx, fy, cx, cy, width, height = (table[name].astype(np.float64) for name in LENS)
    if np.any((fx <= 0) | (fy <= 0) | (width < 1) | (height < 1) | (width % 1 != 0) | (height % 1 != 0)):
        raise DataError(f"{file}: a camera matrix or a size of images is none; fetch the file again")
    lenses = {}
    for k, name in enumerate(table["sensor_name"].tolist()):
        K = np.array([[fx[k], 0, cx[k]], [0, fy[k], cy[k]], [0, 0, 1]])
        lenses[name] = CameraIntrinsics(K, size=(int(width[k]), int(height[k])))
    if len(lenses) < len(fx):
        raise DataError(f"{file} has a sensor twice; fetch the file again")
    return lenses


def _reference(file: Path, streams: Mapping[str, Stream]) -> Calibration | None:
    """``T_ego_camera`` as published, base ego; None where it is not there."""
    if not isfile(file):
        return None
    table = _table(file, ("sensor_name", *POSE))
    T = dict(zip(table["sensor_name"].tolist(), _matrices(file, table), strict=True))
    if len(T) < len(table["qw"]):
        raise DataError(f"{file} has a sensor twice; fetch the file again")
    names = (EGO, *(n for n in streams if n in T and n != EGO))
    determined = np.ones((len(names), 7), dtype=bool)
    determined[1:, 6] = False
    return Calibration(
        base=EGO,
        names=names,
        T_base_sensor=np.stack([np.eye(4), *(T[n] for n in names[1:])]),
        dt_base_sensor=np.zeros(len(names)),
        covariance=np.zeros((7 * len(names), 7 * len(names))),
        has_scale=np.array([n == EGO for n in names]),
        determined=determined,
    )


def _matrices(file: Path, table: Mapping[str, NDArray[Any]]) -> Array:
    """(n, 4, 4) of quaternions and translations."""
    w, x, y, z, *t = (table[name].astype(np.float64) for name in POSE)
    q = np.stack([x, y, z, w], axis=-1)
    if np.any(np.abs(q) > 2) or np.any(np.abs(np.linalg.norm(q, axis=1) - 1) > UNIT):
        raise DataError(f"{file}: the quaternion qw qx qy qz is not of length one; fetch the file again")
    if any(np.any(np.abs(column) > FARTHEST) for column in t):
        raise DataError(f"{file}: a translation leads nowhere on earth; fetch the file again")
    return se3.rigid(Rotation.from_quat(q).as_matrix(), np.stack(t, axis=-1)) if len(q) else np.zeros((0, 4, 4))


def _table(file: Path, columns: Sequence[str]) -> dict[str, NDArray[Any]]:
    """Columns of a feather file, texts of ``sensor_name`` and finite numbers of all others. Raises DataError."""
    try:
        import pyarrow
        from pyarrow import feather
    except ImportError as e:
        raise DataError(f"{file}: reading .feather takes pyarrow; pip install 'calib-toolkit[argoverse]'") from e
    try:
        table = feather.read_table(file, memory_map=False)
        table.validate(full=True)
        return {name: _column(file, table, name) for name in columns}
    except (pyarrow.ArrowException, OSError, ValueError, MemoryError) as e:
        raise DataError(f"{file} can not be read ({' '.join(str(e).split())[:200]}); fetch the file again") from e


def _column(file: Path, table: Any, name: str) -> NDArray[Any]:
    import pyarrow

    if table.column_names.count(name) != 1:
        raise DataError(f"{file} must have one column '{name}', and has {', '.join(table.column_names)[:200]}")
    column = table[name]
    text, kind = name == "sensor_name", column.type
    number = pyarrow.types.is_integer(kind) or (name != "timestamp_ns" and pyarrow.types.is_floating(kind))
    if column.null_count or not (pyarrow.types.is_string(kind) if text else number):
        raise DataError(f"{file}: '{name}' must be {'texts' if text else 'numbers'} in every row; fetch it again")
    values = np.array(column.to_pylist(), dtype=object) if text else column.to_numpy()
    if not text and not np.isfinite(values).all():
        raise DataError(f"{file}: '{name}' holds what is not finite; fetch the file again")
    return values
