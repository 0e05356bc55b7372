"""The table of an experiment in numbers that can be compared: Markdown."""

from collections.abc import Iterator, Sequence, Set
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib_toolkit.evaluation import shares
from calib_toolkit.evaluation.errors import DELTA, EULER, UNITS
from calib_toolkit.evaluation.experiment import Outcome
from calib_toolkit.evaluation.paper import beside
from calib_toolkit.evaluation.protocols import PROTOCOLS
from calib_toolkit.evaluation.store import Row

Array = NDArray[np.float64]

Trial = tuple[str, str, str, str, str]
"""Drive, seconds, spread, repeat and sensor, as the table has them."""

CHECKED_AS = dict(zip(EULER, DELTA, strict=True))
"""A stated sigma is of ``delta``, so errors are held against it as delta and not as Euler angles."""
DIGITS = {"deg": 3, "m": 3, "ms": 2}
TITLES = (
    *("median", "p95", "worst", "mean", "RMS", "sigma", "within 1/2/3 sigma %"),
    *("sections", "refused", "left open", "not by all", "no truth"),
)


@dataclass(frozen=True)
class Statistics:
    """Of one parameter over all rows of one length, spread and estimator.

    error: (k,) absolute errors; sigma: (k,) as stated of them, nan where none is; checked, stated: (k,) the same in
    the axes in which they are held against each other. sections, refused: how many repeats; undetermined, not_by_all,
    no_truth: how many rows the errors leave out.
    """

    error: Array
    sigma: Array
    checked: Array
    stated: Array
    sections: int
    refused: int
    undetermined: int
    not_by_all: int
    no_truth: int

    def within(self, k: float) -> float:
        """Share of the errors that are at most k times what was stated of them; nan if nothing was."""
        told = np.isfinite(self.stated)
        return float(np.mean(self.checked[told] <= k * self.stated[told])) if told.any() else np.nan


def numbers(rows: Sequence[Row], column: str) -> Array:
    """(m,) one column; nan where nothing is written."""
    return np.array([float(r[column] or "nan") if column in r else np.nan for r in rows], dtype=float)


def groups(rows: Sequence[Row]) -> Iterator[tuple[float, float, str, list[Row]]]:
    """Rows by spread, length and estimator, in the order of the table: (spread, seconds, estimator, rows)."""
    found: dict[tuple[float, float, str], list[Row]] = {}
    for row in rows:
        found.setdefault((float(row["spread"]), float(row["seconds"]), row["estimator"]), []).append(row)
    # lengths first, as they are planned; a table is easier to read by spread
    for spread, seconds, estimator in sorted(found, key=lambda k: k[:2]):
        yield spread, seconds, estimator, found[spread, seconds, estimator]


def told_by_all(rows: Sequence[Row], parameter: str) -> set[Trial]:
    """What every estimator tells of one parameter, so that all are compared over the same; an estimator that tells
    nothing at all of a length does not count there.
    """
    lengths: dict[tuple[float, float], list[set[Trial]]] = {}
    for spread, seconds, _, some in groups(rows):
        known = np.isfinite(_column(some, parameter))
        told = {trial(r) for r, yes in zip(some, known, strict=True) if yes}
        if told:
            lengths.setdefault((spread, seconds), []).append(told)
    return set().union(*(set.intersection(*told) for told in lengths.values()))


def trial(row: Row) -> Trial:
    """Which sensors of which section a row is about, whoever estimated."""
    return row["drive"], row["seconds"], row["spread"], row["repeat"], row["sensor"]


def statistics(rows: Sequence[Row], parameter: str, compared: Set[Trial]) -> Statistics:
    """Of one parameter over one estimator's rows, its errors over the trials compared."""
    error, checked = (_column(rows, p) for p in (parameter, CHECKED_AS.get(parameter, parameter)))
    sigma, stated = (_column(rows, f"sigma_{p}") for p in (parameter, CHECKED_AS.get(parameter, parameter)))
    known = np.isfinite(error)
    kept = known & np.array([trial(r) in compared for r in rows])
    refused = np.array([r["status"] == "refused" for r in rows])
    undetermined = np.array([parameter in r["undetermined"].split() for r in rows])
    repeats = [(r["drive"], r["repeat"]) for r in rows]
    return Statistics(
        np.abs(error[kept]),
        sigma[kept],
        np.abs(checked[kept]),
        stated[kept],
        len(set(repeats)),
        len({key for key, no in zip(repeats, refused, strict=True) if no}),
        int(undetermined.sum()),
        int((known & ~kept).sum()),
        int((~known & ~refused & ~undetermined).sum()),
    )


