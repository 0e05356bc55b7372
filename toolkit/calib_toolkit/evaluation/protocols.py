"""The experiments of section VIII: which sensors each compares, over which lengths, and what one repeat yields."""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import combinations
from typing import Literal

from calib_toolkit.config import Config
from calib_toolkit.errors import ConfigError, DataError
from calib_toolkit.evaluation import baselines, drives, measures
from calib_toolkit.evaluation.errors import EULER, POSITION, Finding
from calib_toolkit.evaluation.sections import Section
from calib_toolkit.types import Log

AFTER_METRICS = {"appearance": "Fig. 10 and Table I", "full": "Fig. 12 and Table II"}
"""Experiments that need the images and scans themselves, and where the paper shows them."""


@dataclass(frozen=True)
class Protocol:
    """One experiment.

    seconds: lengths of the sections. spreads: how far clocks are moved, seconds. parameters: whose errors are told;
    short: which of them in the short table. needs: what of the truth it can not do without.
    choose: the sensors of a recording that are compared. estimators: what is told apart, by method and whether
    baselines are wanted. labels: what is told of one estimator, by the sensors' names.
    measure: all rows of one repeat.
    """

    title: str
    seconds: tuple[float, ...]
    spreads: tuple[float, ...]
    parameters: tuple[str, ...]
    short: tuple[str, ...]
    needs: Literal["clocks", "rotations"]
    choose: Callable[[Log], list[str]]
    estimators: Callable[[str, bool], list[str]]
    labels: Callable[[tuple[str, ...]], list[str]]
    measure: Callable[[Section, Config, list[str]], list[Finding]]


def protocol(name: str) -> Protocol:
    """The experiment of that name. Raises ConfigError for one whose metrics nothing installed brings."""
    if name in AFTER_METRICS:
        raise ConfigError(
            f"'{name}' ({AFTER_METRICS[name]} of the paper) compares what the sensors see, which takes appearance "
            f"metrics, and no installed plugin brings one; run one of: {', '.join(PROTOCOLS)}"
        )
    return PROTOCOLS[name]


def _every_other(names: tuple[str, ...]) -> list[str]:
    return list(names[1:])


def _only_pair(names: tuple[str, ...]) -> list[str]:
    if len(names) != 2:
        raise DataError(f"'pair' compares two sensors, and these are {', '.join(names)}; name two with --sensors")
    return ["-".join(names)]


def _all_pairs(names: tuple[str, ...]) -> list[str]:
    return [f"{a}-{b}" for a, b in combinations(names, 2)]


def _timing_estimators(method: str, baseline: bool) -> list[str]:
    if baseline:
        raise ConfigError("--baseline does not go with 'timing': hand-eye calibration finds no clock offsets")
    return [method]


def _pair_estimators(method: str, baseline: bool) -> list[str]:
    hand_eye = baseline and baselines.opencv_has_hand_eye()
    return [method, measures.LEAST_SQUARES, *(baselines.OPENCV_METHODS if hand_eye else ())]


def _panoramic_estimators(method: str, baseline: bool) -> list[str]:
    return [f"{method}-together", f"{method}-separate", *([measures.LEAST_SQUARES] if baseline else [])]


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
        estimators=_timing_estimators,
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
        estimators=_pair_estimators,
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
        estimators=_panoramic_estimators,
        labels=_all_pairs,
        measure=measures.measure_panoramic,
    ),
}
