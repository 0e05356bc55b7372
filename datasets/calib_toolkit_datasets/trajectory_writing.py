"""A log as trajectories in TUM's format: one file for each sensor that tells where it was."""

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from calib_toolkit import Fix, Log, MotionReading, PoseReading, Progress, Stream, Written, se3
from calib_toolkit.errors import DataError
from calib_toolkit_datasets.rig_writing import file_names
from calib_toolkit_datasets.simulation.earth import ecef, enu_axes

Array = NDArray[np.float64]

Reading = Fix | PoseReading | MotionReading
KINDS = ("odometry", "gps_ins")


def write(log: Log, path: Path, progress: Progress) -> Written:
    """A folder of files ``NAME.txt``, rows of ``stamp x y z qx qy qz qw``. Raises DataError.

    Poses of a GPS/INS are east, north and up of its first fix. Motions are added up from the first one; after a step
    that failed nothing is known of where it went, so what follows is in a file of its own, ``NAME-2.txt``.
    """
    counts, lost = dict.fromkeys(log.streams, 0), []
    path.mkdir()
    for name, file in file_names(log.streams).items():
        stream = log.streams[name]
        if stream.kind not in KINDS:
            lost.append(f"{name}: {len(stream)} readings of a {stream.kind}, which is no trajectory")
            continue
        progress.begin(name, len(stream))
        read, bad = _readings(stream, progress)
        lost += [f"{name}: {len(bad)} unreadable, the first because {bad[0]}"] if bad else []
        if any(isinstance(r, MotionReading) for _, r in read) and not stream.has_scale:
            lost.append(f"{name}: {len(read)} motions without scale, which tell no trajectory")
            continue
        if any(isinstance(r, Fix) and np.isnan(r.yaw) for _, r in read):
            lost.append(f"{name}: {len(read)} positions without attitude, which are no poses")
            continue
        pieces = list(_pieces(read))
        for i, piece in enumerate(pieces):
            rows = _rows(log, stream, piece)
            (path / (f"{file}-{i + 1}.txt" if i else f"{file}.txt")).write_text(rows)
            counts[name] += len(piece)
        lost += _lost(stream, [r for _, r in read], len(pieces))
    if not any(counts.values()):
        raise DataError(f"{log.source} holds no sensor that tells a trajectory; choose another format")
    return Written(counts, tuple(lost))


def _readings(stream: Stream, progress: Progress) -> tuple[list[tuple[int, Reading]], list[str]]:
    """Those that can be read, with their rows, and why others can not."""
    read: list[tuple[int, Reading]] = []
    bad = []
    for k in range(len(stream)):
        try:
            reading = stream.readings[k]
            if not isinstance(reading, Fix | PoseReading | MotionReading):
                raise DataError(f"reading {k} of {stream.name} is a {type(reading).__name__}, which is no pose")
            read.append((k, reading))
        except DataError as e:
            bad.append(str(e))
        progress.advance(stream.name, 1)
    return read, bad


def _pieces(read: Sequence[tuple[int, Reading]]) -> Iterable[list[tuple[int, Array]]]:
    """Poses (4, 4) with their rows, in pieces within which one world holds."""
    fixes = [r for _, r in read if isinstance(r, Fix)]
    first = _place(fixes[0]) if fixes else np.zeros(3)
    T_world_earth = se3.invert(se3.rigid(enu_axes(first), ecef(first)))
    piece: list[tuple[int, Array]] = []
    for k, reading in read:
        if isinstance(reading, Fix):
            piece.append((k, T_world_earth @ _on_earth(reading)))
        elif isinstance(reading, PoseReading):
            piece.append((k, reading.T_world_sensor))
        elif isinstance(reading, MotionReading):
            if piece and piece[-1][0] == k - 1 and reading.vec is not None:
                piece.append((k, piece[-1][1] @ se3.matrix(reading.vec)))
                continue
            if piece:
                yield piece
            piece = [(k, np.eye(4))]
    if piece:
        yield piece


def _place(fix: Fix) -> Array:
    return np.array([fix.lat, fix.lon, fix.alt])


def _on_earth(fix: Fix) -> Array:
    """``T_ecef_sensor`` (4, 4)."""
    R_enu_sensor = Rotation.from_euler("ZYX", [fix.yaw, fix.pitch, fix.roll]).as_matrix()
    return se3.rigid(enu_axes(_place(fix)) @ R_enu_sensor, ecef(_place(fix)))


def _rows(log: Log, stream: Stream, piece: Sequence[tuple[int, Array]]) -> str:
    ns = log.epoch_ns + np.round(stream.stamps[[k for k, _ in piece]] * 1e9).astype(np.int64)
    T = np.array([pose for _, pose in piece])
    numbers = np.hstack([T[:, :3, 3], Rotation.from_matrix(T[:, :3, :3]).as_quat()])
    lines = [
        f"{t // 10**9}.{t % 10**9:09d} {' '.join(map(repr, row))}\n"
        for t, row in zip(ns.tolist(), numbers.tolist(), strict=True)
    ]
    return "# stamp x y z qx qy qz qw\n" + "".join(lines)


def _lost(stream: Stream, readings: Sequence[Reading], pieces: int) -> Iterable[str]:
    if any(isinstance(r, Fix) and (r.sigma_position is not None or r.sigma_rpy is not None) for r in readings):
        yield f"{stream.name}: the sigmas of its fixes, for which TUM's format has no place"
    if any(isinstance(r, Fix) for r in readings):
        yield f"{stream.name}: where on earth it was; positions are east, north and up of the first"
    if any(getattr(r, "cov", None) is not None for r in readings):
        yield f"{stream.name}: its covariances, for which TUM's format has no place"
    if not stream.has_scale:
        yield f"{stream.name}: that its lengths mean nothing (has_scale = false in a rig.toml)"
    if pieces > 1:
        yield f"{stream.name}: {pieces - 1} steps that failed; what follows each is in a file of its own"
