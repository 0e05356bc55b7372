"""What the plain formats hold of a sensor, with None for what was not determined."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from calib_toolkit import Calibration
from calib_toolkit.errors import DataError
from calib_toolkit_plugins.exporters import clocks, files, poses

SIGMAS = ("x", "y", "z", "rx", "ry", "rz", "dt")
Values = tuple[float | None, ...]


class Row(NamedTuple):
    """One sensor: metres, a quaternion x y z w, seconds, one sigma of ``SIGMAS``."""

    name: str
    translation: Values
    quaternion: Values
    dt: float | None
    clock_skew: float
    sigma: Values
    has_scale: bool


def meaning(c: Calibration) -> list[str]:
    """What the numbers mean, for comments."""
    return [
        f"Each pose maps points of its sensor to {c.base}: {poses.direction(c)}.",
        "Metres; quaternions x y z w; the frame of a camera is its optical one (x right, y down, z ahead).",
        f"{clocks.meaning(c.base)}.",
        f"sigma: one standard deviation; rx ry rz (radians) of delta in R_true = Exp(delta) R_est, axes of {c.base}.",
    ]


def rows(c: Calibration) -> list[Row]:
    """Every sensor, the base first. A rotation of which one axis was not determined is not given at all.

    Where no number has a sigma, nobody knew how sure they are.
    """
    found = []
    for i in sorted(range(len(c.names)), key=lambda i: c.names[i] != c.base):
        T, known = c.T_base_sensor[i], c.determined[i].copy()
        known[3:6] = known[3:6].all()
        turn = poses.quaternion_xyzw(T) if known[3] else [None] * 4
        shift = _or_none(np.where(known[:3], T[:3, 3], np.nan))
        dt = float(c.dt_base_sensor[i]) if known[6] else None
        sigma = _or_none(np.where(known & c.covariance.any(), c.sigma[i], np.nan))
        found.append(Row(c.names[i], shift, tuple(turn), dt, float(c.clock_skew[i]), sigma, bool(c.has_scale[i])))
    return found


def maybe(file: Path, what: str, values: Any, count: int) -> Values:
    """So many numbers, or None in their place. Raises DataError."""
    if not isinstance(values, list | tuple) or len(values) != count:
        raise DataError(f"{file}: {what} is no list of {count} numbers, or null; correct it")
    return tuple(None if v is None else files.number(file, what, v) for v in values)


def calibration(file: Path, base: str, t_ref: float, sensors: Sequence[Row]) -> Calibration:
    """The calibration of such rows. Raises DataError."""
    names = [r.name for r in sensors]
    if base not in names or len(set(names)) < len(names) or len(names) < 2:
        raise DataError(
            f"{file} must have two sensors or more, each once, and its base {base} among them; correct it"
        )
    sigma = np.array([r.sigma for r in sensors], dtype=float)
    if np.any(sigma < 0):
        raise DataError(f"{file} has a sigma below zero; correct it")
    known = np.ones((len(names), 7), dtype=bool)
    T = np.empty((len(names), 4, 4))
    for i, r in enumerate(sensors):
        t = np.array(r.translation, dtype=float)
        turned = None not in r.quaternion
        xyzw = [q for q in r.quaternion if q is not None] if turned else [0.0, 0.0, 0.0, 1.0]
        T[i] = poses.from_quaternion(file, r.name, xyzw, np.nan_to_num(t))
        known[i] = [*np.isfinite(t), *[turned] * 3, r.dt is not None]
    i = names.index(base)
    if not known[i].all() or not np.allclose(T[i], np.eye(4), atol=1e-9) or sensors[i].dt or sensors[i].clock_skew:
        raise DataError(f"{file}: the pose and the clock of {base} are not zero, though it is the base; correct it")
    unknown_sigma = ~known & np.isfinite(sigma)
    if np.any(known & np.isnan(sigma) & np.isfinite(sigma).any()) or np.any(unknown_sigma & (sigma > 0)):
        raise DataError(f"{file} has a sigma without its number, or a number without its sigma; give both or neither")
    return Calibration(
        base=base,
        names=tuple(names),
        T_base_sensor=T,
        dt_base_sensor=np.array([r.dt or 0.0 for r in sensors]),
        covariance=np.diag(np.nan_to_num(sigma).ravel() ** 2),
        has_scale=np.array([r.has_scale for r in sensors]),
        determined=known,
        clock_skew=np.array([r.clock_skew for r in sensors]),
        t_ref=t_ref,
    )


def _or_none(values: Any) -> Values:
    return tuple(float(v) if np.isfinite(v) else None for v in values)
