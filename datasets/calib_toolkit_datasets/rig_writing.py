"""A log as a folder with a rig.toml: a folder for each sensor, and nothing that lies elsewhere."""

import json
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from calib_toolkit import Fix, Log, MotionReading, PoseReading, Progress, Scan, Stream, Written, write_calibration
from calib_toolkit.errors import DataError
from calib_toolkit_datasets.journal import Fact, Journal

Array = NDArray[np.float64]

KINDS = {"velodyne": Scan, "monocular": np.ndarray, "ladybug": np.ndarray, "gps_ins": Fix}
AXES = ("x", "y", "z", "rx", "ry", "rz")
COV = [(i, j, f"cov_{a}_{b}") for i, a in enumerate(AXES) for j, b in enumerate(AXES) if i <= j]
FIX = ("lat_deg", "lon_deg", "alt", "roll_deg", "pitch_deg", "yaw_deg")
SIGMAS = ("sigma_east", "sigma_north", "sigma_up", "sigma_roll_deg", "sigma_pitch_deg", "sigma_yaw_deg")
POSE = ("x", "y", "z", "qx", "qy", "qz", "qw")


@dataclass(frozen=True)
class _Place:
    """Where a sensor goes. numbers: (n,) of its readings, as their files are called."""

    root: Path
    name: str
    numbers: Sequence[int]

    @property
    def folder(self) -> Path:
        return self.root / self.name


def write(log: Log, path: Path, progress: Progress) -> Written:
    """The folder, or the rest of it where an earlier call was stopped. Raises DataError."""
    counts, lost = dict.fromkeys(log.streams, 0), []
    tables: dict[str, dict[str, Any]] = {}
    places = _places(log, path)
    with Journal(path) as journal:
        for name, stream in log.streams.items():
            reason = _without_place(stream)
            if reason:
                lost.append(f"{name}: {reason}")
                continue
            journal.begin(stream, progress)
            facts = [_written(stream, k, places[name], journal, progress) for k in range(len(stream))]
            bad = [f["bad"] for f in facts if "bad" in f]
            if bad:
                lost.append(f"{name}: {len(bad)} unreadable or of another kind, the first because {bad[0]}")
            counts[name] = len(facts) - len(bad)
            if counts[name]:
                _add(tables, log, stream, facts, places[name], lost)
    if not tables:
        raise DataError(f"{log.source} holds no sensor that a rig.toml has a place for; choose another format")
    texts = [
        f"[sensors.{json.dumps(name)}]\n" + "".join(f"{key} = {_toml(value)}\n" for key, value in table.items())
        for name, table in tables.items()
    ]
    (path / "rig.toml").write_text("\n".join(texts), encoding="utf-8")
    if log.reference is not None:
        write_calibration(log.reference, path / "truth.json")
    return Written(counts, tuple(lost))


def file_names(names: Iterable[str]) -> dict[str, str]:
    """What each sensor is called among files: the same as far as that can be, and no two alike."""
    files: dict[str, str] = {}
    for name in names:
        plain = re.sub(r"[^\w-]", "_", name, flags=re.ASCII) or "_"
        while plain.lower() in [f.lower() for f in files.values()]:
            plain += "_"
        files[name] = plain
    return files


def _without_place(stream: Stream) -> str:
    if not len(stream):
        return "it has no readings"
    if stream.kind not in (*KINDS, "odometry"):
        return f"a rig.toml holds no {stream.kind} that was recorded"
    if stream.kind in ("monocular", "ladybug") and stream.intrinsics is None:
        return "it has no intrinsics, which a camera in a rig.toml must have"
    return ""


def _places(log: Log, root: Path) -> dict[str, _Place]:
    """A folder for each sensor, called as it is as far as files can be, and the numbers of its readings.

    Images of one ladybug have one number where they have one stamp.
    """
    places: dict[str, _Place] = {}
    for name, file in file_names(log.streams).items():
        stream = log.streams[name]
        numbers: Sequence[int] = range(len(stream))
        if stream.kind == "ladybug":
            numbers = np.searchsorted(_stamps_of_all(log, stream), stream.stamps).tolist()
        places[name] = _Place(root, file, numbers)
    return places


def _stamps_of_all(log: Log, head: Stream) -> Array:
    """Of all heads of a ladybug, (n,)."""
    heads = [s for s in log.streams.values() if s.kind == "ladybug" and s.clock == head.clock and s.intrinsics]
    return np.asarray(np.unique(np.concatenate([head.stamps, *(s.stamps for s in heads)])))


