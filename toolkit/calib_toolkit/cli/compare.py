"""``calib-toolkit compare``: whether two calibrations of one rig say the same."""

from pathlib import Path
from typing import TYPE_CHECKING

import click

if TYPE_CHECKING:
    from rich.table import Table

    from calib_toolkit.comparison import Agreement, Comparison

NUMBERS = ("x", "y", "z", "roll", "pitch", "yaw", "dt")
UNITS = ("m", "m", "m", "deg", "deg", "deg", "ms")
DIGITS = (4, 4, 4, 3, 3, 3, 3)
STANDS_OUT = 3.0
"""Sigmas from which one number alone explains why a sensor differs."""


@click.command()
@click.argument("a", metavar="A.json", type=click.Path(path_type=Path))
@click.argument("b", metavar="B.json", type=click.Path(path_type=Path))
@click.pass_context
def compare(ctx: click.Context, a: Path, b: Path) -> None:
    """Show how B.json differs from A.json, two results of one rig, and whether chance explains it.

    For drift: results from drives of different days tell whether a sensor has moved since. For repeatability: results
    from separate parts of a drive, or from drives of one day, should agree; if they do not, the stated sigmas are too
    small. The two must not rest on the same data, or they agree too easily.

    They agree where a difference as large comes about by chance in more than one case of a hundred (chi-square over
    all that both determine). Exit status 0 if they agree, 3 if they differ, 1 if there is nothing to compare, with
    the reason.
    """

    from calib_toolkit import comparison
    from calib_toolkit.cli.screen import screen
    from calib_toolkit.errors import DataError
    from calib_toolkit.result_file import read_calibration

    first, second = read_calibration(a), read_calibration(b)
    try:
        found = comparison.compare(first, second)
    except DataError as e:
        raise DataError(f"{a} and {b} can not be compared: {e}") from e
    console = screen()
    base = found.a.base
    console.print(f"\n{b} minus {a}, each sensor in {base}:", markup=False, soft_wrap=True)
    console.print(_table(found))
    exact = [str(file) for file, c in ((a, first), (b, second)) if not c.covariance.any()]
    if exact:
        said = f"{' and '.join(exact)}: no sigma is stated, so the numbers are taken as exact"
        console.print(said, markup=False, soft_wrap=True)
    for sentence in _sentences(found):
        console.print(sentence, markup=False, soft_wrap=True)
    if found.overall.differs:
        ctx.exit(3)


def _table(found: "Comparison") -> "Table":
    from rich.box import SIMPLE
    from rich.markup import escape
    from rich.table import Table

    table = Table("sensor", "", box=SIMPLE, padding=(0, 1, 0, 0))
    for name, unit in zip(NUMBERS, UNITS, strict=True):
        table.add_column(f"{name}\n{unit}", justify="right", no_wrap=True)
    table.add_column("")
    for name, test in found.sensors.items():
        difference, sigma, times = _readable(found, name)
        table.add_row(escape(name), "difference", *_cells(difference, DIGITS), _verdict(test))
        table.add_row("", "sigma", *_cells(sigma, DIGITS), f"p {_chance(test.p)}" if test.compared else "")
        table.add_row("", "in sigmas", *_cells(times, (1,) * 7), end_section=True)
    return table


def _readable(found: "Comparison", name: str) -> tuple[list[float], list[float], list[float]]:
    """A sensor's differences in the units of the table, their sigma, and the one in multiples of the other."""
    import numpy as np

    from calib_toolkit.cli.tables import readable

    (values_a, sigma_a), (values_b, sigma_b) = readable(found.a, name), readable(found.b, name)
    difference, sigma = values_b - values_a, np.hypot(sigma_a, sigma_b)
    difference[3:6] = (difference[3:6] + 180.0) % 360.0 - 180.0
    times = np.divide(difference, sigma, out=np.full(7, np.nan), where=sigma > 0)
    return difference.tolist(), sigma.tolist(), times.tolist()


def _sentences(found: "Comparison") -> list[str]:
    """What the numbers mean: each sensor that differs, and the verdict on the whole."""
    from itertools import combinations

    from calib_toolkit.comparison import CHANCE, within

    base, names, overall = found.a.base, list(found.sensors), found.overall
    moved = [name for name, test in found.sensors.items() if test.differs]
    said = [f"{name} moved: {_worst(found, name)}" for name in moved]
    if len(moved) == len(names) > 1 and within(found, names).overall.p > CHANCE:
        said.append(f"it is {base} itself that moved: {', '.join(names)} all differ from it, but not from each other")
    if overall.differs and not moved:
        pairs = [within(found, pair) for pair in combinations(names, 2)]
        pair = min(pairs, key=lambda pair: pair.overall.p if pair.overall.compared else 1.0)
        one, other = pair.a.names
        said.append(
            f"no sensor alone differs from {base}, but all together do; seen from one another, most of all {other} "
            f"from {one}: {_worst(pair, other)}"
        )
    if moved and not overall.differs:
        said.append(
            f"all sensors together show no more than chance, by which one in {1 / CHANCE:.0f} stands out alone"
        )
    verdict = "differ" if overall.differs else "agree"
    return [
        *said,
        f"the calibrations {verdict}: chi-square {overall.chi2:.1f} of {overall.dof}, p {_chance(overall.p)}",
    ]


def _worst(found: "Comparison", name: str) -> str:
    """The number of a sensor that differs most."""
    difference, sigma, times = _readable(found, name)
    together = f"all numbers together (p {_chance(found.sensors[name].p)})"
    shown = [k for k in range(7) if difference[k] == difference[k]]
    exact = [k for k in shown if sigma[k] == 0.0 and abs(difference[k]) > 1e-9]
    told = exact or [k for k in shown if sigma[k] > 0.0]
    if not told:
        return together
    k = max(told, key=lambda k: abs(difference[k] if exact else times[k]))
    by = f"{NUMBERS[k]} by {_round(difference[k], DIGITS[k])} {UNITS[k]}"
    if exact:
        return f"{by}, where both are exact"
    by += f", {abs(times[k]):.1f} sigma"
    return by if abs(times[k]) >= STANDS_OUT else f"{together}, most of all {by}"


def _verdict(test: "Agreement") -> str:
    if not test.compared:
        return "-"
    return "differ" if test.differs else "agree"


def _chance(p: float) -> str:
    return f"= {p:.2f}" if p >= 0.1 else f"= {p:.3f}" if p >= 0.001 else "< 0.001"


def _cells(values: list[float], digits: tuple[int, ...]) -> list[str]:
    return [_round(v, d) if v == v else "-" for v, d in zip(values, digits, strict=True)]


def _round(value: float, digits: int) -> str:
    """With so many decimals, and without a minus before a zero."""
    return f"{round(value, digits) + 0.0:.{digits}f}"
