"""The recordings of an experiment: how each sensor moved, and the truth to compare with."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import permutations
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calib_toolkit.cache import default_folder
from calib_toolkit.config import Config
from calib_toolkit.errors import DataError
from calib_toolkit.hookspecs import CostMetric
from calib_toolkit.pipeline import open_log, sensor_motions
from calib_toolkit.plugins import registry
from calib_toolkit.progress import Progress
from calib_toolkit.types import Calibration, Log, Motions, Trajectory

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Drive:
    """One recording. motions: of the sensors compared, the base first. clocks: (n,) sensors that name the same clock
    share it. truth: of these sensors, in that order. notes: sentences on readings that were left out. paths: the
    motions as the sensors told them, where some tell poses.
    """

    name: str
    log: Log
    motions: Mapping[str, Motions]
    clocks: tuple[str, ...]
    truth: Calibration
    notes: tuple[str, ...] = ()
    paths: Mapping[str, Motions | Trajectory] = field(default_factory=dict)

    @property
    def span(self) -> tuple[float, float]:
        """First and last instant that all sensors cover, seconds."""
        return max(m.start.min() for m in self.motions.values()), min(m.end.max() for m in self.motions.values())


def open_drives(
    paths: Sequence[Path],
    choose: Callable[[Log], list[str]],
    truth: Calibration | None,
    check: Callable[[Mapping[str, Calibration]], None],
    config: Config,
    progress: Progress,
) -> list[Drive]:
    """The recordings at the paths. choose: which sensors of a recording are compared. truth: of all recordings, or
    None for what came with each. check: raises if these recordings' truths, by name, can not be compared with; it
    is asked before anything is estimated. Raises DataError.
    """
    plugins = registry()
    logs, truths = {}, {}
    for path, name in zip(paths, _labels(paths), strict=True):
        log = open_log(path, plugins=plugins)
        logs[name] = log = log.select(_base_first(log.select(choose(log))))
        there = truth or log.reference
        if there is None:
            raise DataError(
                f"{path} comes without a truth to compare with; give one with --truth FILE, in the form of a "
                "calibration.json"
            )
        truths[name] = rebased(there, tuple(log.streams), str(path))
    check(truths)
    drives = []
    for name, log in logs.items():
        moved = sensor_motions(log, config, plugins, progress, default_folder())
        motions = {n: moved[n].motions for n in log.streams}
        clocks = tuple(s.clock for s in log.streams.values())
        notes = (*log.notes, *(note for n, s in log.streams.items() for note in (*s.notes, *moved[n].notes)))
        whole = {n: moved[n].motion for n in log.streams}
        drives.append(Drive(name, log, motions, clocks, truths[name], notes, whole))
    return drives


def cameras(log: Log) -> list[str]:
    """The sensors that know no distances. Raises DataError if they are fewer than two."""
    found = [s.name for s in log.streams.values() if not s.has_scale]
    if len(found) < 2:
        raise DataError(
            f"{log.source} has {len(found) or 'no'} camera{'s' * (len(found) > 1)}, where this experiment compares "
            "at least two; name the sensors to compare with --sensors"
        )
    return found


def first_two(log: Log) -> list[str]:
    """The first two sensors that measure distances. Raises DataError if there are none."""
    found = [s.name for s in log.streams.values() if s.has_scale]
    if len(found) < 2:
        raise DataError(
            f"{log.source} has no two sensors that measure distances; name the two to compare with --sensors"
        )
    return found[:2]


def everyone(log: Log) -> list[str]:
    """All sensors of the recording. Raises DataError if no installed metric takes two of them."""
    metrics = registry().metrics.values()
    if not any(m.accepts(a.kind, b.kind) for a, b in permutations(log.streams.values(), 2) for m in metrics):
        raise DataError(
            f"{log.source} has no two sensors that an installed appearance metric compares (it has: {_kinds(log)}); "
            "use 'pair' or 'panoramic', which look at motion alone"
        )
    return list(log.streams)


def lidar_and_camera(log: Log) -> list[str]:
    """The first two sensors that a searched metric takes. Raises DataError if there are none."""
    metrics = [m for m in registry().metrics.values() if isinstance(m, CostMetric)]
    for a, b in permutations(log.streams.values(), 2):
        if a.has_scale and not b.has_scale and any(m.accepts(a.kind, b.kind) for m in metrics):
            return [a.name, b.name]
    raise DataError(
        f"{log.source} has no lidar and camera that an installed appearance metric compares (it has: {_kinds(log)}); "
        "name two with --sensors"
    )


def rebased(truth: Calibration, names: Sequence[str], source: str) -> Calibration:
    """The truth of the named sensors, in the first one's frame and clock; what that leaves open is not determined.

    Raises DataError if it does not hold one of them.
    """
    for name in names:
        if name not in truth.names:
            raise DataError(
                f"the truth of {source} holds nothing on sensor '{name}', only on {', '.join(truth.names)}; leave "
                "the sensor out with --sensors, or give another truth with --truth"
            )
    rows = [truth.index(n) for n in names]
    known = truth.determined[rows].copy()
    placed, turned = (np.asarray(known[:, part].all(axis=1)) for part in (slice(3), slice(3, 6)))
    known[:, :3] = (placed & placed[0] & turned[0])[:, None]
    known[:, 3:6] = (turned & turned[0])[:, None]
    known[:, 6] &= known[0, 6]
    dt = truth.dt_base_sensor[rows]
    n = len(rows)
    return replace(
        truth,
        base=names[0],
        names=tuple(names),
        T_base_sensor=np.array([truth.between(names[0], name).T_a_b for name in names]),
        dt_base_sensor=dt - dt[0],
        covariance=np.zeros((7 * n, 7 * n)),
        has_scale=truth.has_scale[rows],
        determined=known,
        undetermined=(),
        clock_skew=truth.clock_skew[rows] - truth.clock_skew[rows[0]],
    )


def _kinds(log: Log) -> str:
    return "; ".join(f"{s.name}, {s.kind}" for s in log.streams.values())


def _base_first(log: Log) -> list[str]:
    """The first that has scale before the others, as the pipeline would take it."""
    scaled = [s.name for s in log.streams.values() if s.has_scale]
    first = (scaled or list(log.streams))[0]
    return [first, *(n for n in log.streams if n != first)]


def _labels(paths: Sequence[Path]) -> list[str]:
    """What each recording is called in tables: its folder's name, or the whole path where two are named alike."""
    names = [p.resolve().name for p in paths]
    labels = [name if names.count(name) == 1 else str(path) for path, name in zip(paths, names, strict=True)]
    if len(set(labels)) < len(labels):
        raise DataError(f"{labels[-1]} is named twice; name each recording once")
    return labels