def _written(stream: Stream, k: int, place: _Place, journal: Journal, progress: Progress) -> Fact:
    """What was noted of a reading that is written now, or was before."""
    fact = journal.known(stream, k)
    if fact is None:
        try:
            fact = _reading(stream, k, place)
        except DataError as e:
            fact = {"bad": str(e)}
        journal.note(stream, k, fact)
        progress.advance(stream.name, 1)
    return fact


def _reading(stream: Stream, k: int, place: _Place) -> Fact:
    reading = stream.readings[k]
    wanted = KINDS.get(stream.kind, PoseReading | MotionReading)
    if not isinstance(reading, wanted):
        raise DataError(f"reading {k} of {stream.name} is a {type(reading).__name__}, not what a {stream.kind} reads")
    if isinstance(reading, Scan):
        _scan(reading, place.folder / "scans", k)
        return {}
    if isinstance(reading, np.ndarray):
        _png(reading, place.folder / "images" / f"{place.numbers[k]:06d}.png", stream, k)
        return {}
    if isinstance(reading, Fix):
        angles = np.degrees([reading.lat, reading.lon, reading.roll, reading.pitch, reading.yaw]).tolist()
        stated = [reading.sigma_position, None if reading.sigma_rpy is None else np.degrees(reading.sigma_rpy)]
        row = [*angles[:2], float(reading.alt), *angles[2:]]
        return {"row": row, "more": [None if s is None else np.asarray(s, dtype=float).tolist() for s in stated]}
    if isinstance(reading, PoseReading):
        T = reading.T_world_sensor
        row = [*T[:3, 3].tolist(), *Rotation.from_matrix(T[:3, :3]).as_quat().tolist()]
        return {"row": row, "more": _upper(reading.cov)}
    assert isinstance(reading, MotionReading)
    return {"row": None if reading.vec is None else np.asarray(reading.vec).tolist(), "more": _upper(reading.cov)}


def _upper(cov: Array | None) -> list[float] | None:
    return None if cov is None else [float(cov[i, j]) for i, j, _ in COV]


def _scan(scan: Scan, folder: Path, k: int) -> None:
    """KITTI's .bin if that holds all of it, else a .npy whose columns have names."""
    folder.mkdir(parents=True, exist_ok=True)
    columns: dict[str, NDArray[Any]] = {c: scan.points[:, i] for i, c in enumerate("xyz")}
    others = {"intensity": scan.intensity, "time": scan.times, "ring": scan.ring}
    columns |= {name: values for name, values in others.items() if values is not None}
    if list(columns) == ["x", "y", "z", "intensity"]:
        np.column_stack(list(columns.values())).astype("<f4").tofile(folder / f"{k:06d}.bin")
        return
    table = np.empty(len(scan.points), [(c, "<i4" if c == "ring" else "<f4") for c in columns])
    for name, values in columns.items():
        table[name] = values
    np.save(folder / f"{k:06d}.npy", table, allow_pickle=False)


def _png(image: NDArray[Any], file: Path, stream: Stream, k: int) -> None:
    import cv2

    file.parent.mkdir(parents=True, exist_ok=True)
    if image.dtype != np.uint8 or not cv2.imwrite(str(file), image, [cv2.IMWRITE_PNG_COMPRESSION, 1]):
        raise DataError(f"reading {k} of {stream.name} is no image of 8 bits that can be written to {file.name}")


def _add(
    tables: dict[str, dict[str, Any]], log: Log, stream: Stream, facts: Sequence[Fact], place: _Place, lost: list[str]
) -> None:
    """The table of a sensor, and the files that all of its readings share."""
    kept = [k for k, f in enumerate(facts) if "bad" not in f]
    ns = log.epoch_ns + np.round(stream.stamps[kept] * 1e9).astype(np.int64)
    stamps = [f"{t // 10**9}.{t % 10**9:09d}" for t in ns.tolist()]
    place.folder.mkdir(parents=True, exist_ok=True)
    table: dict[str, Any] = {"kind": stream.kind}
    if stream.kind == "velodyne":
        _lines(place.folder / "times.txt", stamps)
        table |= {"scans": f"{place.name}/scans", "times": f"{place.name}/times.txt"}
    elif stream.kind == "gps_ins":
        table["fixes"] = _fixes(place, stamps, [facts[k] for k in kept])
    elif stream.kind == "odometry":
        motions = isinstance(stream.readings[kept[0]], MotionReading)
        table |= {"poses": _table(place, "poses.csv", AXES if motions else POSE, stamps, [facts[k] for k in kept])}
        table["format"] = "csv"
        table |= {} if stream.has_scale else {"has_scale": False}
        if "motion_sigma" in stream.options:
            table["motion_sigma"] = list(stream.options["motion_sigma"])
    else:
        lens = _lens(stream, place)
        numbered = [f"{place.numbers[k]} {t}" for k, t in zip(kept, stamps, strict=True)]
        if stream.kind == "ladybug":
            _head(tables, log, stream, {"name": stream.name, **lens}, numbered, place)
            return
        _lines(place.folder / "times.txt", numbered)
        table |= {"times": f"{place.name}/times.txt", **lens}
    others = sorted(set(stream.options) - {"motion_sigma"})
    if others:
        lost.append(f"{stream.name}: its options {', '.join(others)}, for which a rig.toml has no place")
    if any(s.clock == stream.clock for s in log.streams.values() if s is not stream):
        table["clock"] = stream.clock
    tables[stream.name] = table


