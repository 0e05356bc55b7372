"""The experiments of section VIII: which sensors each compares, over which lengths, and what one repeat yields."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Literal

from calib_toolkit.config import Config
from calib_toolkit.errors import ConfigError, DataError
from calib_toolkit.evaluation import baselines, drives, measures, sights
from calib_toolkit.evaluation.errors import EULER, POSITION, Finding
from calib_toolkit.evaluation.sections import Section
from calib_toolkit.types import Log


@dataclass(frozen=True)
class Protocol:
    """One experiment.

    seconds: lengths of the sections. spreads: how far clocks are moved, seconds. parameters: whose errors are told;
    short: which of them in the short table. needs: what of the truth it can not do without.
    choose: the sensors of a recording that are compared. ways: in which each method is used, as its name's ending.
    baselines: what runs beside them, by whether more than the paper has is wanted. labels: what is told of one
    estimator, by the sensors' names. measure: all rows of one repeat, by the methods' configurations and baselines.
    sees: whether it looks at scans and images. by_metric: whether metrics are compared, and not methods.
    """

    title: str
    seconds: tuple[float, ...]
    spreads: tuple[float, ...]
    parameters: tuple[str, ...]
    short: tuple[str, ...]
    needs: Literal["clocks", "rotations", "poses"]
    choose: Callable[[Log], list[str]]
    ways: tuple[str, ...]
    baselines: Callable[[bool], list[str]]
    labels: Callable[[tuple[str, ...]], list[str]]
    measure: Callable[[Section, Sequence[Config], Sequence[str]], list[Finding]]
    sees: bool = False
    by_metric: bool = False

    def estimators(self, methods: Sequence[str], baseline: bool, metrics: Sequence[str] = ()) -> list[str]:
        """All that are told apart, in the order of the rows. Raises ConfigError for what does not go together."""
        if self.by_metric:
            self.baselines(baseline)
            return [sights.INITIAL, *(f"{metric}{way}" for metric in metrics for way in self.ways)]
        return [*(f"{method}{way}" for method in methods for way in self.ways), *self.baselines(baseline)]


def protocol(name: str) -> Protocol:
    """The experiment of that name."""
    return PROTOCOLS[name]


def _every_other(names: tuple[str, ...]) -> list[str]:
    return list(names[1:])


def _only_pair(names: tuple[str, ...]) -> list[str]:
    if len(names) != 2:
        raise DataError(f"'pair' compares two sensors, and these are {', '.join(names)}; name two with --sensors")
    return ["-".join(names)]


def _lidar_camera(names: tuple[str, ...]) -> list[str]:
    if len(names) != 2:
        raise DataError(
            f"'appearance' compares a lidar and a camera, and these are {', '.join(names)}; name two with --sensors"
        )
    return ["-".join(names)]


def _all_pairs(names: tuple[str, ...]) -> list[str]:
    return [f"{a}-{b}" for a, b in combinations(names, 2)]


def _none(baseline: bool) -> list[str]:
    if baseline:
        raise ConfigError("--baseline does not go with 'timing': hand-eye calibration finds no clock offsets")
    return []


def _not_seeing(baseline: bool) -> list[str]:
    if baseline:
        raise ConfigError("--baseline does not go with 'appearance' or 'full': hand-eye calibration sees nothing")
    return []


def _hand_eye(baseline: bool) -> list[str]:
    wanted = baseline and baselines.opencv_has_hand_eye()
    return [baselines.LEAST_SQUARES, *(baselines.OPENCV_METHODS if wanted else ())]


def _least_squares(baseline: bool) -> list[str]:
    return [baselines.LEAST_SQUARES] if baseline else []


def _tens(last: int) -> tuple[float, ...]:
    return tuple(float(s) for s in range(10, last + 1, 10))


PROTOCOLS = {
    "timing": Protocol(
        "Clock offsets (Fig. 6)",
        seconds=_tens(200),
        spreads=(0.1, 1.0),
        parameters=("dt",),
        short=("dt",),
        needs="clocks",
        choose=drives.cameras,
        ways=("",),
        baselines=_none,
        labels=_every_other,
        measure=measures.measure_timing,
    ),
    "pair": Protocol(
        "Two sensors (Fig. 7)",
        seconds=_tens(300),
        spreads=(0.0,),
        parameters=("rotation", "translation", *EULER, *POSITION, "dt"),
        short=("rotation", "translation"),
        needs="rotations",
        choose=drives.first_two,
        ways=("",),
        baselines=_hand_eye,
        labels=_only_pair,
        measure=measures.measure_pair,
    ),
    "panoramic": Protocol(
        "Rotations of a panoramic rig of cameras (Fig. 8)",
        seconds=(30.0,),
        spreads=(0.0,),
        parameters=("rotation", *EULER),
        short=("rotation",),
        needs="rotations",
        choose=drives.cameras,
        ways=(measures.TOGETHER, measures.SEPARATE),
        baselines=_least_squares,
        labels=_all_pairs,
        measure=measures.measure_panoramic,
    ),
    "appearance": Protocol(
        "Appearance of a lidar and a camera (Fig. 10, Table I)",
        seconds=(100.0,),
        spreads=(0.0,),
        parameters=("rotation", "translation", *EULER, *POSITION),
        short=(),
        needs="poses",
        choose=drives.lidar_and_camera,
        ways=sights.WAYS,
        baselines=_not_seeing,
        labels=_lidar_camera,
        measure=sights.measure_appearance,
        sees=True,
        by_metric=True,
    ),
    "full": Protocol(
        "All sensors by motion and appearance (Fig. 12, Table II)",
        seconds=(100.0,),
        spreads=(0.0,),
        parameters=("rotation", "translation", *EULER, *POSITION, "dt"),
        short=(),
        needs="rotations",
        choose=drives.everyone,
        ways=(sights.MOTION, sights.COMBINED),
        baselines=_not_seeing,
        labels=_every_other,
        measure=sights.measure_full,
        sees=True,
    ),
}
