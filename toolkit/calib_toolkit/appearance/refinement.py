"""The motion's calibration refined wherever sensors see the same place (section VII)."""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import joblib
import numpy as np

from calib_toolkit import cache
from calib_toolkit.appearance.pairs import Comparison, Moved, comparisons
from calib_toolkit.appearance.search import VERSION, estimate
from calib_toolkit.combine import Combined, combine, combine_paper
from calib_toolkit.config import Config
from calib_toolkit.errors import CalibrationError, ConfigError
from calib_toolkit.hookspecs import CostMetric, Metric
from calib_toolkit.plugins import Registry
from calib_toolkit.progress import Progress
from calib_toolkit.types import Calibration, Log, PairEstimate, Result

NONE = "none"
TASK = "appearance"


def refine(
    result: Result,
    log: Log,
    motion: Mapping[str, Moved],
    config: Config,
    plugins: Registry,
    progress: Progress,
    pictures: Path | None = None,
    folder: Path | None = None,
) -> Result:
    """The result with the appearance of every pair in it, each counted beside the motion.

    motion: of each sensor, on its own stamps. pictures: folder for what a person can judge by. folder: of the cache;
    None keeps nothing. Raises ConfigError on a metric that does not exist.
    """
    metrics = chosen(config, plugins)
    if not metrics:
        return result
    found = comparisons(log, motion, result.calibration, metrics, config.moments, config.seed)
    if not found:
        return result
    progress.begin(TASK, len(found))
    estimates = []
    pool = joblib.Parallel(n_jobs=min(config.jobs, len(found)), return_as="generator")
    for e in pool(joblib.delayed(_estimate)(c, options(c.metric, config), config.seed, folder) for c in found):
        estimates.append(e)
        progress.advance(TASK, 1)
    combined = (combine_paper if config.method == "paper" else combine)(result.calibration, estimates)
    if pictures is not None:
        _draw(found, result.calibration, combined.calibration, pictures)
    return replace(
        result,
        calibration=combined.calibration,
        stages={
            **result.stages,
            "appearance": directly(result.calibration, estimates),
            "combined": combined.calibration,
        },
        pair_estimates=tuple(estimates),
        statistics={
            **result.statistics,
            "pairs": told(estimates, combined),
            "left_out": list(combined.notes),
        },
    )


def chosen(config: Config, plugins: Registry) -> dict[str, Metric | CostMetric]:
    """The metrics that are asked for, by id; of the defaults those that are installed. Raises ConfigError."""
    if config.appearance == (NONE,):
        return {}
    missing = [m for m in config.appearance if m not in plugins.metrics]
    if missing and config.appearance != Config.appearance:
        raise ConfigError(f"there is no metric '{missing[0]}'; there are: {', '.join(plugins.metrics)}, and {NONE}")
    return {m: plugins.metrics[m] for m in config.appearance if m in plugins.metrics}


def options(metric: Metric | CostMetric, config: Config) -> Any:
    """The metric's options as configured. Raises ConfigError."""
    values = config.metrics.get(metric.id, {})
    try:
        return metric.options(**values)
    except TypeError as e:
        raise ConfigError(f"[metrics.{metric.id}] of the configuration does not fit its options: {e}") from e


def directly(motion: Calibration, estimates: Sequence[PairEstimate]) -> Calibration:
    """What pairs alone say of sensors that were compared with the base itself; the motion's for all others."""
    n = len(motion.names)
    T, known = motion.T_base_sensor.copy(), motion.determined.copy()
    cov = motion.covariance.reshape(n, 7, n, 7).copy()
    best: dict[int, float] = {}
    for e in estimates:
        pose = e.transform
        if not e.converged or pose.a != motion.base or not pose.has_scale:
            continue
        i, size = motion.index(pose.b), float(np.trace(pose.cov))
        if size < best.get(i, np.inf):
            best[i], T[i], known[i, :6] = size, pose.T_a_b, True
            cov[i, :6], cov[:, :, i, :6] = 0.0, 0.0
            cov[i, :6, i, :6] = pose.cov
    return replace(
        motion,
        T_base_sensor=T,
        covariance=cov.reshape(7 * n, 7 * n),
        determined=known,
        undetermined=tuple(
            u
            for u in motion.undetermined
            if not any(motion.index(key.rpartition(".")[0]) in best for key in u.direction)
        ),
    )


def told(estimates: Sequence[PairEstimate], combined: Combined) -> list[dict[str, Any]]:
    """Every pair and metric in plain numbers."""
    return [
        {
            "metric": e.metric,
            "a": e.transform.a,
            "b": e.transform.b,
            "T_a_b": e.transform.T_a_b.tolist() if e.converged else None,
            "sigma": np.sqrt(np.diag(e.transform.cov)).tolist() if e.converged else None,
            "has_scale": e.transform.has_scale,
            "used": used,
            "note": e.note,
            "statistics": dict(e.statistics),
        }
        for e, used in zip(estimates, combined.used, strict=True)
    ]


def _estimate(comparison: Comparison, chosen: Any, seed: int, folder: Path | None) -> PairEstimate:
    """One metric's look at one pair: from the cache, or made and kept there. What can not be read says so."""
    metric, pair = comparison.metric, comparison.pair
    key = ""
    if folder is not None:
        key = cache.key_of(
            metric.id, type(metric).__name__, getattr(metric, "version", "1"), VERSION, chosen, seed, pair
        )
        if (stored := cache.load_pair(folder, key)) is not None:
            return stored
    try:
        found = estimate(metric, pair, chosen, seed)
    except CalibrationError as e:
        return PairEstimate(metric.id, pair.prior, converged=False, note=str(e))
    if folder is not None:
        cache.store_pair(folder, key, found)
    return found


def _draw(found: Sequence[Comparison], before: Calibration, after: Calibration, folder: Path) -> None:
    """A picture of each pair by the first metric that can draw it."""
    drawn = set()
    for c in found:
        a, b = c.pair.a.name, c.pair.b.name
        draw = getattr(c.metric, "draw", None)
        if draw is not None and (a, b) not in drawn:
            drawn.add((a, b))
            poses = {"motion alone": before.between(a, b).T_a_b, "refined": after.between(a, b).T_a_b}
            folder.mkdir(parents=True, exist_ok=True)
            with suppress(CalibrationError):  # a picture that can not be drawn takes no result with it
                draw(c.pair, poses, folder)
