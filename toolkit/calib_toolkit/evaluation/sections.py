"""Random parts of the drives: which, from when, and with what offsets, told by the seed alone."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from zlib import crc32

import numpy as np
from numpy.typing import NDArray

from calib_toolkit.evaluation.drives import Drive
from calib_toolkit.types import Calibration, Log, Motions, Trajectory

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Draw:
    """One repeat before it is cut. drive: which of the drives. seconds: its length. spread: how far clocks are
    moved, seconds.
    """

    drive: int
    seconds: float
    spread: float
    repeat: int


@dataclass(frozen=True)
class Section:
    """One repeat: part of a drive whose clocks were moved. start: seconds after the drive's first common instant.

    motions: the base first. truth: of these sensors, with the moved clocks; its offsets are those at its ``t_ref``,
    in the middle of the section. seed: of whatever else is drawn. log, paths: what the sensors saw and how they moved
    in that part, for experiments that look at it. wider: times the motion's sigma that a start is drawn with.
    """

    start: float
    motions: Mapping[str, Motions]
    clocks: tuple[str, ...]
    truth: Calibration
    seed: int = 0
    log: Log | None = None
    paths: Mapping[str, Motions | Trajectory] = field(default_factory=dict)
    wider: float = 1.0


def plan(
    drives: Sequence[Drive], seconds: Sequence[float], spreads: Sequence[float], repeats: int
) -> tuple[list[Draw], list[str]]:
    """Everything that is to be done, drives in turn; and a sentence on each drive that is too short for a length."""
    draws, skipped = [], []
    for length in seconds:
        lasting = [_lasting(d) for d in drives]
        enough = [k for k, lasts in enumerate(lasting) if lasts >= length]
        short = [d.name for k, d in enumerate(drives) if k not in enough]
        if short:
            skipped.append(
                f"{length:g} s: longer than {', '.join(short)} ({max(t for t in lasting if t < length):.1f} s), "
                f"{'left out there' if enough else 'left out'}"
            )
        if enough:
            draws += [Draw(enough[r % len(enough)], length, spread, r) for spread in spreads for r in range(repeats)]
    return draws, skipped


def side_by_side(drives: Sequence[Drive], seconds: float) -> int:
    """How many sections of a length the drives hold at most of which no two overlap."""
    return sum(int(_lasting(d) / seconds) for d in drives)


def cut(draw: Draw, drives: Sequence[Drive], protocol: str, seed: int) -> Section:
    """The part that a draw stands for: a function of seed, protocol, length and repeat only, scaled by the spread."""
    drive = drives[draw.drive]
    rng = np.random.default_rng([seed, crc32(protocol.encode()), round(1000 * draw.seconds), draw.repeat])
    start = rng.random() * (_lasting(drive) - draw.seconds)
    moved = draw.spread * np.array([0.0, *rng.uniform(-1, 1, len(drive.motions) - 1)])
    first = drive.span[0] + start
    parts = {
        name: m[(m.start >= first) & (m.end <= first + draw.seconds)].shifted(d)
        for (name, m), d in zip(drive.motions.items(), moved, strict=True)
    }
    told, middle = drive.truth, first + draw.seconds / 2
    dt = np.array([told.dt_at(told.base, name, middle) for name in told.names])
    truth = replace(told, dt_base_sensor=dt - moved, t_ref=middle)
    return Section(start, parts, drive.clocks, truth, int(rng.integers(2**31)))


def with_sight(section: Section, draw: Draw, drive: Drive, wider: float) -> Section:
    """A section whose clocks were not moved, with what the sensors saw."""
    first = drive.span[0] + section.start
    last = first + draw.seconds
    log = replace(drive.log, streams={n: s.between(first, last) for n, s in drive.log.streams.items()})
    paths = {n: _part(m, first, last) for n, m in (drive.paths or drive.motions).items()}
    return replace(section, log=log, paths=paths, wider=wider)


def fitting(drives: Sequence[Drive], seconds: Sequence[float]) -> tuple[tuple[float, ...], list[str]]:
    """The lengths, or where no drive lasts for one the whole seconds that all drives last; a sentence on each."""
    least, most = min(map(_lasting, drives)), max(map(_lasting, drives))
    short = [s for s in seconds if s > most]
    whole = float(np.floor(least))
    if not short or whole < 1:
        return tuple(seconds), []
    lengths = tuple(dict.fromkeys(whole if s in short else s for s in seconds))
    return lengths, [f"{s:g} s: longer than every drive; sections of {whole:g} s instead" for s in short]


def _part(moved: Motions | Trajectory, first: float, last: float) -> Motions | Trajectory:
    if isinstance(moved, Motions):
        return moved[(moved.start >= first) & (moved.end <= last)]
    there = (moved.stamps >= first) & (moved.stamps <= last)
    drift = moved.drift[there]
    drift[:1] = 0.0
    return replace(
        moved,
        stamps=moved.stamps[there],
        T_world_sensor=moved.T_world_sensor[there],
        cov=moved.cov[there],
        drift=drift,
    )


def _lasting(drive: Drive) -> float:
    first, last = drive.span
    return last - first
