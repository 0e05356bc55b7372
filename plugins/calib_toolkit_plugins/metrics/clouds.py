"""Scans in the colours of a camera's images, for a person to judge a pose by: a cloud, and a recording for rerun."""

from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib_toolkit import Pair, Stream, poses_at
from calib_toolkit.errors import DataError
from calib_toolkit_plugins.metrics.pictures import laid, nothing_to_draw, visible
from calib_toolkit_plugins.metrics.views import Array

SWEEPS, THINNED = 20, 3  # scans in a cloud or recording, at most; a recording keeps one point in so many


def coloured_cloud(pair: Pair, T_a_b: Array, file: Path) -> None:
    """Write a binary PLY of scans in the images' colours (see :func:`coloured`), in the lidar's frame at the first.

    Holds what the camera sees. T_a_b: (4, 4). Raises DataError if no scan can be coloured or the file not be written.
    """
    import open3d as o3d

    views = coloured(pair, T_a_b)
    points = np.concatenate([v.points @ v.T_first_now[:3, :3].T + v.T_first_now[:3, 3] for v in views])
    cloud = o3d.t.geometry.PointCloud(o3d.core.Tensor.from_numpy(points.astype(np.float32)))
    cloud.point.colors = o3d.core.Tensor.from_numpy(np.concatenate([v.colours for v in views]))
    file.parent.mkdir(parents=True, exist_ok=True)
    if not o3d.t.io.write_point_cloud(file, cloud):
        raise DataError(f"{file} could not be written; the name must end in .ply, and the folder allow writing")


def recording(pair: Pair, T_a_b: Array, file: Path) -> None:
    """Write a rerun recording (.rrd) of scans (see :func:`coloured`) and their images, the camera where T_a_b has it.

    Raises DataError if rerun is not installed or no scan can be coloured.
    """
    try:
        rr: Any = import_module("rerun")
    except ImportError as error:
        raise DataError(f"{file} can not be written without rerun: pip install calib-toolkit[viz]") from error
    views = coloured(pair, T_a_b)
    lidar, camera = ["world", pair.a.name], ["world", pair.a.name, pair.b.name]
    lens = rr.Pinhole(image_from_camera=views[0].K, resolution=views[0].image.shape[1::-1], image_plane_distance=2.0)
    file.parent.mkdir(parents=True, exist_ok=True)
    out = rr.RecordingStream("calib-toolkit")
    out.save(file)
    out.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    out.log(camera, rr.Transform3D(translation=T_a_b[:3, 3], mat3x3=T_a_b[:3, :3]), static=True)
    out.log([*camera, "image"], lens, static=True)
    for v in views:
        out.set_time("drive", duration=v.stamp)
        out.log(lidar, rr.Transform3D(translation=v.T_first_now[:3, 3], mat3x3=v.T_first_now[:3, :3]))
        out.log([*lidar, "points"], rr.Points3D(v.points[::THINNED], colors=v.colours[::THINNED], radii=0.03))
        out.log([*camera, "image"], rr.Image(v.image).compress(jpeg_quality=75))
    out.disconnect()


@dataclass(frozen=True)
class Coloured:
    """What a camera sees of a scan: points (n, 3), lidar frame at the image's instant ``stamp`` (s, lidar's clock),
    with colours (n, 3) red green blue; the image (h, w, 3), undistorted. T_first_now: (4, 4), the lidar's pose.
    """

    stamp: float
    points: Array
    colours: NDArray[np.uint8]
    image: NDArray[np.uint8]
    K: Array
    T_first_now: Array


def coloured(pair: Pair, T_a_b: Array) -> list[Coloured]:
    """Up to twenty scans that follow each other, as far as the motion since the first is known: so dense that
    colours which run over an edge show. Raises DataError.
    """
    found: list[Coloured] = []
    close = consecutive(pair)
    for row in range(len(close)):
        moment, k = laid(close, row), int(close.selected[row, 1])
        if moment is None:
            continue
        uv, shown = visible(moment, T_a_b)
        now = float(pair.b.stamps[k] + pair.dt_a_b)
        T_first_now = poses_at(pair.motion_a, [now], found[0].stamp if found else now)[0]
        if len(shown) and np.all(np.isfinite(T_first_now)):
            image = in_colour(pair.b, k)
            x, y = np.round(uv).astype(int).T
            found.append(Coloured(now, moment.points[0][shown], image[y, x], image, moment.K, T_first_now))
    if not found:
        raise nothing_to_draw(pair)
    return found


def consecutive(pair: Pair) -> Pair:
    """Scans that follow each other around the middle of ``pair.selected``, each with the image nearest in time."""
    if not len(pair):
        return pair
    middle = int(pair.selected[len(pair) // 2, 0])
    first = max(min(middle - SWEEPS // 2, len(pair.a) - SWEEPS), 0)
    scans = np.arange(first, min(first + SWEEPS, len(pair.a)))
    apart = np.abs(pair.a.stamps[scans, None] - (pair.b.stamps + pair.dt_a_b))
    return replace(pair, selected=np.column_stack([scans, np.argmin(apart, axis=1)]))


def in_colour(camera: Stream, k: int) -> NDArray[np.uint8]:
    """(h, w, 3) red, green, blue: image k without its distortion."""
    import cv2

    image = np.asarray(camera.readings[k])
    image = cv2.cvtColor(image, cv2.COLOR_GRAY2RGB if image.ndim == 2 else cv2.COLOR_BGR2RGB)
    lens = camera.intrinsics
    if lens is not None and np.any(lens.distortion):
        image = cv2.undistort(image, lens.K, lens.distortion)
    return np.asarray(image, np.uint8)
