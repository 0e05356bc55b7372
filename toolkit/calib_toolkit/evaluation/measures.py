"""One repeat of each experiment of section VIII: what was found, against the truth."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from calib_toolkit import se3, sync
from calib_toolkit.config import Config
from calib_toolkit.errors import CalibrationError, NotObservableError
from calib_toolkit.evaluation import baselines
from calib_toolkit.evaluation.errors import (
    DELTA,
    EULER,
    FAILURES,
    POSITION,
    Finding,
    refusal,
    rotation_error,
    rotation_sigma,
)
from calib_toolkit.evaluation.sections import Section
from calib_toolkit.pipeline import calibrate_motions, clock_offsets
from calib_toolkit.types import Calibration, Motions

Array = NDArray[np.float64]

FORWARD_LEFT_UP = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""Turns a camera's axes (right, down, ahead) into a vehicle's, so that roll is about the optical axis."""
TOGETHER, SEPARATE = "-together", "-separate"
"""Endings of a method's name: all cameras at once, and each with the first."""


@dataclass(frozen=True)
class Turn:
    """One camera in the first's axes. R: (3, 3). known: whether determined. refused: the sentence, if it was."""

    R: Array
    known: bool = True
    refused: str = ""


@dataclass(frozen=True)
class Part:
    """Some sensors of a section, and what a method makes of them: a calibration, or the sentence that refuses.

    at: the instant of the base's clock for which offsets are told.
    """

    motions: Mapping[str, Motions]
    clocks: tuple[str, ...]
    config: Config
    at: float
    calibration: Calibration | None
    refused: str = ""


def measure_timing(section: Section, configs: Sequence[Config], others: Sequence[str]) -> list[Finding]:
    """Clock offsets of all sensors to the first, each on a clock of its own (section VIII-C), by each method."""
    findings = []
    for config in configs:
        try:
            findings += _found_times(config.method, clock_offsets(section.motions, config), section.truth)
        except FAILURES as e:
            findings += [Finding(config.method, n, refused=refusal(e)) for n in list(section.motions)[1:]]
    return findings


def measure_pair(section: Section, configs: Sequence[Config], others: Sequence[str]) -> list[Finding]:
    """Where the second sensor sits in the first one's frame (section VIII-D), by each method and baseline."""
    label, truth = "-".join(section.motions), section.truth
    parts = [_part(section, list(section.motions), config) for config in configs]
    return [
        *(_found_pair(part, label, truth) for part in parts),
        *(_found_beside(other, parts[0], label, truth) for other in others),
    ]


def measure_panoramic(section: Section, configs: Sequence[Config], others: Sequence[str]) -> list[Finding]:
    """Rotations between every two cameras: all estimated at once, and each with the first only (section VIII-E)."""
    names, truth, first = list(section.motions), section.truth, Turn(np.eye(3))
    findings = []
    pairs = [[_part(section, [names[0], other], config) for other in names[1:]] for config in configs]
    for config, apart in zip(configs, pairs, strict=True):
        everyone = _part(section, names, config)
        turns = [_turn(everyone, k) for k in range(len(names))]
        findings += _found_turns(f"{config.method}{TOGETHER}", names, turns, truth, everyone.calibration)
        findings += _found_turns(f"{config.method}{SEPARATE}", names, [first, *(_turn(p, 1) for p in apart)], truth)
    for other in others:
        findings += _found_turns(other, names, [first, *map(_plain_turn, pairs[0])], truth)
    return findings


def _part(section: Section, names: list[str], config: Config) -> Part:
    clocks = tuple(c for n, c in zip(section.motions, section.clocks, strict=True) if n in names)
    motions = {n: section.motions[n] for n in names}
    at = section.truth.t_ref
    try:
        return Part(motions, clocks, config, at, calibrate_motions(motions, config, clocks).calibration)
    except FAILURES as e:
        return Part(motions, clocks, config, at, None, refusal(e))


def _turn(part: Part, k: int) -> Turn:
    c = part.calibration
    if c is None:
        return Turn(np.eye(3), refused=part.refused)
    return Turn(c.T_base_sensor[k, :3, :3], bool(c.determined[k, 3:6].all()))


def _plain_turn(pair: Part) -> Turn:
    try:
        return Turn(baselines.kabsch(*_steps(pair).vec[..., 3:]))
    except FAILURES as e:
        return Turn(np.eye(3), refused=refusal(e))


def _found_times(method: str, c: Calibration, truth: Calibration) -> list[Finding]:
    findings = []
    for i, name in enumerate(truth.names[1:], start=1):
        if not c.determined[i, 6]:
            findings.append(Finding(method, name, undetermined=("dt",)))
            continue
        error = {"dt": _dt(c, i, truth)} if truth.determined[i, 6] else {}
        findings.append(Finding(method, name, error, {"dt": 1e3 * float(c.sigma[i, 6])}))
    return findings


