"""One repeat of each experiment of section VIII: what was found, against the truth."""

from collections.abc import Mapping
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from calib_toolkit import checks, observability, se3, sync, timing
from calib_toolkit.config import Config
from calib_toolkit.errors import CalibrationError
from calib_toolkit.evaluation import baselines
from calib_toolkit.evaluation.errors import DELTA, EULER, POSITION, Finding, rotation_error, rotation_sigma
from calib_toolkit.evaluation.sections import Section
from calib_toolkit.pipeline import calibrate_motions
from calib_toolkit.types import Calibration, Motions

Array = NDArray[np.float64]
Turns = tuple[Array, NDArray[np.bool_], Calibration | None]
"""(n, 3, 3) rotations of all cameras in the first; (n,) whether determined; the calibration that states sigmas."""

FORWARD_LEFT_UP = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""Turns a camera's axes (right, down, ahead) into a vehicle's, so that roll is about the optical axis."""
LEAST_SQUARES = "least-squares"


def measure_timing(section: Section, config: Config, estimators: list[str]) -> list[Finding]:
    """Clock offsets of all sensors to the first, each on a clock of its own (section VIII-C)."""
    (method,) = estimators
    names, truth = list(section.motions), section.truth
    checks.moved(section.motions)
    chains = [sync.chain(m) for m in section.motions.values()]
    checks.overlap(names, chains, config.timing.max_offset)
    found = timing.estimate(chains, names, config.timing)
    on_base = [c.shifted(d) for c, d in zip(chains, found.dt, strict=True)]
    unknown = {key for u in observability.unmeasured_times(names, on_base, names) for key in u.direction}
    findings = []
    for i, name in enumerate(names[1:], start=1):
        if f"{name}.dt" in unknown:
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
    c = calibrate_motions(section.motions, config, section.clocks).calibration
    findings = [_found_pair(method, label, c, truth)]
    if others:
        steps = _steps(section.motions, c.dt_base_sensor, config)
    for other in others:
        try:
            plain = other == LEAST_SQUARES
            T = baselines.least_squares(steps) if plain else baselines.opencv_hand_eye(steps, other)
            error = _rotation(T, truth.T_base_sensor[1]) | _position(T, truth, 1)
            findings.append(Finding(other, label, {k: e for k, e in error.items() if np.isfinite(e)}))
        except CalibrationError as e:
            findings.append(Finding(other, label, refused=str(e)))
    return findings


def measure_panoramic(section: Section, config: Config, estimators: list[str]) -> list[Finding]:
    """Rotations between every two cameras: all estimated at once, and each with the first only (section VIII-E)."""
    names, ways = list(section.motions), (_together, _separate, _plain)
    findings = []
    for estimator, way in zip(estimators, ways, strict=False):
        try:
            findings += _found_turns(estimator, names, way(section, config), section.truth)
        except CalibrationError as e:
            findings += [Finding(estimator, f"{a}-{b}", refused=str(e)) for a, b in combinations(names, 2)]
    return findings


def _together(section: Section, config: Config) -> Turns:
    c = calibrate_motions(section.motions, config, section.clocks).calibration
    return c.T_base_sensor[:, :3, :3], np.asarray(c.determined[:, 3:6].all(axis=1)), c


def _separate(section: Section, config: Config) -> Turns:
    each = _each_with_the_first(section, config)
    R = [np.eye(3), *(c.T_base_sensor[1, :3, :3] for c in each)]
    return np.array(R), np.array([True, *(c.determined[1, 3:6].all() for c in each)]), None


def _plain(section: Section, config: Config) -> Turns:
    each = _each_with_the_first(section, config)
    steps = [_steps({n: section.motions[n] for n in c.names}, c.dt_base_sensor, config) for c in each]
    R = np.array([np.eye(3), *(baselines.kabsch(*s.vec[..., 3:]) for s in steps)])
    return R, np.ones(len(R), dtype=bool), None


def _each_with_the_first(section: Section, config: Config) -> list[Calibration]:
    (first, clock), *others = zip(section.motions, section.clocks, strict=True)
    pairs = [({n: section.motions[n] for n in (first, other)}, (clock, theirs)) for other, theirs in others]
    return [calibrate_motions(motions, config, clocks).calibration for motions, clocks in pairs]


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


def _found_turns(estimator: str, names: list[str], turns: Turns, truth: Calibration) -> list[Finding]:
    """One finding for every two cameras, in the first camera's axes."""
    R, known, stated = turns
    findings = []
    for (x, a), (y, b) in combinations(enumerate(names), 2):
        label = f"{a}-{b}"
        if not known[[x, y]].all():
            findings.append(Finding(estimator, label, undetermined=(*EULER, "rotation", *DELTA)))
            continue
        R_true = truth.T_base_sensor[[x, y], :3, :3]
        to_first = FORWARD_LEFT_UP @ R_true[0]
        error = to_first @ (R_true[0].T @ R_true[1] @ (R[x].T @ R[y]).T) @ to_first.T
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


def _steps(motions: Mapping[str, Motions], dt: Array, config: Config) -> sync.Steps:
    """The steps that the pipeline works on."""
    chains = [sync.chain(m).shifted(d) for m, d in zip(motions.values(), dt, strict=True)]
    return sync.synchronise(chains, config.sync.gate)
