"""Tables I and II of the paper, of an experiment's rows, with the paper's own numbers beside them."""

from collections.abc import Callable, Sequence
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import binomtest

from calib_toolkit.evaluation.errors import DELTA, EULER, POSITION
from calib_toolkit.evaluation.paper import FULL, WITHIN
from calib_toolkit.evaluation.sights import ALONE, CONSTRAINED, INITIAL, UNCONSTRAINED
from calib_toolkit.evaluation.store import Row

Array = NDArray[np.float64]

NEAR, TURNED = 0.3, 2.0
"""Metres and degrees within which Table I counts a solution as right, each axis."""
AXES = (*POSITION, *EULER)
CHECKED = (*POSITION, *DELTA)


def tables(name: str, rows: Sequence[Row]) -> list[tuple[str, list[list[str]]]]:
    """Titles, and titles of columns with cells below, that an experiment has besides those of every parameter."""
    if name == "appearance":
        return [(f"Share within {NEAR:g} m and {TURNED:g} degrees, every axis (Table I)", within(rows))]
    if name == "full":
        return [("Mean absolute error of each sensor (Table II)", by_sensor(rows))]
    return []


def within(rows: Sequence[Row]) -> list[list[str]]:
    """Table I: what is refused is not within. Intervals are Wilson's, of 95 %."""
    table = [["metric", "search", "within %", "95 % interval", "right / all", "refused", "in the paper %"]]
    for estimator in dict.fromkeys(r["estimator"] for r in rows):
        some = [r for r in rows if r["estimator"] == estimator]
        right, metric, way = int(np.sum(right_of(some))), *_parted(estimator)
        interval = binomtest(right, len(some)).proportion_ci(method="wilson")
        paper = WITHIN.get(metric, ("", ""))[way != UNCONSTRAINED] if way != ALONE else ""
        table.append(
            [
                metric,
                way.removeprefix("-"),
                f"{100 * right / len(some):.0f}",
                f"{100 * interval.low:.0f} to {100 * interval.high:.0f}",
                f"{right} / {len(some)}",
                str(sum(r["status"] == "refused" for r in some)),
                str(paper),
            ]
        )
    return table


def right_of(rows: Sequence[Row]) -> NDArray[np.bool_]:
    """(m,) whether each row is within the limits along every axis; what is not known is not."""
    off = np.abs(values(rows, [*(f"{p}_m" for p in POSITION), *(f"{p}_deg" for p in DELTA)]))
    return np.asarray(np.all(off <= [*[NEAR] * 3, *[TURNED] * 3], axis=1))


def by_sensor(rows: Sequence[Row]) -> list[list[str]]:
    """Table II: mean absolute errors of each sensor over the repeats, its median stated sigma, and how many of all
    errors were within one, two and three of their own.
    """
    units = ["m"] * 3 + ["deg"] * 3
    head = ["sensor", "estimator", *(f"{a} {u}" for a, u in zip(AXES, units, strict=True))]
    table = [[*head, *(f"sigma {a}" for a in CHECKED), "within 1/2/3 sigma %", "left open or refused"]]
    sensors, estimators = (dict.fromkeys(r[c] for r in rows) for c in ("sensor", "estimator"))
    for sensor, estimator in product(sensors, estimators):
        some = [r for r in rows if (r["sensor"], r["estimator"]) == (sensor, estimator)]
        error, sigma = np.abs(values(some, _columns(AXES, ""))), values(some, _columns(CHECKED, "sigma_"))
        ratio = np.abs(values(some, _columns(CHECKED, ""))) / sigma
        ratio = ratio[np.isfinite(ratio)]
        within = "/".join(f"{100 * np.mean(ratio <= k):.0f}" for k in (1, 2, 3)) if len(ratio) else ""
        missing = int(np.sum(~np.isfinite(error).all(axis=1)))
        left = f"{missing} of {len(some)}" if missing else ""
        table.append([sensor, estimator, *_each(error, np.mean), *_each(sigma, np.median), within, left])
    return [*table, ["cameras", "in the paper", *(f"{v:.3f}" for v in FULL), *[""] * 8]]


def values(rows: Sequence[Row], columns: Sequence[str]) -> Array:
    """(m, k) of the named columns; nan where nothing is written."""
    return np.array([[float(r[c] or "nan") for c in columns] for r in rows], dtype=float).reshape(-1, len(columns))


def _columns(axes: Sequence[str], start: str) -> list[str]:
    return [f"{start}{a}_{'m' if a in POSITION else 'deg'}" for a in axes]


def _each(table: Array, of: Callable[[Array], Any]) -> list[str]:
    """One number of each column, over what is known."""
    known = [column[np.isfinite(column)] for column in table.T]
    return [f"{of(k):.3f}" if len(k) else "" for k in known]


def _parted(estimator: str) -> tuple[str, str]:
    """A metric and the way it was used."""
    for way in (ALONE, CONSTRAINED, UNCONSTRAINED):
        if estimator.endswith(way):
            return estimator.removesuffix(way), way
    return INITIAL, ""