def _lens(stream: Stream, place: _Place) -> dict[str, Any]:
    camera = stream.intrinsics
    assert camera is not None
    lens = {"images": f"{place.name}/images", "camera_matrix": np.asarray(camera.K, dtype=float).ravel().tolist()}
    if len(camera.distortion):
        lens["distortion"] = np.asarray(camera.distortion, dtype=float).tolist()
    if camera.mask is not None:
        _png(camera.mask, place.folder / "mask.png", stream, 0)
        lens["mask"] = f"{place.name}/mask.png"
    return lens


def _head(
    tables: dict[str, dict[str, Any]],
    log: Log,
    stream: Stream,
    lens: Mapping[str, Any],
    numbered: Sequence[str],
    place: _Place,
) -> None:
    """One head of a ladybug, whose table all heads share; its stamps join those of the others."""
    name = next((n for n, t in tables.items() if t.get("kind") == "ladybug" and t["clock"] == stream.clock), "")
    if not name:
        name = stream.clock
        while name in log.streams or name in tables:
            name += "_"
        file = f"{place.name}/times.txt"
        tables[name] = {"kind": "ladybug", "times": file, "clock": stream.clock, "heads": []}
        _lines(place.root / file, [])
    file = tables[name]["times"]
    known = (place.root / file).read_text().splitlines()
    _lines(place.root / file, sorted({*known, *numbered}, key=lambda line: int(line.split()[0])))
    tables[name]["heads"].append(dict(lens))


def _fixes(place: _Place, stamps: Sequence[str], facts: Sequence[Fact]) -> str:
    """A table of fixes, without angles where none tells an attitude; its path. A sigma of zero is one not stated."""
    alone = bool(np.isnan([f["row"][3:] for f in facts]).all())
    stated = [i for i in (0, 1) if any(f["more"][i] for f in facts) and not (alone and i)]
    titles = [*(FIX[:3] if alone else FIX), *(c for i in stated for c in SIGMAS[3 * i : 3 * i + 3])]
    rows = [[*f["row"][: 3 if alone else 6], *(x for i in stated for x in f["more"][i] or [0.0] * 3)] for f in facts]
    return _lines_of(place, "fixes.csv", titles, stamps, [_cells(row, len(titles)) for row in rows])


def _table(place: _Place, file: str, titles: Sequence[str], stamps: Sequence[str], facts: Sequence[Fact]) -> str:
    """A table of poses or motions, and of their covariances if any row has one; its path."""
    rows = [_cells(f["row"], len(titles)) for f in facts]
    more: Sequence[str] = ()
    if any(f["more"] for f in facts):
        more = [name for _, _, name in COV]
        for row, f in zip(rows, facts, strict=True):
            row += _cells(f["more"], len(COV))
    return _lines_of(place, file, [*titles, *more], stamps, rows)


def _lines_of(
    place: _Place, file: str, titles: Sequence[str], stamps: Sequence[str], rows: Sequence[Sequence[str]]
) -> str:
    lines = [",".join([t, *row]) for t, row in zip(stamps, rows, strict=True)]
    _lines(place.folder / file, [",".join(["stamp", *titles]), *lines])
    return f"{place.name}/{file}"


def _cells(values: Sequence[float] | None, count: int) -> list[str]:
    return [""] * count if values is None else [repr(x) for x in values]


def _lines(file: Path, lines: Sequence[str]) -> None:
    file.write_text("".join(f"{line}\n" for line in lines))


def _toml(value: Any) -> str:
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{k} = {_toml(v)}" for k, v in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(_toml, value)) + "]"
    return json.dumps(value) if isinstance(value, str | bool) else repr(value)
