"""The four hooks through which everything that is not the core arrives, and what each must return.

A plugin is a module (or one file) with functions marked ``@hookimpl``; built-ins and a stranger's are
registered alike, under the entry-point group ``calib_toolkit``. docs/write-a-plugin walks through one.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from math import radians
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import pluggy
from numpy.typing import NDArray

from calib_toolkit.progress import Progress
from calib_toolkit.types import (
    Calibration,
    CameraIntrinsics,
    Log,
    Motions,
    Pair,
    PairEstimate,
    Stream,
    Trajectory,
    Transform,
)

hookspec = pluggy.HookspecMarker("calib_toolkit")
hookimpl = pluggy.HookimplMarker("calib_toolkit")


@dataclass(frozen=True)
class NoOptions:
    """For a sensor or metric without options."""


@dataclass(frozen=True)
class SensorTable:
    """One ``[sensors.NAME]`` table of a rig.toml. folder: where its relative paths start."""

    name: str
    folder: Path
    values: Mapping[str, Any]


@dataclass(frozen=True)
class Sensor:
    """A type of sensor: how its readings become motion with covariance.

    id: what ``Stream.kind`` says. estimate: from a stream of at least two readings and an instance of
    ``options`` (a frozen dataclass, every field defaulted) to the motion between its readings. It is called
    on slices of ``chunk`` steps that share one reading, in any order and in parallel; it must be
    deterministic and leave its inputs alone.
    open_table: how a ``[sensors.NAME]`` table of a rig.toml becomes streams, or None if it can not.
    version: raise it when the answers change, so that cached motions are made anew.
    """

    id: str
    estimate: Callable[[Stream, Any], Motions | Trajectory]
    options: type = NoOptions
    open_table: Callable[[SensorTable], Log] | None = None
    version: str = "1"
    chunk: int = 50


class Metric(Protocol):
    """A measure of how well two sensors' appearance agrees. ``options`` is a frozen dataclass type.

    What it finds is kept in a cache. It may have a ``version``, to be raised when the answers change.
    """

    id: str
    options: type

    def accepts(self, kind_a: str, kind_b: str) -> bool:
        """Whether it can compare these kinds of sensors, in this order."""
        ...

    def overlap(self, pair: Pair) -> bool:
        """Whether the two see enough of the same place to compare."""
        ...

    def estimate(self, pair: Pair, options: Any) -> PairEstimate:
        """``T_a_b`` with covariance from appearance alone (the motion prior divided out)."""
        ...


class CostMetric(ABC):
    """A metric that only says how bad a pose is at one moment; the core searches for the best over all of them.

    ``accepts`` and ``cost`` are enough. The others make it faster: what does not depend on the pose is done once in
    ``prepare``, and ``costs`` may take many poses at a time. Raise ``version`` when the answers change.
    """

    id: str
    options: type = NoOptions
    version: str = "1"
    own: tuple[float, ...] = (0.015,) * 3 + (radians(0.03),) * 3
    """(6,) of ``(dt, delta)``, metres and radians, axes of a: by so much (sigma) its best pose is off on any drive,
    for beams have a width and pictures an exposure. It is part of every covariance."""

    @abstractmethod
    def accepts(self, kind_a: str, kind_b: str) -> bool:
        """Whether it can compare these kinds of sensors, in this order."""

    @abstractmethod
    def cost(self, T_a_b: NDArray[np.float64], pair: Any) -> float:
        """Lower is better; on average over moments, where lengths of drive do not matter. T_a_b: (4, 4).

        pair: what ``focus`` returned; unless overridden, the Pair with one row selected.
        """

    def overlap(self, pair: Pair) -> bool:
        """Whether the two see enough of the same place to compare (by default: assume so)."""
        return len(pair.selected) > 0

    def prepare(self, pair: Pair, options: Any) -> Any:
        """One moment, of which one row is selected, made ready; None if it has nothing to compare."""
        return pair

    def focus(self, moment: Any, around: Transform, blur: float) -> Any:
        """The moment for poses about as far from ``around`` as its covariance says.

        blur: how many times smoother than in the end the picture may be, so that the search sees further.
        """
        return moment

    # to override at will, so not abstract
    def draw(self, pair: Pair, poses: Mapping[str, NDArray[np.float64]], folder: Path) -> None:  # noqa: B027
        """Pictures in a folder by which a person can judge poses (4, 4), by name; nothing unless overridden."""

    def costs(self, T_a_b: NDArray[np.float64], moment: Any) -> NDArray[np.float64]:
        """(k,) of many poses (k, 4, 4)."""
        return np.array([self.cost(T, moment) for T in T_a_b])


@dataclass(frozen=True)
class ReadContext:
    """What a reader may ask of the core.

    sensors: the installed sensor types by id. open_log: opens another recording, by any reader.
    options: the reader's own options.
    """

    sensors: Mapping[str, Sensor]
    open_log: Callable[[Path], Log]
    options: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Written:
    """What a conversion wrote. readings: number by sensor. lost: a sentence for whatever was not written, and why.

    inside: the recording's path in what was written, if it is not the whole.
    """

    readings: Mapping[str, int]
    lost: tuple[str, ...] = ()
    inside: str = ""


@dataclass(frozen=True)
class Dataset:
    """A format of recordings.

    matches: whether a path looks like this format (cheap; never raises). looks_for: what it looks for, in
    words, for the sentence when no reader knows a path. open: a Log whose readings stay on disk.
    write: makes such a recording of a log at a path where nothing is yet, reading by reading, and tells ``progress``
    of each; the caller moves it to where it belongs once it is whole. Raises DataError.
    last: whether it is only asked where no other reader knows a path, since what it looks for is in others, too.
    resumes: whether ``write`` goes on where an earlier call with the same log was stopped.
    """

    id: str
    looks_for: str
    matches: Callable[[Path], bool]
    open: Callable[[Path, ReadContext], Log]
    write: Callable[[Log, Path, Progress], Written] | None = None
    last: bool = False
    resumes: bool = False


@dataclass(frozen=True)
class Exporter:
    """A format of calibrations, out and back in.

    write: at a path where nothing is yet, a file or a folder, and beside it what the format has no place for; with
    the intrinsics, by sensor, of the cameras whose intrinsics are known. Raises DataError for a rig or a name that
    the format can not hold. read: what ``write`` wrote, or another program; covariance zero where the format has
    none, and ``determined`` only what it says. Raises DataError.
    matches: whether a path looks like this format (cheap; never raises). looks_for: what it looks for, in words.
    loses: what it does not keep, in words. holds_unknown: whether ``write`` can say that a number is not determined;
    else it is never given a pose that is not.
    """

    id: str
    write: Callable[[Calibration, Path, Mapping[str, CameraIntrinsics]], None]
    read: Callable[[Path], Calibration]
    looks_for: str = ""
    matches: Callable[[Path], bool] = lambda path: False
    loses: str = ""
    holds_unknown: bool = False


class HookSpecs:
    """Each hook returns a list, does no work, and is called once, when the registry is built."""

    @hookspec
    def calib_register_sensors(self) -> Sequence[Sensor]:
        """Sensor types: how readings become motion with covariance."""
        return []

    @hookspec
    def calib_register_metrics(self) -> Sequence[Metric | CostMetric]:
        """Appearance metrics: how well two sensors that see the same place agree."""
        return []

    @hookspec
    def calib_register_datasets(self) -> Sequence[Dataset]:
        """Readers of recordings."""
        return []

    @hookspec
    def calib_register_exporters(self) -> Sequence[Exporter]:
        """Writers and readers of calibrations in other tools' formats."""
        return []
