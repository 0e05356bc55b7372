"""Two calibrations of one rig side by side: how far apart they are, and whether chance explains it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib_toolkit import se3
from calib_toolkit.errors import DataError
from calib_toolkit.types import Calibration

Array = NDArray[np.float64]

CHANCE = 0.01
"""Calibrations agree while differences like theirs, or larger, come about by chance more often than this."""
EXACT = 1e-6
"""What both know without error agrees within this: metres, radians, seconds."""
DEGENERATE = 1e-10
"""Eigenvalue of a correlation matrix from which a direction counts as known without error."""


@dataclass(frozen=True)
class Agreement:
    """A chi-square test of some differences against their covariance.

    chi2: squared length of the differences in sigmas, infinite where something exact differs. dof: how many
    independent directions it sums. compared: how many numbers both calibrations determine; 0 is no verdict.
    """

    chi2: float
    dof: int
    compared: int

    @property
    def p(self) -> float:
        """How often chance alone would give so large a difference; nan where nothing was compared."""
        from scipy.special import chdtrc

        if not self.compared:
            return float("nan")
        return float(chdtrc(self.dof, self.chi2)) if self.dof else float(self.chi2 == 0.0)

    @property
    def differs(self) -> bool:
        """Whether chance does not explain the difference."""
        return self.p <= CHANCE


@dataclass(frozen=True)
class Comparison:
    """What :func:`compare` found.

    a, b: both calibrations over the sensors they share, brought to one base, which comes first; in both only
    what both determine counts as determined, and offsets are those at one stamp.
    difference: (n, 7) b minus a in the order of ``PARAMETERS``, rotation as ``delta = log(R_b R_a^T)`` in base
    axes; nan where not determined. covariance: (7n, 7n) of it.
    sensors: each sensor but the base tested alone; overall: all of them together.
    """

    a: Calibration
    b: Calibration
    difference: Array
    covariance: Array
    sensors: Mapping[str, Agreement]
    overall: Agreement


def compare(a: Calibration, b: Calibration) -> Comparison:
    """The differences of two independent calibrations of one rig, tested against their joint covariance.

    In the first's base if the second has it, or else in that of the second or in a common sensor. Offsets of clocks
    that drift are compared half-way between the two ``t_ref``. Raises DataError if there is nothing to compare.
    """
    shared = [name for name in a.names if name in b.names]
    if len(shared) < 2:
        raise DataError(
            f"they share {f'only {shared[0]}' if shared else 'no sensor'}, and comparing takes at least two sensors; "
            f"the first has {', '.join(a.names)}, the second {', '.join(b.names)}"
        )
    base = next(name for name in (a.base, b.base, *shared) if name in shared)
    names = [base, *(name for name in shared if name != base)]
    found = _compared(a, b, names, (a.t_ref + b.t_ref) / 2)
    if not found.overall.compared:
        raise DataError(f"no number of {', '.join(names[1:])} in {base} is determined in both")
    return found


def within(found: Comparison, names: Sequence[str]) -> Comparison:
    """The same two calibrations over some of their sensors only, in the frame and clock of the first."""
    return _compared(found.a, found.b, names, found.a.t_ref)


def rebased(c: Calibration, names: Sequence[str], stamp: float) -> Calibration:
    """Some of the sensors in the frame and clock of the first of them, offsets as they are at a stamp."""
    rows, base = [c.index(name) for name in names], c.index(names[0])
    poses = np.nan_to_num(c.T_base_sensor)  # a position that is not known must not spoil what is
    T_w_base, T_w_sensor = np.broadcast_to(poses[base], (len(rows), 4, 4)), poses[rows]
    J_base, J_sensor = se3.relative_jacobians(T_w_base, T_w_sensor)
    J = np.zeros((len(rows), 7, len(c.names), 7))
    for k, row in enumerate(rows):
        J[k, :6, base, :6] += J_base[k]
        J[k, :6, row, :6] += J_sensor[k]
        J[k, 6, base, 6] -= 1.0
        J[k, 6, row, 6] += 1.0
    return Calibration(
        names[0],
        tuple(names),
        se3.relative(T_w_base, T_w_sensor),
        np.array([c.dt_at(names[0], name, stamp) for name in names]),
        _carried(J, c.covariance),
        c.has_scale[rows],
        c.determined[rows] if names[0] == c.base else _determined_between(c, base, rows),
        clock_skew=c.clock_skew[rows] - c.clock_skew[base],
        t_ref=stamp,
    )


def _compared(a: Calibration, b: Calibration, names: Sequence[str], stamp: float) -> Comparison:
    a, b = rebased(a, names, stamp), rebased(b, names, stamp)
    known = a.determined & b.determined
    a = _with(a, known, _turned_towards(a, b, ~known[:, 3:6]))
    b = _with(b, known, b.T_base_sensor)
    difference = np.concatenate(
        [
            b.T_base_sensor[:, :3, 3] - a.T_base_sensor[:, :3, 3],
            _delta(a.T_base_sensor, b.T_base_sensor),
            (b.dt_base_sensor - a.dt_base_sensor)[:, None],
        ],
        axis=1,
    )
    difference = np.where(known, difference, np.nan)
    cov = a.covariance + b.covariance
    rows = np.arange(7 * len(names)).reshape(-1, 7)
    sensors = {name: _test(difference, cov, rows[i]) for i, name in enumerate(names) if i}
    return Comparison(a, b, difference, cov, sensors, _test(difference, cov, rows[1:].ravel()))


def _carried(J: Array, cov: Array) -> Array:
    """J: (k, 7, n, 7); cov: (7n, 7n) -> (7k, 7k)."""
    J = J.reshape(7 * len(J), -1)
    return J @ cov @ J.T


def _determined_between(c: Calibration, base: int, rows: Sequence[int]) -> NDArray[np.bool_]:
    """(k, 7) seen from another base axes mix: a pose with an unknown part is known in none of its axes."""
    position, rotation, time = np.logical_and.reduceat(c.determined, [0, 3, 6], axis=1).T
    known = np.stack(
        [position & position[base] & rotation[base], rotation & rotation[base], time & time[base]], axis=1
    )
    known[base] = True
    return np.repeat(known[rows], [3, 3, 1], axis=1)


def _with(c: Calibration, known: NDArray[np.bool_], poses: Array) -> Calibration:
    return Calibration(c.base, c.names, poses, c.dt_base_sensor, c.covariance, c.has_scale, known, t_ref=c.t_ref)


def _turned_towards(a: Calibration, b: Calibration, free: NDArray[np.bool_]) -> Array:
    """The poses of a, turned to those of b about base axes that were not determined: what is left is small."""
    poses = a.T_base_sensor.copy()
    for _ in range(10):  # two do, but for several free axes
        turn = se3.exp_so3(np.where(free, _delta(poses, b.T_base_sensor), 0.0))
        poses[:, :3, :3] = turn @ poses[:, :3, :3]
    return poses


def _delta(T_a: Array, T_b: Array) -> Array:
    """(n, 3) ``log(R_b R_a^T)``."""
    return se3.log_so3(T_b[:, :3, :3] @ np.swapaxes(T_a[:, :3, :3], 1, 2))


def _test(difference: Array, cov: Array, rows: NDArray[np.int64]) -> Agreement:
    """Those of the rows that are numbers against their covariance, which may be singular."""
    rows = rows[np.isfinite(difference.ravel()[rows])]
    d, C = difference.ravel()[rows], cov[np.ix_(rows, rows)]
    sigma = np.sqrt(np.maximum(np.diag(C), 0.0))
    unit = np.where(sigma > 0.0, sigma, 1.0)
    values, axes = np.linalg.eigh(C / np.outer(unit, unit))
    along, sure = axes.T @ (d / unit), values <= DEGENERATE
    exact = unit * (axes[:, sure] @ along[sure])  # heads of one camera share their clock, a drawing has no error
    differs = bool(np.any(np.abs(exact) > EXACT))
    chi2 = np.inf if differs else float(np.sum(along[~sure] ** 2 / values[~sure]))
    return Agreement(chi2, int(np.sum(~sure)), len(d))
