"""A calibration as a table for people."""

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.box import SIMPLE
from rich.console import Console
from rich.markup import escape
from rich.table import Table
from scipy.spatial.transform import Rotation

from calib_toolkit import delta, se3
from calib_toolkit.types import Calibration, Result
from calib_toolkit.types.calibration import WANTED

Array = NDArray[np.float64]
COLUMNS = ("x\nm", "y\nm", "z\nm", "roll\ndeg", "pitch\ndeg", "yaw\ndeg", "dt\nms")
NOISY = 1.5
"""Disagreement of two sensors, in multiples of their stated noise, from which the reader is told."""
DIGITS = (3, 3, 3, 2, 2, 2, 2)
MISSTATED = 2.0
"""Sigma of a sensor's readings over what was stated, or the other way round, from which the reader is told."""
MANY = 0.05
"""Share of a sensor's readings that were rejected from which the reader is told."""
TURNED_DEG = 0.2
"""Degrees between a sensor's travel and its turns from which the reader is told."""


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
    for note in notes(result):
        console.print(f"note: {note}", markup=False, soft_wrap=True)
    for warning in result.warnings:
        console.print(f"warning: {warning}", markup=False, soft_wrap=True)


def notes(result: Result) -> list[str]:
    """What the joint estimator found beside the calibration and a reader should know, a sentence each."""
    found = result.statistics
    rejected = [f"{share:.0%} of {n}" for n, share in found.get("rejected", {}).items() if share > MANY]
    sentences = list(_misstated(found.get("noise_scale", {})))
    if rejected:
        sentences.append(f"readings rejected because they do not fit: {', '.join(rejected)}")
    if held := found.get("prior"):
        sentences.append(f"held by measured values: {', '.join(held)}")
    turned = [f"{n} by {d:.1f} deg" for n, d in (found.get("bias_deg") or {}).items() if d > TURNED_DEG]
    if turned:
        sentences.append(
            f"travel is turned against turns: {', '.join(turned)}; a fault of that sensor's own motion, or of "
            f"{result.calibration.base}'s if all have it; the rotation lies between the two, and its sigma "
            "reaches both; from 1.5 deg on, travel alone tells it"
        )
    sentences += found.get("left_out", [])
    if found.get("pairs"):  # how long motion alone would take says nothing where appearance helps
        return sentences
    return [*sentences, *_longer(found.get("driving", {}), found.get("seconds", 0.0))]


def _misstated(scales: Mapping[str, Mapping[str, Any]]) -> Iterator[str]:
    """Whose readings are noisier, or less noisy, than was stated; sensors that are told alike in one sentence."""
    groups = defaultdict(list)
    for name, scale in scales.items():
        for part, kind in (("turns", "kind"), ("shifts", "kind_of_shifts")):
            times = float(np.sqrt(scale.get(part, 1.0)))
            if not 1 / MISSTATED <= times <= MISSTATED:
                more, alone = times > 1, scale[kind] == "own"
                groups[part, more, alone].append(f"{name} {times if more else 1 / times:.1f} times")
    for (part, more, alone), sensors in groups.items():
        whose = "told for each alone" if alone else "told for the pair, not for each"
        yield f"{part} are {'noisier' if more else 'less noisy'} than stated: {', '.join(sensors)} ({whose})"


def _longer(driving: Mapping[str, Mapping[str, float]], seconds: float) -> Iterator[str]:
    """How long to drive until all that is told is known as well as is wanted, if that is longer than was driven."""
    parts = []
    for axes, what, sensor in (
        (("x", "y", "z"), f"position above to {100 * WANTED['x']:.0f} cm", "{} {}"),
        (("rx", "ry", "rz"), f"angle above to {np.degrees(WANTED['rx']):.2f} deg", "{} about {}"),
    ):
        needs = {sensor.format(n, a[-1]): s for n, each in driving.items() for a, s in each.items() if a in axes}
        worst = max(needs, key=lambda key: needs[key], default="")
        if worst and needs[worst] > seconds:
            parts.append(f"{_duration(needs[worst])} to know every {what} ({worst} needs most)")
    if parts:
        yield f"drive like this, in all, {', and '.join(parts)}"


def _duration(seconds: float) -> str:
    if seconds < 120:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 7200 else f"{seconds / 3600:.0f} h"


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
