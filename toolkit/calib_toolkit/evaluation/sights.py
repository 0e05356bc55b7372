"""One repeat of the experiments on what the sensors see (sections VIII-F and VIII-G), against the truth."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from calib_toolkit import se3
from calib_toolkit.appearance import refine, search
from calib_toolkit.appearance.pairs import Comparison, comparisons
from calib_toolkit.appearance.refinement import chosen, options
from calib_toolkit.combine import combine
from calib_toolkit.config import Config
from calib_toolkit.errors import ConfigError, DataError, NotObservableError
from calib_toolkit.evaluation.errors import FAILURES, Finding, refusal
from calib_toolkit.evaluation.measures import found_pose
from calib_toolkit.evaluation.sections import Section
from calib_toolkit.hookspecs import CostMetric, Metric
from calib_toolkit.pipeline import calibrate_motions
from calib_toolkit.plugins import Registry, registry
from calib_toolkit.progress import Silent
from calib_toolkit.types import Calibration, Log

Array = NDArray[np.float64]

INITIAL = "initial"
ALONE, CONSTRAINED, UNCONSTRAINED = "-alone", "-constrained", "-unconstrained"
"""Endings of a metric's name: what it says by itself, with the motion, and searched without the motion's sigma."""
MOTION, COMBINED = "-motion", "-combined"
"""Endings of a method's name: before and after appearance."""
WAYS = (ALONE, CONSTRAINED, UNCONSTRAINED)


def asked(config: Config, plugins: Registry) -> dict[str, Metric | CostMetric]:
    """The metrics that the configuration names, by id. Raises ConfigError if one does not exist or none is left."""
    metrics = chosen(config, plugins)
    if not metrics:
        raise ConfigError("this experiment compares with what the sensors see, which takes a metric; name one")
    return metrics


def metrics_of(log: Log, config: Config, plugins: Registry) -> tuple[str, ...]:
    """The searched metrics that take the log's two sensors, of those the configuration names or else of all that are
    installed. Raises ConfigError.
    """
    named = config.appearance != Config.appearance
    there = asked(config, plugins) if named else plugins.metrics
    a, b = (s.kind for s in log.streams.values())
    taken = {n: m for n, m in there.items() if isinstance(m, CostMetric) and m.accepts(a, b)}
    if not taken or (named and len(taken) < len(there)):
        left = ", ".join(n for n in there if n not in taken)
        raise ConfigError(
            f"'appearance' takes metrics that give each pose of {' and '.join(log.streams)} ({a}, {b}) a cost, and "
            f"{left or 'what is installed'} does not; choose others with --appearance or --sensors"
        )
    return tuple(taken)


def measure_appearance(section: Section, configs: Sequence[Config], others: Sequence[str]) -> list[Finding]:
    """A lidar and a camera, from a start about as far off as motion leaves it, by each metric (section VIII-F).

    One motion stage always ends in the same place, so the start is the truth moved by a draw from its covariance.
    """
    config, label = replace(configs[0], seed=section.seed), "-".join(section.motions)
    start = drawn(calibrate_motions(section.motions, config, section.clocks).calibration, section)
    findings = [_placed(INITIAL, label, start, section.truth)]
    plugins, log = registry(), _seen(section)
    metrics = chosen(config, plugins)
    looks = comparisons(log, section.paths, start, metrics, config.moments, config.seed)
    found = {c.metric.id: c for c in looks if c.pair.a.name == start.base}
    for metric in config.appearance:
        try:
            if metric not in found:
                raise DataError(f"{metric}: the two do not see the same where the start puts them")
            findings += _by_metric(found[metric], start, label, section.truth, config)
        except FAILURES as e:
            findings += [Finding(f"{metric}{way}", label, refused=refusal(e)) for way in WAYS]
    return findings