def _found_pair(part: Part, label: str, truth: Calibration) -> Finding:
    method, c = part.config.method, part.calibration
    return Finding(method, label, refused=part.refused) if c is None else found_pose(method, label, c, 1, truth)


def found_pose(estimator: str, label: str, c: Calibration, i: int, truth: Calibration) -> Finding:
    """Where a calibration puts its sensor i, against the truth of the same sensors."""
    known = c.determined[i]
    unknown = {k for k, yes in zip((*POSITION, *DELTA, "dt"), known, strict=True) if not yes}
    unknown |= {e for e, d in zip(EULER, DELTA, strict=True) if d in unknown}
    unknown |= {"rotation"} if not known[3:6].all() else set()
    unknown |= {"translation"} if not known[:3].all() else set()
    error = _rotation(c.T_base_sensor[i], truth.T_base_sensor[i]) | _position(c.T_base_sensor[i], truth, i)
    if truth.determined[i, 6]:
        error["dt"] = _dt(c, i, truth)
    cov = c.covariance[7 * i : 7 * i + 7, 7 * i : 7 * i + 7]
    sigma = rotation_sigma(cov[3:6, 3:6])
    sigma |= dict(zip((*POSITION, "dt"), np.sqrt(np.diag(cov)[[0, 1, 2, 6]]) * [1, 1, 1, 1e3], strict=True))
    return Finding(
        estimator,
        label,
        {k: e for k, e in error.items() if k not in unknown},
        {k: s for k, s in sigma.items() if k not in unknown},
        tuple(sorted(unknown)),
    )


def _found_beside(other: str, part: Part, label: str, truth: Calibration) -> Finding:
    """What a baseline makes of the same sensors, on the clock offsets that a method found."""
    try:
        steps, plain = _steps(part), other == baselines.LEAST_SQUARES
        T = baselines.least_squares(steps) if plain else baselines.opencv_hand_eye(steps, other)
    except FAILURES as e:
        return Finding(other, label, refused=refusal(e))
    error = _rotation(T, truth.T_base_sensor[1]) | _position(T, truth, 1)
    return Finding(other, label, {k: e for k, e in error.items() if np.isfinite(e)})


def _found_turns(
    estimator: str, names: list[str], turns: list[Turn], truth: Calibration, stated: Calibration | None = None
) -> list[Finding]:
    """One finding for every two cameras, in the first camera's axes. stated: the calibration that states sigmas."""
    findings = []
    for (x, a), (y, b) in combinations(enumerate(names), 2):
        label = f"{a}-{b}"
        if refused := turns[x].refused or turns[y].refused:
            findings.append(Finding(estimator, label, refused=refused))
            continue
        if not (turns[x].known and turns[y].known):
            findings.append(Finding(estimator, label, undetermined=(*EULER, "rotation", *DELTA)))
            continue
        R_true = truth.T_base_sensor[[x, y], :3, :3]
        to_first = FORWARD_LEFT_UP @ R_true[0]
        error = to_first @ (R_true[0].T @ R_true[1] @ (turns[x].R.T @ turns[y].R).T) @ to_first.T
        cov = None if stated is None else se3.rotate_cov(to_first, stated.between(a, b).cov[3:, 3:])
        findings.append(Finding(estimator, label, rotation_error(error), {} if cov is None else rotation_sigma(cov)))
    return findings


def _rotation(T: Array, T_true: Array) -> dict[str, float]:
    return rotation_error(T_true[:3, :3] @ T[:3, :3].T)


def _position(T: Array, truth: Calibration, i: int) -> dict[str, float]:
    if not truth.determined[i, :3].all():
        return {}
    shift = T[:3, 3] - truth.T_base_sensor[i, :3, 3]
    return {**dict(zip(POSITION, map(float, shift), strict=True)), "translation": float(np.linalg.norm(shift))}


def _dt(c: Calibration, i: int, truth: Calibration) -> float:
    """Milliseconds by which an offset is wrong in the middle of the section."""
    return 1e3 * float(c.dt_at(c.base, c.names[i], truth.t_ref) - truth.dt_base_sensor[i])


def _steps(part: Part) -> sync.Steps:
    """Common steps on the offsets that the method found; where it refused to go on, on those of timing alone."""
    c = part.calibration
    try:
        c = c or clock_offsets(part.motions, part.config, part.clocks)
    except CalibrationError as e:
        raise NotObservableError(f"needs the clock offsets, which were not found: {e}") from e
    if not c.determined[:, 6].all():
        raise NotObservableError("needs the clock offsets, which this part of the drive does not tell")
    chains = [sync.chain(m).shifted(c.dt_at(c.base, name, part.at)) for name, m in part.motions.items()]
    return sync.synchronise(chains, part.config.sync.gate)
