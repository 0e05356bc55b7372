"""The figures of section VIII in the paper's form, drawn from the table of an experiment."""

from collections.abc import Callable, Sequence, Set
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib_toolkit.config import METHODS
from calib_toolkit.evaluation import seen
from calib_toolkit.evaluation.baselines import LEAST_SQUARES, OPENCV_METHODS
from calib_toolkit.evaluation.errors import EULER, POSITION, UNITS
from calib_toolkit.evaluation.measures import SEPARATE, TOGETHER
from calib_toolkit.evaluation.seen import box
from calib_toolkit.evaluation.store import Row
from calib_toolkit.evaluation.summary import Statistics, Trial, groups, statistics, told_by_all, trial

Array = NDArray[np.float64]
Line = list[tuple[float, Statistics]]
"""One estimator's errors by length."""
Drawing = Callable[[Any, Sequence[Row]], list[Any]]
"""Fills a figure with a table's rows; returns the entries of its legend."""

OURS, OTHERS = ("#1f5fa8", "#d95f02", "#1b9e77"), ("black", "#b2182b", "#762a83", "#8c6d1f")
STYLES = {
    **{m: ("o", c) for m, c in zip(METHODS, cycle(OURS), strict=False)},
    **{m: ("x", c) for m, c in zip((LEAST_SQUARES, *OPENCV_METHODS), OTHERS, strict=False)},
}
"""Marker and colour of each method and baseline, the same in every figure."""
ENDINGS = {TOGETHER: "comb", SEPARATE: "sep"}
SHARE = 0.8
"""Of the room between two lengths, the part that boxes fill."""


def draw(name: str, rows: Sequence[Row], file: Path) -> None:
    """Write the experiment's figure as PNG."""
    from matplotlib.figure import Figure

    figure = Figure(layout="constrained", dpi=110)
    fill(name, figure, rows)
    figure.savefig(file)


def fill(name: str, figure: Any, rows: Sequence[Row]) -> None:
    """Draw the experiment into an empty figure, with one legend for all panels below them, where no curve is."""
    handles = DRAWN[name](figure, rows)
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles), fontsize=9, frameon=False)


def _timing(figure: Any, rows: Sequence[Row]) -> list[Any]:
    """Box plots of the absolute error by length, a panel for each spread (Fig. 6)."""
    compared = told_by_all(rows, "dt")
    spreads = sorted({float(r["spread"]) for r in rows})
    lengths = sorted({float(r["seconds"]) for r in rows})
    methods = list(dict.fromkeys(r["estimator"] for r in rows))
    figure.set_size_inches(9.5, 3.6 * len(spreads))
    panels = figure.subplots(len(spreads), 1, sharex=True, sharey=True, squeeze=False)[:, 0]
    for panel, spread in zip(panels, spreads, strict=True):
        room = SHARE / len(methods)
        for at, seconds, method, some in groups(rows):
            if at == spread:
                place = lengths.index(seconds) + (methods.index(method) - (len(methods) - 1) / 2) * room
                box(panel, statistics(some, "dt", compared).error, place, 0.8 * room, STYLES[method][1])
        panel.set_xticks(range(len(lengths)), [f"{s:g}" for s in lengths])
        panel.set_xlim(-0.6, len(lengths) - 0.4)
        panel.set_yscale("log")
        panel.set_ylim(bottom=0.01)
        panel.yaxis.set_major_formatter("{x:g}")
        panel.set_title(f"clocks moved by up to {spread:g} s, either way", fontsize=10)
        panel.set_ylabel("absolute error of the offset, ms")
        panel.grid(axis="y", alpha=0.3)
    panels[-1].set_xlabel("length of the section, s")
    return [_frame(m) for m in methods]


def _pair(figure: Any, rows: Sequence[Row]) -> list[Any]:
    """Mean absolute error of each parameter by length, with the band of one stated sigma (Fig. 7)."""
    from matplotlib.patches import Patch

    figure.set_size_inches(12, 7)
    panels = figure.subplots(2, 3, sharex=True).ravel()
    for panel, parameter in zip(panels, (*EULER, *POSITION), strict=True):
        compared = told_by_all(rows, parameter)
        lines: dict[str, Line] = {}
        for _, seconds, method, some in groups(rows):
            lines.setdefault(method, []).append((seconds, statistics(some, parameter, compared)))
        top, beyond = _top(lines), 0
        for method, line in lines.items():
            marker, color = STYLES[method]
            told = [(s, float(found.error.mean())) for s, found in line if len(found.error)]
            beyond += sum(e > top for _, e in told)
            _band(panel, line, color)
            if told:
                panel.plot(*zip(*told, strict=True), marker, color=color, fillstyle="none", zorder=3)
        # each parameter is compared over other sections, so each panel says over how many
        hidden = f", {beyond} points above" if beyond else ""
        panel.set_title(f"{parameter}: {_share(lines)} sections{hidden}", fontsize=10)
        panel.set_ylabel(f"mean absolute error, {UNITS[parameter]}")
        panel.set_ylim(0, top)
        panel.grid(alpha=0.3)
    for panel in panels[3:]:
        panel.set_xlabel("length of the section, s")
    sigma = Patch(facecolor="#e5e5e5", edgecolor="grey", label="one sigma as stated, in the method's colour")
    return [*(_marker(m) for m in dict.fromkeys(r["estimator"] for r in rows)), sigma]


