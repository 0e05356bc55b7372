"""Antennas as sensors of a calibration, and in words what positions do not tell of them."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from calib_toolkit import assembly, observability
from calib_toolkit.antenna import fit, start
from calib_toolkit.antenna.blocks import Base
from calib_toolkit.errors import ConfigError, DataError
from calib_toolkit.types import Calibration, Measured, Motions, Result, Trajectory, Undetermined
from calib_toolkit.types.calibration import PARAMETERS

Array = NDArray[np.float64]

NUMBERS = ("x", "y", "z", "dt")
HEIGHT = 2.0
"""Metres: sigma of how far above or below the base an antenna is, before anything is known."""
REAL = 0.5
"""Share of what tells a number that must not be feigned by noise."""
VAGUE_LATE = 0.1
"""Seconds: a sigma above tells nothing."""
WANDERED = 2.0
"""Seconds from where its search began that a clock offset may be found."""
FEWEST = 3
"""Stretches of which each may be wrong by chance."""


def added(result: Result, motions: Motions, antennas: Mapping[str, Trajectory], prior: Sequence[Measured]) -> Result:
    """The result with each antenna in it. motions: of the base. prior: numbers measured of antennas.

    An antenna is a point: how it is turned is never told, and its height above the base only by ``prior``. Where its
    travel and the base's do not go together, nothing is. Raises DataError on a base that knows no distances.
    """
    c = result.calibration
    if not motions.has_scale:
        raise DataError(
            f"positions of {', '.join(antennas)} tell nothing beside {c.base}, which knows no distances; add a lidar "
            "or an odometry, or leave them out"
        )
    base, found = Base.of(motions), {}
    for name, positions in antennas.items():
        dt = start.lag(base, positions)
        told = None if dt is None else fit.estimate(base, positions, dt, _prior(motions, name, prior))
        if told is not None and (told.stretches < FEWEST or abs(told.x[3] - (dt or 0.0)) > WANDERED):
            told = None
        found[name] = told
        c = _with(c, name, told, _open(c.base, name, told, _upright(motions), prior))
    statistics = {name: None if f is None else _plain(f) for name, f in found.items()}
    return replace(result, calibration=c, statistics={**result.statistics, "antennas": statistics})


def _upright(motions: Motions) -> Array:
    """(3,) the axis about which the base turned most."""
    return np.asarray(np.linalg.eigh(motions.vec[:, 3:].T @ motions.vec[:, 3:])[1][:, -1])


def _prior(motions: Motions, name: str, prior: Sequence[Measured]) -> tuple[Array, Array]:
    """Information (4, 4) on ``(t, dt)`` and its product with the values (4,)."""
    up = _upright(motions)
    information, pull = block_diag(np.outer(up, up) / HEIGHT**2, 0.0), np.zeros(4)
    for m in prior:
        if m.sensor == name:
            if m.parameter not in NUMBERS:
                raise ConfigError(
                    f"the prior gives an angle of {name}, and an antenna has none; give its position only"
                )
            k = NUMBERS.index(m.parameter)
            information[k, k] += 1 / m.sigma**2
            pull[k] += m.value / m.sigma**2
    return information, pull


def _open(base: str, name: str, found: fit.Found | None, up: Array, prior: Sequence[Measured]) -> list[Undetermined]:
    """What is not determined, in words."""
    turned = "positions do not tell how an antenna is turned, and it need not be known"
    unknown = [_turn(name, k, base, turned) for k in range(3)]
    if found is None:
        why = (
            f"its travel and that of {base} do not go together at any clock offset within {start.MOST_LATE:g} s, or "
            "hardly bend; check that both are of one drive, and drive bends at changing speed"
        )
        return [*unknown, *(_shift(name, v, base, why) for v in np.eye(3)), _clock(name, why)]
    across = np.linalg.svd(up[None])[2][1:]
    values, axes = np.linalg.eigh(across @ found.cov[:3, :3] @ across.T)
    for variance, v in zip(values, axes.T @ across, strict=True):
        if variance > observability.VAGUE_SHIFT**2 or found.real(np.append(v, 0.0)) < REAL:
            unknown.append(_shift(name, v, base, "the vehicle hardly turned; drive longer, with bends to both sides"))
    measured = sum(up[NUMBERS.index(m.parameter)] ** 2 / m.sigma**2 for m in _shifts(name, prior))
    if measured < 1 / observability.VAGUE_SHIFT**2:
        why = "the vehicle turned about that axis; give a measured value with --prior"
        unknown.append(_shift(name, up, base, why))
    late = np.array([0.0, 0.0, 0.0, 1.0])
    if found.cov[3, 3] > VAGUE_LATE**2 or found.real(late) < REAL:
        unknown.append(_clock(name, "speed hardly changed; drive bends at changing speed"))
    return unknown


def _shifts(name: str, prior: Sequence[Measured]) -> list[Measured]:
    return [m for m in prior if m.sensor == name and m.parameter in NUMBERS[:3]]


def _turn(name: str, k: int, base: str, why: str) -> Undetermined:
    sentence = f"the rotation of {name} about {'xyz'[k]} of {base} was not determined: {why}"
    return Undetermined({f"{name}.{PARAMETERS[3 + k]}": 1.0}, sentence)


def _shift(name: str, v: Array, base: str, why: str) -> Undetermined:
    v = np.where(np.abs(v) < 0.05, 0.0, v)
    v = v / np.linalg.norm(v) * np.sign(v[np.argmax(np.abs(v))])
    parts = {f"{name}.{axis}": float(x) for axis, x in zip("xyz", v, strict=True) if x}
    words = observability.axis_words(v, base)
    return Undetermined(parts, f"the position of {name} along {words} was not determined: {why}")


def _clock(name: str, why: str) -> Undetermined:
    return Undetermined({f"{name}.dt": 1.0}, f"the clock offset of {name} was not determined: {why}")


def _with(c: Calibration, name: str, found: fit.Found | None, unknown: Sequence[Undetermined]) -> Calibration:
    """A calibration with one sensor more."""
    T, cov = np.eye(4), np.zeros((7, 7))
    names = (*c.names, name)
    if found is not None:
        T[:3, 3] = found.x[:3]
        at = [0, 1, 2, 6]
        cov[np.ix_(at, at)] = found.cov
    known = assembly.determined(names, unknown)
    return replace(
        c,
        names=names,
        T_base_sensor=np.concatenate([c.T_base_sensor, T[None]]),
        dt_base_sensor=np.append(c.dt_base_sensor, 0.0 if found is None else found.x[3]),
        covariance=assembly.with_unknown(names, unknown, block_diag(c.covariance, cov)),
        has_scale=np.append(c.has_scale, True),
        determined=np.concatenate([c.determined, known[-1:]]),
        undetermined=(*c.undetermined, *unknown),
        clock_skew=np.append(c.clock_skew, 0.0),
    )


def _plain(found: fit.Found) -> dict[str, object]:
    """Plain numbers for ``Result.statistics``."""
    named = zip(("positions", "shifts_of_base", "turns_of_base"), map(float, found.scale), strict=True)
    return {"stretches": found.stretches, "rejected": found.rejected, "noise_scale": dict(named)}
