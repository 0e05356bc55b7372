"""TUM's RGB-D layout: rgb.txt lists images with their stamps, groundtruth.txt holds poses from motion capture.

Sturm et al., "A benchmark for the evaluation of RGB-D SLAM systems", IROS 2012.
"""

import re
from dataclasses import replace
from functools import partial
from os.path import isfile
from pathlib import Path

import numpy as np

from calib_toolkit import CameraIntrinsics, Dataset, LazyReadings, Log, ReadContext, Stream, hookimpl, tables
from calib_toolkit.errors import DataError
from calib_toolkit_datasets import image_files, trajectory_writing
from calib_toolkit_datasets.merging import from_table, merged, refuse_leaving

LENSES = {
    "1": ((517.3, 516.5, 318.6, 255.3), (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)),
    "2": ((520.9, 521.0, 325.1, 249.7), (0.2312, -0.7849, -0.0033, -0.0001, 0.9172)),
    "3": ((535.4, 539.2, 320.1, 247.6), ()),
}
"""fx fy cx cy and distortion of the colour cameras that the set documents, by the number after ``freiburg``."""
SIZE = (640, 480)
UNREAD = {
    "depth.txt": "depth: its images of depth are not read, no sensor here takes them",
    "accelerometer.txt": "accelerometer: it tells neither turns nor travel, so it is not read",
}


@hookimpl
def calib_register_datasets() -> list[Dataset]:
    """The ``tum`` reader."""
    looks_for = "rgb.txt, with groundtruth.txt or depth.txt beside"
    return [Dataset("tum", looks_for, matches, open_log, trajectory_writing.write)]


def matches(path: Path) -> bool:
    """Whether a folder holds a list of colour images and one of the other files."""
    return isfile(path / "rgb.txt") and any(isfile(path / f) for f in ("groundtruth.txt", "depth.txt"))


def open_log(path: Path, context: ReadContext) -> Log:
    """The colour camera ``rgb`` and the poses ``groundtruth``, as far as they are there. Raises DataError."""
    path, logs = path.absolute(), []
    refuse_leaving(path, [path / f for f in ("rgb.txt", "groundtruth.txt") if isfile(path / f)])
    notes = [said for file, said in UNREAD.items() if isfile(path / file)]
    for name, file, read in (("rgb", "rgb.txt", _camera), ("groundtruth", "groundtruth.txt", _truth)):
        if isfile(path / file):
            try:
                logs.append(read(path, context))
            except DataError as e:
                notes.append(f"{name} is left out: {e}")
    if not logs:
        raise DataError(f"{path} holds no sensor that could be read: {'; '.join(notes) or 'there is no rgb.txt'}")
    log = merged(path, logs)
    return replace(log, notes=(*notes, *log.notes))


def _camera(path: Path, context: ReadContext) -> Log:
    ns, files, notes = image_files.listed("rgb", path / "rgb.txt", "1", path, path)
    number = re.search(r"freiburg([123])", path.resolve().name)
    intrinsics = None
    if number:
        (fx, fy, cx, cy), distortion = LENSES[number[1]]
        K = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
        intrinsics = CameraIntrinsics(K, np.array(distortion), SIZE)
    else:
        notes = (
            *notes,
            f"rgb has no intrinsics: the name of {path} tells none of the cameras freiburg1 to freiburg3; name the "
            'folder so, or write a rig.toml with kind = "monocular", images, times and camera_matrix',
        )
    images = LazyReadings(partial(image_files.load, sensor="rgb"), files)
    times = tables.seconds(ns, int(ns[0]))
    return Log(path, {"rgb": Stream("rgb", "monocular", times, images, intrinsics, False, notes=notes)}, int(ns[0]))


def _truth(path: Path, context: ReadContext) -> Log:
    return from_table(context, "odometry", "groundtruth", path, poses="groundtruth.txt", format="tum")
