"""Figures of the experiments on what the sensors see: Fig. 10 and Fig. 12 of the paper."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib_toolkit.evaluation.errors import DELTA, EULER, POSITION, UNITS
from calib_toolkit.evaluation.paper import FULL
from calib_toolkit.evaluation.shares import NEAR, TURNED, values
from calib_toolkit.evaluation.sights import COMBINED, CONSTRAINED, INITIAL, MOTION, UNCONSTRAINED
from calib_toolkit.evaluation.store import Row

Array = NDArray[np.float64]

COLORS = ("#1f5fa8", "#d95f02", "#1b9e77", "#762a83", "#b2182b", "#8c6d1f")
"""Of metrics, methods or sensors, in the order of the table."""
BEFORE = "#7f7f7f"
ROOM = 0.8
"""Of the room between two parameters, the part that boxes fill."""
AXIS = 1.6
"""Times the limits of Table I that an axis of constrained errors shows at most."""


def appearance(figure: Any, rows: Sequence[Row]) -> list[Any]:
    """Box plots of signed errors: searched everywhere, and constrained by the motion (Fig. 10)."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    metrics = [e.removesuffix(CONSTRAINED) for e in _estimators(rows) if e.endswith(CONSTRAINED)]
    colors = {INITIAL: BEFORE, **dict(zip(metrics, _cycled(len(metrics)), strict=True))}
    figure.set_size_inches(11, 7.5)
    panels = figure.subplots(2, 2)
    for line, (ending, words) in zip(
        panels, ((CONSTRAINED, "constrained by the motion"), (UNCONSTRAINED, "searched everywhere")), strict=True
    ):
        shown = {INITIAL: INITIAL, **{m: f"{m}{ending}" for m in metrics}}
        for panel, axes, limit in ((line[0], EULER, TURNED), (line[1], POSITION, NEAR)):
            errors = [_errors([r for r in rows if r["estimator"] == e], axes) for e in shown.values()]
            top = _top(errors, AXIS * limit) if ending == CONSTRAINED else None
            beyond = 0
            for k, (metric, error) in enumerate(zip(shown, errors, strict=True)):
                for place, column in enumerate(error.T):
                    width = ROOM / len(shown)
                    known = column[np.isfinite(column)]
                    at = place + (k - (len(shown) - 1) / 2) * width
                    box(panel, known, at, 0.8 * width, colors[metric])
                    beyond += int(np.sum(np.abs(known) > top)) if top else 0
            if top:
                panel.set_ylim(-top, top)
            panel.axhline(0, color="black", lw=0.6)
            for edge in (-limit, limit):
                panel.axhline(edge, color="black", lw=0.8, ls=":")
            panel.set_xticks(range(3), axes)
            panel.set_xlim(-0.5, 2.5)
            panel.set_ylabel(f"error, {UNITS[axes[0]]}")
            left = f", {beyond} value{'s' * (beyond > 1)} beyond" if beyond else ""
            panel.set_title(f"{words}{left}", fontsize=10)
            panel.grid(axis="y", alpha=0.3)
    limits = Line2D([], [], color="black", lw=0.8, ls=":", label=f"{TURNED:g} degrees, {NEAR:g} m")
    names = {INITIAL: "start, as motion leaves it"}
    return [
        *(Patch(fill=False, edgecolor=c, linewidth=1.5, label=names.get(m, m)) for m, c in colors.items()),
        limits,
    ]


def full(figure: Any, rows: Sequence[Row]) -> list[Any]:
    """Errors of every run with their stated sigma, by sensor, before and after appearance (Fig. 12)."""
    from matplotlib.lines import Line2D

    sensors = list(dict.fromkeys(r["sensor"] for r in rows))
    methods = [e.removesuffix(COMBINED) for e in _estimators(rows) if e.endswith(COMBINED)]
    figure.set_size_inches(12, 7)
    panels = figure.subplots(2, 3).ravel()
    order = zip(panels, (*EULER, *POSITION), (*DELTA, *POSITION), (*FULL[3:], *FULL[:3]), strict=True)
    for panel, parameter, checked, paper in order:
        needed = [paper]
        for m, method in enumerate(methods):
            for s, sensor in enumerate(sensors):
                width = ROOM / len(methods)
                left = s - ROOM / 2 + m * width
                for ending, color in ((MOTION, BEFORE), (COMBINED, _cycled(len(methods))[m])):
                    some = [r for r in rows if r["sensor"] == sensor and r["estimator"] == f"{method}{ending}"]
                    # the same errors as the sigma's: about base axes
                    error = _errors(some, (checked,))[:, 0]
                    sigma = values(some, [f"sigma_{checked}_{UNITS[checked]}"])[:, 0]
                    shift = 0.3 if ending == MOTION else 0.7
                    at = left + width * (np.arange(len(error)) + shift) / max(len(error), 1)
                    known = np.isfinite(error) & np.isfinite(sigma)
                    hollow = {"mfc": "white"} if ending == MOTION else {}
                    panel.errorbar(
                        at[known], error[known], sigma[known], fmt="o", ms=3, lw=0.7, color=color, **hollow
                    )
                    if known.any():
                        # bars of the motion alone would leave no room to see the others
                        reach = np.abs(error[known]) + (2 * sigma[known] if ending == COMBINED else 0.0)
                        needed.append(float(reach.max()))
        panel.axhline(0, color="black", lw=0.6)
        for edge in (-paper, paper):
            panel.axhline(edge, color="black", lw=0.8, ls=":")
        panel.set_ylim(-1.15 * max(needed), 1.15 * max(needed))
        panel.set_xticks(range(len(sensors)), sensors)
        panel.set_xlim(-0.5, len(sensors) - 0.5)
        about = "" if parameter == checked else f" (about {checked[-1]} of the base)"
        panel.set_title(f"{parameter}{about}", fontsize=10)
        panel.set_ylabel(f"error and stated sigma, {UNITS[parameter]}")
        panel.grid(axis="y", alpha=0.3)
    dots = [
        Line2D([], [], marker="o", ls="", color=c, label=f"{m}, motion and appearance")
        for m, c in zip(methods, _cycled(len(methods)), strict=True)
    ]
    motion = Line2D([], [], marker="o", ls="", color=BEFORE, mfc="white", label="motion alone")
    return [*dots, motion, Line2D([], [], color="black", lw=0.8, ls=":", label="mean absolute error in the paper")]


def box(panel: Any, values: Array, place: float, width: float, color: str) -> None:
    """One box of values (k,) in the style of all figures; nothing if there are none."""
    if not len(values):
        return
    panel.boxplot(
        [values],
        positions=[place],
        widths=width,
        manage_ticks=False,
        flierprops={"marker": "+", "markeredgecolor": color, "markersize": 4},
        medianprops={"color": color, "linewidth": 2},
        boxprops={"color": color},
        capprops={"color": color},
        whiskerprops={"color": color, "linestyle": "--"},
    )


def _top(errors: Sequence[Array], most: float) -> float:
    """End of an axis on which all errors are seen, or those up to the most."""
    told = np.concatenate([np.abs(e[np.isfinite(e)]) for e in errors])
    return min(1.15 * float(told.max(initial=0.02 * most)), most)


def _errors(rows: Sequence[Row], axes: Sequence[str]) -> Array:
    return values(rows, [f"{a}_{UNITS[a]}" for a in axes])


def _estimators(rows: Sequence[Row]) -> list[str]:
    return list(dict.fromkeys(r["estimator"] for r in rows))


def _cycled(n: int) -> list[str]:
    return [COLORS[k % len(COLORS)] for k in range(n)]
