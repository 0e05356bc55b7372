"""A calibration as a table for people."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from rich.box import SIMPLE
from rich.console import Console
from rich.markup import escape
from rich.table import Table
from scipy.spatial.transform import Rotation

from calib_toolkit import delta, se3
from calib_toolkit.types import Calibration, Result

Array = NDArray[np.float64]
COLUMNS = ("x\nm", "y\nm", "z\nm", "roll\ndeg", "pitch\ndeg", "yaw\ndeg", "dt\nms")
NOISY = 1.5
"""Disagreement of two sensors, in multiples of their stated noise, from which the reader is told."""
DIGITS = (3, 3, 3, 2, 2, 2, 2)


def show_result(result: Result, console: Console, reference: Calibration | None = None, middle: float = 0.0) -> None:
    """Print the calibration, what was not determined and the warnings; beside a reference, if there is one.

    middle: stamp of the middle of the drive, at which a reference whose clocks drift is shown.
    """
    c = result.calibration
    console.print(f"\nPose of each sensor in {escape(c.base)} (maps its points to {escape(c.base)}), one sigma:")
    table = Table("sensor", "", box=SIMPLE, padding=(0, 1, 0, 0))
    for column in COLUMNS:
        table.add_column(column, justify="right", no_wrap=True)
    for name in c.names[1:]:
        values, sigma = readable(c, name)
        table.add_row(escape(name), "estimate", *_cells(values))
        table.add_row("", "sigma", *_cells(sigma))
        if reference is not None and {name, c.base} <= set(reference.names):
            there = _rebased(reference, c.base, name, middle)
            table.add_row("", "reference", *_cells(there))
            table.add_row("", "difference", *_cells(_difference(values, there)), end_section=True)
    console.print(table)
    for u in c.undetermined:
        console.print(f"not determined: {u.sentence}", markup=False, soft_wrap=True)
    noisy = {pair: times for pair, times in result.statistics.get("disagreement", {}).items() if times > NOISY}
    if noisy:
        pair, times = max(noisy.items(), key=lambda item: item[1])
        console.print(
            f"note: {len(noisy)} pair(s) of sensors turn differently by more than their stated noise explains, "
            f"{pair} {times:.1f} times as much; their sigmas are too small by about that",
            markup=False,
            soft_wrap=True,
        )
    for warning in result.warnings:
        console.print(f"warning: {warning}", markup=False, soft_wrap=True)


def readable(c: Calibration, name: str) -> tuple[Array, Array]:
    """Pose and offset for people, and their sigma: (7,) metres, degrees and milliseconds; nan if not determined.

    Roll, pitch and yaw as in ``R = Rz(yaw) Ry(pitch) Rx(roll)``.
    """
    i = c.index(name)
    R = c.T_base_sensor[i, :3, :3]
    J = delta.jacobian(lambda d: _euler(se3.exp_so3(d) @ R), np.zeros(3))
    cov = J @ c.covariance[7 * i + 3 : 7 * i + 6, 7 * i + 3 : 7 * i + 6] @ J.T
    known = c.determined[i]
    # an angle is only as determined as every axis it depends on
    angle_known = [not np.any(np.abs(J[k, ~known[3:6]]) > 0.1) for k in range(3)]
    values = np.concatenate([c.T_base_sensor[i, :3, 3], np.degrees(_euler(R)), [1e3 * c.dt_base_sensor[i]]])
    sigma = np.concatenate([c.sigma[i, :3], np.degrees(np.sqrt(np.diag(cov))), [1e3 * c.sigma[i, 6]]])
    shown = np.concatenate([known[:3], angle_known, known[6:]])
    return np.where(shown, values, np.nan), np.where(shown, sigma, np.nan)


def _euler(R: Array) -> Array:
    return Rotation.from_matrix(R).as_euler("ZYX")[::-1]


def _rebased(reference: Calibration, base: str, name: str, middle: float) -> Array:
    T = reference.between(base, name).T_a_b
    timed = reference.determined[[reference.index(base), reference.index(name)], 6].all()
    dt = reference.dt_at(base, name, middle) if timed else np.nan
    return np.concatenate([T[:3, 3], np.degrees(_euler(T[:3, :3])), [1e3 * dt]])


def _difference(values: Array, there: Array) -> Array:
    difference = values - there
    difference[3:6] = (difference[3:6] + 180.0) % 360.0 - 180.0
    return difference


def _cells(values: Sequence[float] | Array) -> list[str]:
    return ["-" if not np.isfinite(v) else f"{v:.{d}f}" for v, d in zip(values, DIGITS, strict=True)]
