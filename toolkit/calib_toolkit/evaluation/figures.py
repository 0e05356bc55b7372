"""The figures of section VIII in the paper's form, drawn from the table of an experiment."""

from collections.abc import Callable, Sequence, Set
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib_toolkit.evaluation.errors import EULER, POSITION, UNITS
from calib_toolkit.evaluation.store import Row
from calib_toolkit.evaluation.summary import Statistics, Trial, groups, statistics, told_by_all, trial

Array = NDArray[np.float64]

OURS, THEIRS, OTHERS = "#1f5fa8", "black", ("#b2182b", "#e08214", "#762a83")


def draw(name: str, rows: Sequence[Row], file: Path) -> None:
    """Write the experiment's figure as PNG."""
    from matplotlib.figure import Figure

    figure = Figure(layout="constrained")
    DRAWN[name](figure, rows)
    figure.savefig(file, dpi=110)


def _timing(figure: Any, rows: Sequence[Row]) -> None:
    """Box plots of the absolute error by length, a panel for each spread (Fig. 6)."""
    compared = told_by_all(rows, "dt")
    spreads = sorted({float(r["spread"]) for r in rows})
    figure.set_size_inches(9.5, 3.6 * len(spreads))
    panels = figure.subplots(len(spreads), 1, sharex=True, sharey=True, squeeze=False)[:, 0]
    for panel, spread in zip(panels, spreads, strict=True):
        some = [(s, statistics(g, "dt", compared).error) for at, s, _, g in groups(rows) if at == spread]
        _boxes(panel, [e for _, e in some], [f"{s:g}" for s, _ in some], OURS)
        panel.set_yscale("log")
        panel.set_ylim(bottom=0.01)
        panel.yaxis.set_major_formatter("{x:g}")
        panel.set_title(f"clocks moved by up to {spread:g} s, either way", fontsize=10)
        panel.set_ylabel("absolute error of the offset, ms")
    panels[-1].set_xlabel("length of the section, s")


def _pair(figure: Any, rows: Sequence[Row]) -> None:
    """Mean absolute error of each parameter by length, with the band of one stated sigma (Fig. 7)."""
    figure.set_size_inches(12, 7)
    estimators = list(dict.fromkeys(r["estimator"] for r in rows))
    panels = figure.subplots(2, 3, sharex=True).ravel()
    for panel, parameter in zip(panels, (*EULER, *POSITION), strict=True):
        compared = told_by_all(rows, parameter)
        each = [(m, s, statistics(g, parameter, compared)) for _, s, m, g in groups(rows)]
        lines = {m: [(s, found) for at, s, found in each if at == m] for m in estimators}
        _band(panel, lines[estimators[0]])
        styles = [("o", OURS), ("x", THEIRS), *(("+", c) for c in OTHERS)]
        top, beyond = _top(lines, estimators), 0
        for (method, line), (marker, color) in zip(lines.items(), styles, strict=False):
            told = [(s, float(found.error.mean())) for s, found in line if len(found.error)]
            beyond += sum(e > top for _, e in told)
            if told:
                of = f"{method}, {_share([found for _, found in line])}"
                panel.plot(*zip(*told, strict=True), marker, color=color, label=of, fillstyle="none", zorder=3)
        panel.set_title(parameter + (f" ({beyond} beyond the axis)" if beyond else ""), fontsize=10)
        panel.set_ylabel(f"mean absolute error, {UNITS[parameter]}")
        panel.set_ylim(0, top)
        panel.grid(alpha=0.3)
    for panel in panels[3:]:
        panel.set_xlabel("length of the section, s")
    for panel in panels:  # each parameter is compared over other sections, so each panel says which
        if panel.get_legend_handles_labels()[0]:
            panel.legend(fontsize=7)


def _panoramic(figure: Any, rows: Sequence[Row]) -> None:
    """Box plots of the mean error over all pairs of cameras, all together against each with the first (Fig. 8)."""
    figure.set_size_inches(10, 4)
    parameters = (*EULER, "rotation")
    repeats = len({trial(r)[:4] for r in rows})
    short = {"together": "comb", "separate": "sep", "least-squares": "LS"}
    estimators = list(dict.fromkeys(r["estimator"] for r in rows))
    for panel, parameter in zip(figure.subplots(1, 4), parameters, strict=True):
        compared = told_by_all(rows, parameter)
        each = [_by_repeat([r for r in rows if r["estimator"] == m], parameter, compared) for m in estimators]
        labels = [next((s for end, s in short.items() if m.endswith(end)), m) for m in estimators]
        labels = [f"{label}\n{len(e)}/{repeats}" for label, e in zip(labels, each, strict=True)]
        _boxes(panel, each, labels, OURS)
        panel.set_title("total" if parameter == "rotation" else parameter, fontsize=10)
        panel.set_ylim(bottom=0)
    figure.axes[0].set_ylabel("mean absolute error of all pairs, deg")


DRAWN: dict[str, Callable[[Any, Sequence[Row]], None]] = {"timing": _timing, "pair": _pair, "panoramic": _panoramic}


def _boxes(panel: Any, values: Sequence[Array], labels: Sequence[str], color: str) -> None:
    panel.boxplot(
        values,
        tick_labels=labels,
        flierprops={"marker": "+", "markeredgecolor": "#b2182b", "markersize": 4},
        medianprops={"color": "#b2182b"},
        boxprops={"color": color},
        whiskerprops={"color": color, "linestyle": "--"},
    )
    panel.grid(axis="y", alpha=0.3)


def _band(panel: Any, line: Sequence[tuple[float, Statistics]]) -> None:
    """Median of the stated sigma, shaded from zero."""
    told = [(s, float(np.nanmedian(found.sigma))) for s, found in line if np.isfinite(found.sigma).any()]
    if told:
        seconds, sigma = zip(*told, strict=True)
        panel.fill_between(seconds, 0, sigma, color=OURS, alpha=0.2, lw=0, label="one sigma, as stated")


def _top(lines: dict[str, list[tuple[float, Statistics]]], estimators: Sequence[str]) -> float:
    """Upper end of the axis: what ours and most of least squares need, so that one wild value flattens no other."""
    ours = [v for _, s in lines[estimators[0]] if len(s.error) for v in (s.error.mean(), np.nanmedian(s.sigma))]
    plain = [s.error.mean() for m in estimators[1:2] for _, s in lines[m] if len(s.error)]
    all_of_them = [*ours, *plain]
    return 1.1 * float(min(max(all_of_them), 3 * np.percentile(all_of_them, 75))) if all_of_them else 1.0


def _share(found: Sequence[Statistics]) -> str:
    """Over how many of the sections something is told."""
    return f"{sum(len(f.error) for f in found)} of {sum(f.sections for f in found)}"


def _by_repeat(rows: Sequence[Row], parameter: str, compared: Set[Trial]) -> Array:
    """(k,) mean absolute error over the pairs of each repeat for which all are known."""
    repeats: dict[tuple[str, ...], list[Row]] = {}
    for row in rows:
        repeats.setdefault(trial(row)[:4], []).append(row)
    found = [statistics(some, parameter, compared) for some in repeats.values()]
    return np.array(
        [s.error.mean() for s, some in zip(found, repeats.values(), strict=True) if len(s.error) == len(some)]
    )