def _panoramic(figure: Any, rows: Sequence[Row]) -> list[Any]:
    """Box plots of the mean error over all pairs of cameras, all together against each with the first (Fig. 8)."""
    from matplotlib.lines import Line2D

    figure.set_size_inches(12, 4)
    repeats = len({trial(r)[:4] for r in rows})
    estimators = list(dict.fromkeys(r["estimator"] for r in rows))
    for panel, parameter in zip(figure.subplots(1, 4), (*EULER, "rotation"), strict=True):
        compared = told_by_all(rows, parameter)
        labels = []
        for place, estimator in enumerate(estimators):
            error = _by_repeat([r for r in rows if r["estimator"] == estimator], parameter, compared)
            box(panel, error, place, 0.6, STYLES[_method(estimator)][1])
            way = next((short for ending, short in ENDINGS.items() if estimator.endswith(ending)), "LS")
            labels.append(f"{way}\n{len(error)}/{repeats}")
        panel.set_xticks(range(len(estimators)), labels, fontsize=7.5)
        panel.set_title("total" if parameter == "rotation" else parameter, fontsize=10)
        panel.set_ylim(bottom=0)
        panel.grid(axis="y", alpha=0.3)
    figure.axes[0].set_ylabel("mean absolute error of all pairs, deg")
    ways = Line2D([], [], ls="", label="comb: all cameras at once; sep: each with the first; n/m: sections compared")
    return [*(_frame(m) for m in dict.fromkeys(map(_method, estimators))), ways]


DRAWN: dict[str, Drawing] = {
    "timing": _timing,
    "pair": _pair,
    "panoramic": _panoramic,
    "appearance": seen.appearance,
    "full": seen.full,
}


def _method(estimator: str) -> str:
    """The method or baseline, in whatever way it was used."""
    for ending in ENDINGS:
        estimator = estimator.removesuffix(ending)
    return estimator


def _frame(method: str) -> Any:
    from matplotlib.patches import Patch

    return Patch(fill=False, edgecolor=STYLES[method][1], linewidth=1.5, label=method)


def _marker(method: str) -> Any:
    from matplotlib.lines import Line2D

    marker, color = STYLES[method]
    return Line2D([], [], marker=marker, color=color, ls="", fillstyle="none", label=method)


def _band(panel: Any, line: Line, color: str) -> None:
    """Median of the stated sigma, shaded from zero."""
    told = [(s, float(np.nanmedian(found.sigma))) for s, found in line if np.isfinite(found.sigma).any()]
    if told:
        seconds, sigma = zip(*told, strict=True)
        panel.fill_between(seconds, 0, sigma, color=color, alpha=0.1, lw=0)
        panel.plot(seconds, sigma, "_-", color=color, lw=0.8)


def _top(lines: dict[str, Line]) -> float:
    """Upper end of the axis: what the methods and most of least squares need; one wild value flattens no other."""
    needed = []
    for method, line in lines.items():
        for _, found in line if method in (*METHODS, LEAST_SQUARES) else ():
            needed += [found.error.mean()] if len(found.error) else []
            needed += [np.nanmedian(found.sigma)] if np.isfinite(found.sigma).any() else []
    return 1.1 * float(min(max(needed), 3 * np.percentile(needed, 75))) if needed else 1.0


def _share(lines: dict[str, Line]) -> str:
    """Over how many of the sections the estimators are compared."""
    told = [max(len(found.error) for found in at) for at in _by_length(lines)]
    return f"{sum(told)} of {sum(at[0].sections for at in _by_length(lines))}"


def _by_length(lines: dict[str, Line]) -> list[list[Statistics]]:
    return [[found for _, found in at] for at in zip(*lines.values(), strict=True)]


def _by_repeat(rows: Sequence[Row], parameter: str, compared: Set[Trial]) -> Array:
    """(k,) mean absolute error over the pairs of each repeat for which all are known."""
    repeats: dict[tuple[str, ...], list[Row]] = {}
    for row in rows:
        repeats.setdefault(trial(row)[:4], []).append(row)
    found = [statistics(some, parameter, compared) for some in repeats.values()]
    return np.array(
        [s.error.mean() for s, some in zip(found, repeats.values(), strict=True) if len(s.error) == len(some)]
    )
