"""A log as a drive of KITTI raw: ``DST/DATE_drive_0000_extract`` and the cameras' calibration beside it.

KITTI has one scanner, four cameras and one INS, no times of points, and one accuracy for all axes of a position;
whatever else a log holds is named as lost.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib_toolkit import Calibration, CameraIntrinsics, Fix, Log, Progress, Scan, Stream, Written, se3
from calib_toolkit.errors import DataError
from calib_toolkit_datasets.journal import Fact, Journal
from calib_toolkit_datasets.kitti_files import sweep_times

Array = NDArray[np.float64]

PLACES = {"velodyne": ("velo",), "gps_ins": ("ins",), "monocular": ("cam0", "cam1", "cam2", "cam3")}
FOLDERS = {"velo": "velodyne_points", "ins": "oxts", **{f"cam{i}": f"image_{i:02d}" for i in range(4)}}
COEFFICIENTS = 5
SLOW = 1e-3
"""Seconds by which the time of a point may differ from what KITTI's reader makes of its azimuth."""
UNKNOWN = "nan"
OXTS = 30


def write(log: Log, path: Path, progress: Progress) -> Written:
    """The drive, its readings numbered from 0. Raises DataError."""
    placed, lost = _placed(log)
    if not placed:
        raise DataError(f"{log.source} holds no sensor that KITTI raw has a place for; choose another format")
    day = str(np.datetime64(max(log.epoch_ns, 0), "ns").astype("M8[D]")).replace("-", "_")
    drive = path / f"{day}_drive_0000_extract"
    counts = dict.fromkeys(log.streams, 0)
    with Journal(path) as journal:
        for name, stream in placed.items():
            journal.begin(stream, progress)
            counts[stream.name] = _stream(log, name, stream, drive / FOLDERS[name], journal, progress, lost)
    cameras = {name: s for name, s in placed.items() if name.startswith("cam") and s.intrinsics}
    names = {s.name: name for name, s in placed.items()}
    (path / "calib_cam_to_cam.txt").write_text(_cameras(cameras, log.reference, lost))
    if log.reference is not None:
        for file, text in _others(log.reference, names).items():
            (path / file).write_text(text)
        lost.append("the reference's clock offsets and covariance: KITTI has no place for them")
    return Written(counts, tuple(lost), drive.name)


def _placed(log: Log) -> tuple[dict[str, Stream], list[str]]:
    """Streams by the name that KITTI's reader gives them; a camera called as one of KITTI's stays that."""
    placed: dict[str, Stream] = {}
    lost: list[str] = []
    for stream in sorted(log.streams.values(), key=lambda s: s.name not in FOLDERS):
        free = [n for n in PLACES.get(stream.kind, ()) if n not in placed]
        if not free:
            lost.append(f"{stream.name}: KITTI raw has no {'further ' * (stream.kind in PLACES)}{stream.kind}")
            continue
        name = stream.name if stream.name in free else free[0]
        placed[name] = stream
        if name != stream.name:
            lost.append(f"the name {stream.name}: it is called {name} there")
    return placed, lost


def _stream(
    log: Log, name: str, stream: Stream, folder: Path, journal: Journal, progress: Progress, lost: list[str]
) -> int:
    """Readings as numbered files and their stamps; how many were written."""
    data = folder / "data"
    kept: list[int] = []
    data.mkdir(parents=True, exist_ok=True)
    period = stream.period if len(stream) > 1 else 0.1
    worst, uneven, angles, bad = 0.0, 0.0, False, []
    for k in range(len(stream)):
        fact = journal.known(stream, k)
        if fact is None:
            fact = _reading(stream, k, data / f"{len(kept):010d}", period)
            journal.note(stream, k, fact)
            progress.advance(stream.name, 1)
        if "bad" in fact:
            bad.append(fact["bad"])
            continue
        worst, uneven = max(worst, fact.get("worst", 0.0)), max(uneven, fact.get("uneven", 0.0))
        angles = angles or fact.get("angles", False)
        kept.append(k)
    ns = log.epoch_ns + np.round(stream.stamps[kept] * 1e9).astype(np.int64)
    _stamps(folder, ns, period if name == "velo" else None)
    if bad:
        lost.append(f"{stream.name}: {len(bad)} unreadable, the first because {bad[0]}")
    if worst > SLOW:
        lost.append(f"{stream.name}: times of points; KITTI's reader makes them up, up to {worst:.3f} s otherwise")
    if uneven > 0.01:
        lost.append(f"{stream.name}: the sigma of each axis of a position; KITTI has one for all")
    if angles:
        lost.append(f"{stream.name}: the sigma of attitude, for which KITTI has no place")
    if stream.intrinsics is not None and stream.intrinsics.mask is not None:
        lost.append(f"{stream.name}: the mask of its images, for which KITTI has no place")
    return len(kept)


