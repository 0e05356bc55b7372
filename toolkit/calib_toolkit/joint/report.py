"""Beside the calibration: how noisy each sensor was, what was rejected, and how much more driving would help."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib_toolkit.joint import noise, verdict
from calib_toolkit.joint.moving import Moving
from calib_toolkit.joint.readings import WIDENED
from calib_toolkit.joint.turning import Turning
from calib_toolkit.sync import Steps
from calib_toolkit.types import Calibration, Measured, Motions
from calib_toolkit.types.calibration import PARAMETERS, WANTED

Array = NDArray[np.float64]


def statistics(
    c: Calibration,
    motions: Sequence[Motions],
    turned: Turning,
    placed: Moving | None,
    steps: Steps,
    prior: Sequence[Measured],
) -> dict[str, Any]:
    """Plain numbers for ``Result.statistics``."""
    seconds = float(np.sum(np.diff(steps.ends, axis=1)))
    return {
        "readings": {n: len(m) for n, m in zip(c.names, motions, strict=True)},
        "common_steps": len(steps),
        "steps_rejected": steps.rejected,
        "seconds": seconds,
        "rejected": _by_name(c, np.array([np.mean(~k) for k in turned.kept]) if placed is None else placed.rejected),
        "noise_scale": {n: _noise(turned, placed, i, bool(c.has_scale[i])) for i, n in enumerate(c.names)},
        "strength": _strengths(c, steps),
        "driving": _driving(c, seconds),
        "bias_deg": None if placed is None else _by_name(c, np.degrees(np.linalg.norm(placed.bias, axis=1))),
        "rounds": {"turning": turned.rounds, "moving": 0 if placed is None else placed.rounds},
        "prior": [f"{m.sensor}.{m.parameter}" for m in prior],
    }


def _by_name(c: Calibration, values: Array) -> dict[str, float]:
    return {n: float(v) for n, v in zip(c.names, values, strict=True)}


def _noise(turned: Turning, placed: Moving | None, i: int, scaled: bool) -> dict[str, Any]:
    """How many times its usual stated variance a sensor's noise is, and whether that is told for it or for a pair."""
    alone = turned.freedom[i] > noise.VISIBLE
    found: dict[str, Any] = {"turns": WIDENED * float(turned.scale[i]), "kind": "own" if alone else "pair"}
    if placed is not None and scaled:
        alone = i not in placed.together and placed.freedom[i] > noise.VISIBLE
        found |= {"shifts": WIDENED * float(placed.scale[i]), "kind_of_shifts": "own" if alone else "pair"}
    return found


def _strengths(c: Calibration, steps: Steps) -> dict[str, dict[str, float]]:
    found = verdict.strengths(steps, c.T_base_sensor)
    return {n: dict(zip(verdict.POSE, map(float, found[i]), strict=True)) for i, n in enumerate(c.names) if i}


def _driving(c: Calibration, seconds: float) -> dict[str, dict[str, float]]:
    """Seconds of driving like this in all after which each number would be known as well as is wanted."""
    return {
        n: {
            p: round(seconds * max(float(c.sigma[i, k]) / WANTED[p], 0.0) ** 2, 1)
            for k, p in enumerate(PARAMETERS)
            if c.determined[i, k]
        }
        for i, n in enumerate(c.names)
        if i
    }