def measure_full(section: Section, configs: Sequence[Config], others: Sequence[str]) -> list[Finding]:
    """Every sensor by motion alone, and with the appearance of all pairs (section VIII-G), by each method."""
    findings, names = [], list(section.motions)[1:]
    for config in (replace(c, seed=section.seed, jobs=1) for c in configs):
        before, after = (f"{config.method}{way}" for way in (MOTION, COMBINED))
        try:
            motion = calibrate_motions(section.motions, config, section.clocks)
        except FAILURES as e:
            findings += [Finding(way, n, refused=refusal(e)) for way in (before, after) for n in names]
            continue
        findings += _everyone(before, motion.calibration, section.truth)
        try:
            result = refine(motion, _seen(section), section.paths, config, registry(), Silent())
            if not result.pair_estimates:
                raise NotObservableError("no two sensors see the same, as far as an installed metric compares them")
            findings += _everyone(after, result.calibration, section.truth)
        except FAILURES as e:
            findings += [Finding(after, n, refused=refusal(e)) for n in names]
    return findings


def drawn(motion: Calibration, section: Section) -> Calibration:
    """The true poses moved by a draw from the motion's covariance, as many times wider as the section says."""
    rows = 7 * np.arange(len(motion.names))[:, None] + np.arange(6)
    wider = np.ones(len(motion.covariance))
    wider[rows] = section.wider
    cov = motion.covariance * np.outer(wider, wider)
    rng = np.random.default_rng(section.seed)
    draw = rng.multivariate_normal(np.zeros(len(cov)), np.nan_to_num(cov), check_valid="ignore", method="eigh")
    change = draw.reshape(-1, 7)
    T = section.truth.T_base_sensor
    moved = se3.rigid(se3.exp_so3(change[:, 3:6]) @ T[:, :3, :3], T[:, :3, 3] + change[:, :3])
    return replace(motion, T_base_sensor=moved, covariance=cov)


def _by_metric(c: Comparison, start: Calibration, label: str, truth: Calibration, config: Config) -> list[Finding]:
    """What a metric alone says, what follows with the motion, and where its cost is least anywhere."""
    metric, given = c.metric, options(c.metric, config)
    found = search.estimate(metric, c.pair, given, config.seed)
    if found.converged:
        by_clock = found.by_clock * start.dt_between(c.pair.a.name, c.pair.b.name)[1]
        alone = _with(start, found.transform.T_a_b, found.transform.cov + np.outer(by_clock, by_clock))
        combined = combine(start, [found])
        findings = [_placed(f"{metric.id}{ALONE}", label, alone, truth)]
        if combined.used[0]:
            findings.append(_placed(f"{metric.id}{CONSTRAINED}", label, combined.calibration, truth))
        else:
            findings.append(Finding(f"{metric.id}{CONSTRAINED}", label, refused="; ".join(combined.notes)))
    else:
        findings = [Finding(f"{metric.id}{way}", label, refused=found.note) for way in (ALONE, CONSTRAINED)]
    assert isinstance(metric, CostMetric)  # no others are chosen
    T = search.unconstrained(metric, c.pair, given, config.seed)
    way = f"{metric.id}{UNCONSTRAINED}"
    if T is None:
        return [*findings, Finding(way, label, refused="in too few moments do both see the same")]
    free = _placed(way, label, _with(start, T, np.zeros((6, 6))), truth)
    return [*findings, replace(free, sigma={})]


def _placed(estimator: str, label: str, c: Calibration, truth: Calibration) -> Finding:
    """The second sensor's pose; its clock is not what is compared."""
    found = found_pose(estimator, label, c, 1, truth)
    error, sigma = ({p: v for p, v in told.items() if p != "dt"} for told in (found.error, found.sigma))
    return replace(found, error=error, sigma=sigma)


def _with(start: Calibration, T: Array, cov: Array) -> Calibration:
    """The start with its second sensor's pose and covariance as given."""
    C = start.covariance.copy()
    C[7:13], C[:, 7:13] = 0.0, 0.0
    C[7:13, 7:13] = cov
    known = start.determined.copy()
    known[1, :6] = True
    poses = np.array([start.T_base_sensor[0], T])
    return replace(start, T_base_sensor=poses, covariance=C, determined=known, undetermined=())


def _everyone(estimator: str, c: Calibration, truth: Calibration) -> list[Finding]:
    return [found_pose(estimator, name, c, i, truth) for i, name in enumerate(c.names) if i]


def _seen(section: Section) -> Log:
    if section.log is None:
        raise DataError("this part of the drive was cut without what the sensors saw")
    return section.log
