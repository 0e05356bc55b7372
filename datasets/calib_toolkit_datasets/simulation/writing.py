"""Simulated drives on disk: every reading made once, in parallel, and whatever a kill left is kept."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from importlib.metadata import version
from pathlib import Path
from shutil import disk_usage
from time import process_time
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from calib_toolkit import DataError, Fix, Progress, Scan, write_calibration
from calib_toolkit_datasets.simulation import scene as world
from calib_toolkit_datasets.simulation import vehicle
from calib_toolkit_datasets.simulation.camera import CameraModel, daylight, render
from calib_toolkit_datasets.simulation.folder_layout import FolderLayout
from calib_toolkit_datasets.simulation.ins import InsModel, fixes
from calib_toolkit_datasets.simulation.kitti_layout import KittiLayout
from calib_toolkit_datasets.simulation.lidar import LidarModel, sweep
from calib_toolkit_datasets.simulation.rigs import (
    RIGS,
    START_NS,
    Mounted,
    Nanoseconds,
    Rig,
    generator,
    synced,
    truth,
)
from calib_toolkit_datasets.simulation.surfaces import Scene
from calib_toolkit_datasets.simulation.terrain import terrain

Array = NDArray[np.float64]

LAYOUTS = ("extract", "sync")
LONGEST = 1800.0
"""Seconds: the scene of half an hour takes 2.5 GB in each process."""
PART = 6
"""Readings that a process makes before it says so."""
IMAGE, FIX = 0.6, 4096
"""About how many bytes a pixel takes in each channel of an image, and a fix."""
TRAJECTORY_RATE = 100.0


class Layout(Protocol):
    """Where the parts of a drive lie, by paths in its folder, and what is in them."""

    def reading(self, sensor: Mounted, k: int) -> str:
        """Path of reading k."""
        ...

    def scan(self, scan: Scan) -> bytes:
        """Content of a scan's file."""
        ...

    def fixes(self, sensor: Mounted, fixes: list[Fix], ns: Nanoseconds, path: vehicle.TruePath) -> dict[str, str]:
        """Files of all fixes of an INS, by path."""
        ...

    def texts(self, rig: Rig, stamps: Mapping[str, Nanoseconds]) -> dict[str, str]:
        """Files beside the readings, by path."""
        ...

    def rig_toml(self, rig: Rig) -> str:
        """The table of sensors that makes the folder a recording."""
        ...


@dataclass(frozen=True)
class Wish:
    """What a folder shall hold: a kind of rig, of drive and of scene, seconds, a seed, and how it is laid out.

    layout: extract or sync for the kitti rig, folders for any other. sensors: names of those wanted, all if empty.
    Raises DataError for what there is not.
    """

    rig: str
    seconds: float
    seed: int
    drive: str
    scene: str
    layout: str
    sensors: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        layouts = LAYOUTS if self.rig == "kitti" else ("folders",)
        for what, name, known in (
            ("rig", self.rig, tuple(RIGS)),
            ("drive", self.drive, vehicle.DRIVES),
            ("scene", self.scene, world.LAYOUTS),
            (f"layout of a {self.rig}", self.layout, layouts),
        ):
            if name not in known:
                raise DataError(f"there is no {what} called '{name}'; choose one of: {', '.join(known)}")
        if not 1.0 <= self.seconds <= LONGEST:
            raise DataError(f"a drive takes from 1 to {LONGEST:g} seconds, not {self.seconds:g}")
        if self.seed < 0:
            raise DataError(f"a seed is 0 or more, not {self.seed}")
        there = [s.name for s in RIGS[self.rig](self.seed).sensors]
        for name in self.sensors:
            if name not in there:
                raise DataError(f"a {self.rig} has no sensor '{name}'; choose among: {', '.join(there)}")


@dataclass(frozen=True)
class Written:
    """How many readings of a sensor there are, how many were made now, and the processor seconds that it took."""

    sensor: str
    readings: int
    made: int
    seconds: float


def write(folder: Path, wish: Wish, progress: Progress, jobs: int) -> list[Written]:
    """Make the drive in a folder, beginning where an earlier call stopped: the same bytes whatever the jobs.

    ``rig.toml`` comes last, so that half a drive is no recording. Raises DataError if the folder holds anything
    else, or the disk too little space.
    """
    import joblib

    _claim(folder, wish)
    rig, layout = build_rig(wish), _layout(wish)
    stamps = {s.name: s.stamps(wish.seconds, wish.seed) for s in rig.sensors}
    missing = {s.name: _missing(folder, layout, s, len(stamps[s.name])) for s in rig.sensors}
    _check_space(folder, rig, missing)
    for file, text in layout.texts(rig, stamps).items():
        _put(folder / file, text.encode())
    parts = []
    for s in rig.sensors:
        progress.begin(s.name, len(stamps[s.name]), len(stamps[s.name]) - len(missing[s.name]))
        step = len(missing[s.name]) if isinstance(s.model, InsModel) else PART
        parts += [(s.name, missing[s.name][i : i + step]) for i in range(0, len(missing[s.name]), max(step, 1))]
    took = dict.fromkeys(stamps, 0.0)
    pool = joblib.Parallel(n_jobs=jobs, return_as="generator_unordered", pre_dispatch="2*n_jobs")
    for name, made, seconds in pool(joblib.delayed(_make)(folder, wish, name, numbers) for name, numbers in parts):
        progress.advance(name, made)
        took[name] += seconds
    _put(folder / "trajectory.txt", _trajectory(_path(wish), wish.seconds).encode())
    first = min(int(ns[0]) for ns in stamps.values())
    write_calibration(truth(rig, t_ref=-first / 1e9), folder / "truth.json")
    _put(folder / "rig.toml", layout.rig_toml(rig).encode())
    return [Written(name, len(ns), len(missing[name]), took[name]) for name, ns in stamps.items()]


