"""Poses with known noise, in files of every format."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from calib_toolkit import Motions, SensorTable, Stream, se3
from calib_toolkit.testing import TURNING, Drive
from calib_toolkit_plugins import odometry_tables
from calib_toolkit_plugins.odometry import OdometryOptions, estimate

Array = NDArray[np.float64]
SIGMA = np.array([0.02, 0.01, 0.03, 1e-3, 2e-3, 5e-4])
START_NS = 1317646534939040123
PERIOD_NS = 100_000_003


def poses(n: int, drive: Drive = TURNING) -> Array:
    return drive.pose(0.1 * np.arange(n))


def noisy(n: int, seed: int = 0, drive: Drive = TURNING) -> Motions:
    T = poses(n + 1, drive)
    vec = se3.vector(se3.relative(T[:-1], T[1:]))
    vec = vec + SIGMA * np.random.default_rng(seed).standard_normal(vec.shape)
    stamps = 0.1 * np.arange(n + 1)
    return Motions(stamps[:-1], stamps[1:], vec, np.zeros((n, 6, 6)))


def integrated(motions: Motions) -> list[Array]:
    T = [np.eye(4)]
    for step in se3.matrix(motions.vec):
        T.append(T[-1] @ step)
    return T


def written(folder: Path, style: str, T: Sequence[Array]) -> dict[str, Any]:
    """The poses as a file of one of the formats, and the table that names it."""
    stamps = [START_NS + PERIOD_NS * k for k in range(len(T))]
    seconds = [f"{s // 10**9}.{s % 10**9:09d}" for s in stamps]
    q = Rotation.from_matrix(np.array(T)[:, :3, :3])
    t = [" ".join(map(repr, pose[:3, 3].tolist())) for pose in T]
    lines = {
        "tum": [f"{s} {p} {' '.join(map(str, r))}" for s, p, r in zip(seconds, t, q.as_quat(), strict=True)],
        "kitti": [" ".join(map(repr, pose[:3].ravel().tolist())) for pose in T],
        "euroc": [
            f"{s},{p.replace(' ', ',')},{','.join(map(str, r))},0,0,0"
            for s, p, r in zip(stamps, t, q.as_quat(scalar_first=True), strict=True)
        ],
    }[style]
    (folder / "poses.txt").write_text("# a comment\n\n" + "\n".join(lines) + "\n")
    (folder / "times.txt").write_text("\n".join(seconds))
    return {"kind": "odometry", "poses": "poses.txt", "format": style} | (
        {"times": "times.txt"} if style == "kitti" else {}
    )


def opened(folder: Path, values: dict[str, Any]) -> Stream:
    return odometry_tables.open_table(SensorTable("slam", folder, values)).streams["slam"]


def measured(stream: Stream) -> Motions:
    found = estimate(stream, OdometryOptions(**stream.options))
    assert isinstance(found, Motions)
    return found