def _reading(stream: Stream, k: int, file: Path, period: float) -> Fact:
    """One reading as its file, and what of it KITTI has no place for."""
    try:
        reading = stream.readings[k]
    except DataError as e:
        return {"bad": str(e)}
    if isinstance(reading, Scan):
        intensity = np.zeros(len(reading.points)) if reading.intensity is None else reading.intensity
        rows = np.column_stack([reading.points, intensity]).astype("<f4")
        file.with_suffix(".bin").write_bytes(rows.tobytes())
        made_up = sweep_times(np.ascontiguousarray(reading.points, dtype=np.float32), period)
        times = np.zeros(len(rows)) if reading.times is None else reading.times
        return {"worst": float(np.abs(times - made_up).max(initial=0.0))}
    if isinstance(reading, Fix):
        if np.isnan(reading.yaw):
            return {"bad": f"reading {k} tells no attitude, which KITTI's packets must"}
        line, off = _oxts(reading)
        file.with_suffix(".txt").write_text(line)
        return {"uneven": off, "angles": reading.sigma_rpy is not None}
    _png(file.with_suffix(".png"), reading, stream, k)
    return {}


def _oxts(fix: Fix) -> tuple[str, float]:
    """The 30 numbers of a fix, and by what share its sigmas of position differ. What was not recorded is nan."""
    sigma = None if fix.sigma_position is None else np.asarray(fix.sigma_position, dtype=float)
    accuracy = 0.0 if sigma is None else float(np.sqrt(np.mean(sigma**2)))
    known = [np.degrees(fix.lat), np.degrees(fix.lon), fix.alt, fix.roll, fix.pitch, fix.yaw]
    words = [f"{float(x)!r}" for x in known] + [UNKNOWN] * 17 + [f"{accuracy!r}", UNKNOWN] + ["0"] * 5
    assert len(words) == OXTS
    return " ".join(words) + "\n", 0.0 if sigma is None or not accuracy else float(np.ptp(sigma) / accuracy)


def _png(file: Path, image: Any, stream: Stream, k: int) -> None:
    import cv2

    if not isinstance(image, np.ndarray) or not cv2.imwrite(str(file), image, [cv2.IMWRITE_PNG_COMPRESSION, 1]):
        raise DataError(
            f"sensor {stream.name}, reading {k}: {type(image).__name__} is nothing that KITTI raw can hold"
        )


def _stamps(folder: Path, ns: NDArray[np.int64], sweep: float | None) -> None:
    """One date to the nanosecond a line; a scanner's stamp is the middle of its sweep of so many seconds."""
    columns = {"timestamps": ns}
    if sweep is not None:
        half = round(sweep * 1e9) // 2
        columns |= {"timestamps_start": ns - half, "timestamps_end": ns + half}
    for name, column in columns.items():
        lines = [f"{str(t).replace('T', ' ')}\n" for t in column.astype("M8[ns]")]
        (folder / f"{name}.txt").write_text("".join(lines))


def _cameras(cameras: Mapping[str, Stream], reference: Calibration | None, lost: list[str]) -> str:
    """``calib_cam_to_cam.txt``: of each camera as it is; its rectified image is not known, and so left out."""
    lines = ["calib_time: 01-Jan-1970 00:00:00", "corner_dist: 0.0"]
    T_cam = {} if reference is None else dict(zip(reference.names, reference.T_base_sensor, strict=True))
    first = next((s.name for s in cameras.values() if s.name in T_cam), None)
    for name, stream in cameras.items():
        lens = stream.intrinsics
        assert isinstance(lens, CameraIntrinsics)
        if np.any(np.asarray(lens.distortion)[COEFFICIENTS:]):
            raise DataError(
                f"sensor {stream.name}: its distortion has more coefficients than KITTI's 5; leave it out"
            )
        D = np.resize(np.concatenate([lens.distortion, np.zeros(COEFFICIENTS)]), COEFFICIENTS)
        size = lens.size or np.asarray(stream.readings[0]).shape[1::-1]
        entries: dict[str, Any] = {"S": size, "K": lens.K, "D": D}
        if first is not None and stream.name in T_cam:
            T = se3.relative(T_cam[stream.name], T_cam[first])
            entries |= {"R": T[:3, :3], "T": T[:3, 3]}
        else:
            entries |= {"R": np.eye(3), "T": np.zeros(3)}
            lost.append(f"{stream.name}: its pose is not known; zero stands in calib_cam_to_cam.txt")
        i = name[-1]
        lines += [f"{k}_0{i}: {' '.join(repr(float(x)) for x in np.ravel(v))}" for k, v in entries.items()]
    return "\n".join(lines) + "\n"


def _others(reference: Calibration, names: Mapping[str, str]) -> dict[str, str]:
    """``calib_velo_to_cam.txt`` and ``calib_imu_to_velo.txt``, as far as the reference tells them."""
    T = {names[n]: T for n, T in zip(reference.names, reference.T_base_sensor, strict=True) if n in names}
    camera = next((n for n in ("cam0", "cam1", "cam2", "cam3") if n in T), None)
    pairs = {"calib_velo_to_cam.txt": (camera, "velo"), "calib_imu_to_velo.txt": ("velo", "ins")}
    texts = {}
    for file, (a, b) in pairs.items():
        if a in T and b in T and np.isfinite([T[a], T[b]]).all():
            T_a_b = se3.relative(T[a], T[b])
            R, t = (" ".join(repr(float(x)) for x in np.ravel(v)) for v in (T_a_b[:3, :3], T_a_b[:3, 3]))
            texts[file] = f"calib_time: 01-Jan-1970 00:00:00\nR: {R}\nT: {t}\n"
    return texts
