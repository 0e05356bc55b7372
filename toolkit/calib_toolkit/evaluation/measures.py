"""One repeat of each experiment of section VIII: what was found, against the truth."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from calib_toolkit import checks, observability, se3, sync, timing
from calib_toolkit.config import Config
from calib_toolkit.errors import CalibrationError, NotObservableError
from calib_toolkit.evaluation import baselines
from calib_toolkit.evaluation.errors import DELTA, EULER, POSITION, Finding, rotation_error, rotation_sigma
from calib_toolkit.evaluation.sections import Section
from calib_toolkit.pipeline import calibrate_motions
from calib_toolkit.types import Calibration, Motions

Array = NDArray[np.float64]

FORWARD_LEFT_UP = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""Turns a camera's axes (right, down, ahead) into a vehicle's, so that roll is about the optical axis."""
LEAST_SQUARES = "least-squares"


@dataclass(frozen=True)
class Turn:
    """One camera in the first's axes. R: (3, 3). known: whether determined. refused: the sentence, if it was."""

    R: Array
    known: bool = True
    refused: str = ""


@dataclass(frozen=True)
class Part:
    """Some sensors of a section, and what calibrating them yields: a calibration, or the sentence that refuses."""

    motions: Mapping[str, Motions]
    clocks: tuple[str, ...]
    calibration: Calibration | None
    refused: str = ""


def measure_timing(section: Section, config: Config, estimators: list[str]) -> list[Finding]:
    """Clock offsets of all sensors to the first, each on a clock of its own (section VIII-C)."""
    (method,) = estimators
    names, truth = list(section.motions), section.truth
    found, known = _times(section.motions, names, config)
    findings = []
    for i, name in enumerate(names[1:], start=1):
        if not known[i]:
            findings.append(Finding(method, name, undetermined=("dt",)))
            continue
        error = {"dt": 1e3 * (found.dt[i] - truth.dt_base_sensor[i])} if truth.determined[i, 6] else {}
        findings.append(Finding(method, name, error, {"dt": 1e3 * float(np.sqrt(found.cov[i, i]))}))
    return findings


def measure_pair(section: Section, config: Config, estimators: list[str]) -> list[Finding]:
    """Where the second sensor sits in the first one's frame (section VIII-D), beside the baselines."""
    method, *others = estimators
    label = "-".join(section.motions)
    truth = section.truth
    ours = _part(section, list(section.motions), config)
    c = ours.calibration
    findings = [_found_pair(method, label, c, truth) if c else Finding(method, label, refused=ours.refused)]
    for other in others:
        try:
            steps, plain = _steps(ours, config), other == LEAST_SQUARES
            T = baselines.least_squares(steps) if plain else baselines.opencv_hand_eye(steps, other)
            error = _rotation(T, truth.T_base_sensor[1]) | _position(T, truth, 1)
            findings.append(Finding(other, label, {k: e for k, e in error.items() if np.isfinite(e)}))
        except CalibrationError as e:
            findings.append(Finding(other, label, refused=str(e)))
    return findings


def measure_panoramic(section: Section, config: Config, estimators: list[str]) -> list[Finding]:
    """Rotations between every two cameras: all estimated at once, and each with the first only (section VIII-E)."""
    names, truth = list(section.motions), section.truth
    together, separate, *plain = estimators
    everyone = _part(section, names, config)
    turns = [_turn(everyone, k) for k in range(len(names))]
    findings = _found_turns(together, names, turns, truth, everyone.calibration)
    pairs = [_part(section, [names[0], other], config) for other in names[1:]]
    first = Turn(np.eye(3))
    findings += _found_turns(separate, names, [first, *(_turn(p, 1) for p in pairs)], truth)
    for estimator in plain:
        findings += _found_turns(estimator, names, [first, *(_plain_turn(p, config) for p in pairs)], truth)
    return findings


def _part(section: Section, names: list[str], config: Config) -> Part:
    clocks = tuple(c for n, c in zip(section.motions, section.clocks, strict=True) if n in names)
    motions = {n: section.motions[n] for n in names}
    try:
        return Part(motions, clocks, calibrate_motions(motions, config, clocks).calibration)
    except CalibrationError as e:
        return Part(motions, clocks, None, str(e))


def _turn(part: Part, k: int) -> Turn:
    c = part.calibration
    if c is None:
        return Turn(np.eye(3), refused=part.refused)
    return Turn(c.T_base_sensor[k, :3, :3], bool(c.determined[k, 3:6].all()))


def _plain_turn(pair: Part, config: Config) -> Turn:
    try:
        return Turn(baselines.kabsch(*_steps(pair, config).vec[..., 3:]))
    except CalibrationError as e:
        return Turn(np.eye(3), refused=str(e))


def _found_pair(method: str, label: str, c: Calibration, truth: Calibration) -> Finding:
    known = c.determined[1]
    unknown = {k for k, yes in zip((*POSITION, *DELTA, "dt"), known, strict=True) if not yes}
    unknown |= {e for e, d in zip(EULER, DELTA, strict=True) if d in unknown}
    unknown |= {"rotation"} if not known[3:6].all() else set()
    unknown |= {"translation"} if not known[:3].all() else set()
    error = _rotation(c.T_base_sensor[1], truth.T_base_sensor[1]) | _position(c.T_base_sensor[1], truth, 1)
    if truth.determined[1, 6]:
        error["dt"] = 1e3 * float(c.dt_base_sensor[1] - truth.dt_base_sensor[1])
    sigma = rotation_sigma(c.covariance[10:13, 10:13])
    sigma |= dict(zip((*POSITION, "dt"), np.sqrt(np.diag(c.covariance)[[7, 8, 9, 13]]) * [1, 1, 1, 1e3], strict=True))
    return Finding(
        method,
        label,
        {k: e for k, e in error.items() if k not in unknown},
        {k: s for k, s in sigma.items() if k not in unknown},
        tuple(sorted(unknown)),
    )


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


def _steps(part: Part, config: Config) -> sync.Steps:
    """The steps that the pipeline works on; where it refused to go on, those on the offsets of timing alone."""
    motions = part.motions
    if part.calibration is not None:
        dt = part.calibration.dt_base_sensor
    else:
        try:
            found, known = _times(motions, part.clocks, config)
        except CalibrationError as e:
            raise NotObservableError(f"needs the clock offsets, which were not found: {e}") from e
        if not known.all():
            raise NotObservableError("needs the clock offsets, which this part of the drive does not tell")
        dt = found.dt
    chains = [sync.chain(m).shifted(d) for m, d in zip(motions.values(), dt, strict=True)]
    return sync.synchronise(chains, config.sync.gate)


def _times(
    motions: Mapping[str, Motions], clocks: Sequence[str], config: Config
) -> tuple[timing.TimeOffsets, NDArray[np.bool_]]:
    """Offsets of all sensors to the first as the pipeline finds them; (n,) whether the motions tell them."""
    names = list(motions)
    checks.moved(motions)
    chains = [sync.chain(m) for m in motions.values()]
    checks.overlap(names, chains, config.timing.max_offset)
    found = timing.estimate(chains, clocks, config.timing)
    on_base = [c.shifted(d) for c, d in zip(chains, found.dt, strict=True)]
    unknown = {key for u in observability.unmeasured_times(names, on_base, clocks) for key in u.direction}
    known = np.array([f"{name}.dt" not in unknown for name in names])
    return found, known