def build_rig(wish: Wish) -> Rig:
    """The vehicle of a wish, with the sensors that are wanted."""
    rig = RIGS[wish.rig](wish.seed)
    rig = synced(rig) if wish.layout == "sync" else rig
    wanted = [s for s in rig.sensors if s.name in wish.sensors]
    return replace(rig, sensors=tuple(wanted)) if wanted else rig


def _layout(wish: Wish) -> Layout:
    return KittiLayout(wish.seed, wish.layout) if wish.rig == "kitti" else FolderLayout()


def _claim(folder: Path, wish: Wish) -> None:
    """Take an empty folder, or one that was begun with the same wish."""
    file = folder / "drive.json"
    content = {**asdict(wish), "sensors": list(wish.sensors), "version": version("calib-toolkit")}
    try:
        if file.is_file():
            held = json.loads(file.read_text())
        else:
            folder.mkdir(parents=True, exist_ok=True)
            if any(f.suffix != ".part" for f in folder.iterdir()):
                raise DataError(f"{folder} holds files of something else; name an empty folder, or a new one")
            _put(file, (json.dumps(content, indent=1) + "\n").encode())
            return
    except (OSError, ValueError) as e:
        raise DataError(f"{folder} can not take a drive ({e}); name an empty folder, or a new one") from e
    if held != content:
        others = [k for k in content if not isinstance(held, dict) or held.get(k) != content[k]]
        what = ", ".join(f"{k} {held.get(k)}" for k in others) if isinstance(held, dict) else "something else"
        asked = ", ".join(f"{k} {content[k]}" for k in others)
        raise DataError(f"{folder} was begun with {what}, and {asked} is asked for; name another folder or remove it")


def _missing(folder: Path, layout: Layout, sensor: Mounted, readings: int) -> list[int]:
    return [k for k in range(readings) if not (folder / layout.reading(sensor, k)).exists()]


def _check_space(folder: Path, rig: Rig, missing: Mapping[str, Sequence[int]]) -> None:
    needed = sum(_bytes(s) * len(missing[s.name]) for s in rig.sensors)
    free = disk_usage(folder).free
    if needed > free:
        raise DataError(
            f"the drive takes about {needed / 1e9:.1f} GB and {folder} has {free / 1e9:.1f} GB free; make room, or "
            "ask for fewer seconds"
        )


def _bytes(sensor: Mounted) -> float:
    """Of one reading, about."""
    if isinstance(sensor.model, LidarModel):
        return 16.0 * sensor.model.rays
    if isinstance(sensor.model, CameraModel):
        width, height = sensor.model.intrinsics.size or (0, 0)
        return IMAGE * width * height * (3 if sensor.model.colour else 1)
    return FIX


def _make(folder: Path, wish: Wish, name: str, numbers: Sequence[int]) -> tuple[str, int, float]:
    """Make some readings of one sensor. Its name, how many they are, and the processor seconds they took."""
    rig, layout, path = _rig(wish), _layout(wish), _path(wish)
    sensor = rig.sensor(name)
    ns = sensor.stamps(wish.seconds, wish.seed)
    instants = sensor.instants(ns)
    if not isinstance(sensor.model, InsModel):
        _scene(wish)
    start = process_time()
    if isinstance(sensor.model, InsModel):
        made = fixes(sensor.model, path, sensor.T_vehicle_sensor, instants, generator(wish.seed, name, 0))
        for file, text in layout.fixes(sensor, made, ns, path).items():
            if not (folder / file).exists():
                _put(folder / file, text.encode())
    else:
        for k in numbers:
            _put(folder / layout.reading(sensor, k), _reading(wish, sensor, float(instants[k]), k, layout))
    return name, len(numbers), process_time() - start


def _reading(wish: Wish, sensor: Mounted, instant: float, k: int, layout: Layout) -> bytes:
    rng, at = generator(wish.seed, sensor.name, k), (_scene(wish), _path(wish), sensor.T_vehicle_sensor, instant)
    if isinstance(sensor.model, LidarModel):
        return layout.scan(sweep(sensor.model, *at, rng))
    assert isinstance(sensor.model, CameraModel)
    import cv2

    image = render(sensor.model, *at, daylight(wish.seed), rng)
    return cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1].tobytes()


@lru_cache(maxsize=1)
def _rig(wish: Wish) -> Rig:
    return build_rig(wish)


@lru_cache(maxsize=1)
def _path(wish: Wish) -> vehicle.TruePath:
    return vehicle.path(wish.seconds, wish.seed, wish.drive)


@lru_cache(maxsize=1)
def _scene(wish: Wish) -> Scene:
    return world.build(_path(wish), terrain(wish.seed, wish.drive), wish.scene, wish.seed)


def _put(file: Path, content: bytes) -> None:
    """Write a file whole or not at all."""
    file.parent.mkdir(parents=True, exist_ok=True)
    part = file.with_name(f"{file.name}.part")
    part.write_bytes(content)
    part.replace(file)


def _trajectory(path: vehicle.TruePath, seconds: float) -> str:
    """The vehicle's poses, TUM: true unix seconds, x y z, quaternion x y z w; world axes east, north, up."""
    at = np.arange(0.0, seconds, 1 / TRAJECTORY_RATE)
    poses = path.at(at)
    rows = np.column_stack([poses[:, :3, 3], Rotation.from_matrix(poses[:, :3, :3]).as_quat()])
    return "".join(
        f"{START_NS // 10**9 + t:.3f} " + " ".join(f"{x:.12g}" for x in r) + "\n"
        for t, r in zip(at, rows, strict=True)
    )