def markdown(name: str, done: Outcome, notes: Sequence[str] = ()) -> str:
    """The whole summary: one table for each parameter, then what was skipped."""
    rows = done.rows
    experiment = PROTOCOLS[name]
    parts = [f"# {experiment.title}", "", f"![{experiment.title}]({name}.png)", "", *_explained(done)]
    for title, lines in shares.tables(name, rows):
        parts += ["", f"## {title}", "", *map(_line, (lines[0], ["---"] * len(lines[0]), *lines[1:]))]
    for parameter in experiment.parameters:
        if lines := table(name, rows, parameter):
            rule = ["---"] * len(lines[0])
            parts += ["", f"## {parameter} ({UNITS[parameter]})", "", *map(_line, (lines[0], rule, *lines[1:]))]
    left_out = [*(f"- {s}" for s in (*done.skipped, *notes)), *_refusals(rows)]
    if left_out:
        parts += ["", "## Left out", "", *left_out]
    return "\n".join(parts) + "\n"


def table(name: str, rows: Sequence[Row], parameter: str) -> list[list[str]]:
    """Titles and cells of one parameter's table; nothing if nobody estimated it."""
    spread_matters = len(PROTOCOLS[name].spreads) > 1
    head = ["seconds", *(["moved by"] if spread_matters else []), "estimator", *TITLES, "paper"]
    lines, compared = [], told_by_all(rows, parameter)
    for spread, seconds, estimator, some in groups(rows):
        s = statistics(some, parameter, compared)
        if not len(s.error) and not s.not_by_all and s.no_truth:
            continue  # never estimated, or nobody knows better
        where = [f"{seconds:g}", *([f"+-{spread:g} s"] if spread_matters else []), estimator]
        paper = beside(name, parameter, seconds, spread)
        lines.append([*where, *_cells(s, DIGITS[UNITS[parameter]]), paper])
    return [head, *lines] if lines else []


def _column(rows: Sequence[Row], parameter: str) -> Array:
    return numbers(rows, f"{parameter}_{UNITS[parameter.removeprefix('sigma_')]}")


def _cells(s: Statistics, digits: int) -> list[str]:
    counts = [str(n) for n in (s.sections, s.refused, s.undetermined, s.not_by_all, s.no_truth)]
    if not len(s.error):
        return [""] * 7 + counts
    e = s.error
    values = [np.median(e), np.percentile(e, 95), e.max(), e.mean(), np.sqrt(np.mean(e**2))]
    stated = np.isfinite(s.stated).any()
    return [
        *(f"{v:.{digits}f}" for v in values),
        f"{np.nanmedian(s.sigma):.{digits}f}" if stated else "",
        "/".join(f"{100 * s.within(k):.0f}" for k in (1, 2, 3)) if stated else "",
        *counts,
    ]


def _explained(done: Outcome) -> list[str]:
    rows = done.rows
    apart = ", ".join(f"{n} of {seconds:g} s" for seconds, n in done.apart.items())
    drives = dict.fromkeys(r["drive"] for r in rows)
    refused = sum(r["status"] == "refused" for r in rows)
    return [
        f"{len(rows)} rows from {', '.join(drives)}, {refused} of them refused. Absolute errors against the truth. "
        "Sigma is the median of what was stated; within counts the errors of at most one, two and three times their "
        "own stated sigma. Left open are values that an estimator says it did not determine: counted, and not among "
        "the errors. Not by all counts its answers where another estimator has none: all are compared over the same.",
        "",
        "Sections are drawn at random and overlap, and rows of one section are one experiment. Sections that can be "
        f"independent, at most: {apart}.",
    ]


def _refusals(rows: Sequence[Row]) -> list[str]:
    """Each kind of refusal once, with how often it came."""
    notes = [f"{r['estimator']}: {r['note']}" for r in rows if r["status"] == "refused"]
    return [f"- {notes.count(note)} x {note}" for note in dict.fromkeys(notes)]


def _line(cells: Sequence[str]) -> str:
    return "| " + " | ".join(c.replace("|", "/") for c in cells) + " |"
