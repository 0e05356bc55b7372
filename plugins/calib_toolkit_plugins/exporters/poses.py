"""Rotations as files have them, checked; poses as sentences; frames that hang on each other as one calibration."""

import re
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from calib_toolkit import Calibration, CameraIntrinsics, se3
from calib_toolkit.errors import DataError

Array = NDArray[np.float64]
Edge = tuple[str, str, Array]
"""Parent, child and ``T_parent_child``."""

EXACT = 1e-12
"""Metres, and elements of a rotation, within which two frames are one."""
LOOSE = 1e-3
"""How far a rotation may be from one: files round to a few digits."""
CAMERA = re.compile(r"(.*[_/.\s-])?cam(era)?([\d_/.\s-].*)?", re.IGNORECASE)


def cameras(c: Calibration, intrinsics: Mapping[str, CameraIntrinsics]) -> list[str]:
    """Which sensors are cameras: those without scale, with intrinsics, or called cam0, front_camera and the like."""
    return [
        n
        for n, scaled in zip(c.names, c.has_scale, strict=True)
        if not scaled or n in intrinsics or CAMERA.fullmatch(n)
    ]


def direction(c: Calibration, parent: str = "", child: str = "") -> str:
    """Which way a transform goes, in words."""
    parent = parent or c.base
    child = child or next((n for n in c.names if n != parent), parent)
    return f"T_{parent}_{child} maps points of {child} to {parent} and is the pose of {child} in {parent}"


def quaternion_xyzw(T: Array) -> list[float]:
    """Unit quaternion of (4, 4), its real part last and not negative."""
    return [float(x) for x in Rotation.from_matrix(T[:3, :3]).as_quat(canonical=True)]


def from_quaternion(file: Path, what: str, xyzw: Sequence[float], t: ArrayLike) -> Array:
    """(4, 4). Raises DataError for a quaternion that is not of length one."""
    if not abs(np.linalg.norm(xyzw) - 1.0) < LOOSE:
        raise DataError(f"{file}: the quaternion of {what} has length {np.linalg.norm(xyzw):.4g}, not 1; correct it")
    return se3.rigid(Rotation.from_quat(xyzw).as_matrix(), t)


def from_rotation(file: Path, what: str, R: Array, t: ArrayLike) -> Array:
    """(4, 4), the rotation made exact. R: (3, 3). Raises DataError if it is not one, or left-handed."""
    if not np.allclose(R @ R.T, np.eye(3), atol=LOOSE):
        raise DataError(f"{file}: the matrix of {what} is not a rotation; correct it or fetch the file again")
    if np.linalg.det(R) < 0:
        raise DataError(f"{file}: the axes of {what} are left-handed, which no rotation gives; correct them")
    return se3.rigid(Rotation.from_matrix(R).as_matrix(), t)


def from_matrix(file: Path, what: str, T: Array) -> Array:
    """(4, 4), the rotation made exact. Raises DataError if it is no rigid transform."""
    if not np.allclose(T[3], [0, 0, 0, 1], atol=1e-9):
        raise DataError(f"{file}: the last row of {what} is not 0 0 0 1; is the matrix transposed?")
    return from_rotation(file, what, T[:3, :3], T[:3, 3])


def from_rpy(xyz: Sequence[float], rpy: Sequence[float]) -> Array:
    """(4, 4) of ``Rz(yaw) Ry(pitch) Rx(roll)``, radians, about fixed axes."""
    return se3.rigid(Rotation.from_euler("xyz", rpy).as_matrix(), xyz)


def to_rpy(T: Array) -> list[float]:
    """Roll, pitch and yaw of (4, 4), radians; exact also where the pitch is 90 degrees, and yaw and roll are one."""
    R = T[:3, :3]
    roll = np.arctan2(R[2, 1], R[2, 2])
    pitch = np.arctan2(-R[2, 0], np.hypot(R[2, 1], R[2, 2]))
    # of what is left once that roll is undone, so that both together are right even where neither alone is
    yaw = np.arctan2(np.sin(roll) * R[0, 2] - np.cos(roll) * R[0, 1], np.cos(roll) * R[1, 1] - np.sin(roll) * R[1, 2])
    return [float(roll), float(pitch), float(yaw)]


def calibration(
    file: Path, base: str, T_base_sensor: Mapping[str, Array], without_scale: Collection[str] = ()
) -> Calibration:
    """Poses as a calibration that states no sigma and knows no clock. T_base_sensor: (4, 4) of each but the base."""
    if not T_base_sensor:
        raise DataError(f"{file} holds no pose of any sensor; name a file that does")
    names = (base, *T_base_sensor)
    determined = np.ones((len(names), 7), dtype=bool)
    determined[1:, 6] = False
    return Calibration(
        base=base,
        names=names,
        T_base_sensor=np.stack([np.eye(4), *T_base_sensor.values()]),
        dt_base_sensor=np.zeros(len(names)),
        covariance=np.zeros((7 * len(names), 7 * len(names))),
        has_scale=np.array([n not in without_scale for n in names]),
        determined=determined,
    )


def from_tree(
    file: Path, edges: Sequence[Edge], without_scale: Collection[str] = (), frame: str | None = None
) -> Calibration:
    """Frames that hang on each other, all seen from the one on which they hang.

    frame: a root of this name is no sensor if a sensor coincides with it. Raises DataError if there is no one root.
    """
    parents = {child: (parent, T) for parent, child, T in edges}
    if len(parents) < len(edges):
        children = [child for _, child, _ in edges]
        twice = next(c for k, c in enumerate(children) if c in children[:k])
        raise DataError(f"{file} gives the frame {twice} two parents; remove one")
    roots = list(dict.fromkeys(parent for parent, _, _ in edges if parent not in parents))
    if len(roots) > 1:
        raise DataError(f"{file}: nothing ties {roots[0]} to {roots[1]}; add a transform between them")
    if not roots:
        raise DataError(f"{file} holds no transform, or they go round in circles; name a file that does")
    T_root: dict[str, Array] = {roots[0]: np.eye(4)}
    for child in parents:
        chain = [child]
        while chain[-1] not in T_root:
            if len(chain) > len(parents):
                raise DataError(f"{file}: the transforms of {child} go round in circles; remove one of them")
            chain.append(parents[chain[-1]][0])
        for link in chain[-2::-1]:
            T_root[link] = T_root[parents[link][0]] @ parents[link][1]
    at_root = [n for n, T in T_root.items() if n != roots[0] and np.allclose(T, np.eye(4), rtol=0, atol=EXACT)]
    base = at_root[0] if frame == roots[0] and at_root and len(T_root) > 2 else roots[0]
    others = {n: T for n, T in T_root.items() if n not in (roots[0], base)}
    return calibration(file, base, others, without_scale)
