"""Tables of what many rigs' outcomes (see :func:`rigs.solve`) add up to; columns say in brackets what is ideal."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rigs import AXES, PLACES, Outcome, nees, pulls, solved
from scipy.special import chdtri

POSE, TURN, DT = tuple(range(6)), (3, 4, 5), 6
SURE = 0.9999
"""A solution is one if its normalised error squared is below this quantile."""


def tell_nees(found: Mapping[int, Sequence[Outcome]], axes: Sequence[int], title: str) -> str:
    """A row for each sensor of each size of rig, and one for each size."""
    each, whole = [], []
    for n, outcomes in found.items():
        told = solved(outcomes)
        for i in range(n - 1):
            values = np.array([nees(o, [i], axes) for o in told])
            pull = np.array([pulls(o)[i] for o in told]).reshape(-1, 7)
            count = int(np.isfinite(values).sum())
            low, high = band(len(axes), count)
            name = told[0]["names"][i] if told else "-"
            each.append([n, name, count, mean(values), f"{low:.2f} to {high:.2f}", rms(pull[:, DT]) ** 2])
            each[-1] += _within(pull[:, [*axes, DT]])
        joint = [nees(o, range(n - 1), axes) / len(axes) / (n - 1) for o in told]
        flagged = sum(not np.array(o["determined"])[:, [*axes, DT]].all() for o in told)
        whole.append([n, len(outcomes), len(outcomes) - len(told), flagged, mean(joint)])
        whole[-1].append(float(np.median([o["cpu"] for o in outcomes])))
    header = ("sensors", "sensor", "rigs", f"NEES ({len(axes)})", "99 % band", "dt (0.88 to 1.13)")
    by_rig = ("sensors", "rigs", "refused", "flagged (0)", "joint NEES per DoF (1)", "cpu s, median")
    within = ("1 sigma % (68.3)", "2 (95.4)", "3 (99.7)")
    return table(title, (*header, *within), each) + "\n" + table("The rigs as a whole:", by_rig, whole)


def tell_coverage(outcomes: Sequence[Outcome], title: str) -> str:
    """A row for each sensor and axis."""
    told, rows = solved(outcomes), []
    if told:
        pull = np.array([pulls(o) for o in told])
        rows = [
            [name, axis, int(np.isfinite(pull[:, i, k]).sum()), *_within(pull[:, i, k]), rms(pull[:, i, k])]
            for i, name in enumerate(told[0]["names"])
            for k, axis in enumerate(AXES)
        ]
    header = ("sensor", "axis", "rigs", "1 sigma % (65 to 71)", "2 (93.5 to 96.5)", "3 (99.3)", "rms of sigmas (1)")
    return table(f"{title}, of which {len(outcomes) - len(told)} were refused", header, rows)


def tell_outliers(found: Mapping[tuple[int, str, float], Sequence[Outcome]], title: str) -> str:
    """A row for each number of sensors, place and share of wrong readings."""
    rows = []
    for (n, who, share), outcomes in found.items():
        told = solved(outcomes)
        clean = {o["seed"]: o for o in solved(found[n, who, 0.0])}
        per_dof = mean([nees(o, [i], POSE) / 6 for o in told for i in range(n - 1)])
        both = [(o, clean[o["seed"]]) for o in told if o["seed"] in clean]
        ratio = np.array([np.nan])
        if both:
            error, before = (np.array([_known_error(pair[k]) for pair in both]) for k in (0, 1))
            ratio = np.array([rms(e) / rms(b) for e, b in zip(error.T, before.T, strict=True)])
        of_ins, of_base = (_statistic(told, "rejected", name) for name in ("ins", PLACES[0].name))
        flagged = sum(bool(o["flagged"]) for o in told)
        rows.append([n, who, f"{share:.0%}", len(outcomes) - len(told), flagged, per_dof, rms(ratio)])
        rows[-1] += [float(max(ratio[np.isfinite(ratio)], default=np.nan)), 100 * of_ins, 100 * of_base]
    header: tuple[str, ...] = ("sensors", "wrong in", "share", "refused", "flagged", "NEES per DoF (0.8 to 1.25)")
    header += ("error over clean (1.3)", "of the worst axis", "rejected of ins %", f"of {PLACES[0].name} %")
    return table(title, header, rows)


def tell_scale(found: Mapping[tuple[int, float], Sequence[Outcome]], title: str) -> str:
    """A row for each number of sensors and stated sigma: noise_scale times stated squared, one where recovered."""
    rows = []
    for (n, stated), outcomes in found.items():
        told = solved(outcomes)
        row: list[Any] = [n, stated, len(outcomes) - len(told)]
        for part in ("turns", "shifts"):
            values = np.array([_noise(o, "ins", part) * stated**2 for o in told])
            row += [float(np.median(values)) if values.size else np.nan, 100 * mean(np.abs(values - 1) < 0.2)]
            row[-1] = row[-1] if np.isfinite(values).any() else np.nan
        others = [s.name for s in PLACES[:n] if s.name != "ins"]
        row.append(mean([_noise(o, name, part) for o in told for name in others for part in ("turns", "shifts")]))
        kinds = {o["statistics"].get("noise_scale", {}).get("ins", {}).get("kind", "-") for o in told}
        row.append(", ".join(sorted(kinds)) or "-")
        rows.append([*row, *(mean([nees(o, [i], POSE) / 6 for o in told]) if i < n - 1 else "" for i in range(3))])
    header: tuple[str, ...] = (
        "sensors",
        "stated",
        "refused",
        "turns (1)",
        "within 20 %",
        "shifts (1)",
        "within 20 %",
        "others (1)",
    )
    header += ("kind", *(f"NEES per DoF {p.name}" for p in PLACES[1:4]))
    return table(title, header, rows)


def tell_starts(found: Mapping[str, Sequence[Outcome]], title: str) -> str:
    """A row for each range of clock offsets."""
    rows = []
    for most_dt, outcomes in found.items():
        told = solved(outcomes)
        wrong = [o["seed"] for o in told if not right(o)]
        flagged = sum(not np.all(o["determined"]) for o in told if right(o))
        share = 100 * (len(told) - len(wrong) - flagged) / max(len(outcomes), 1)
        rows.append([most_dt, len(outcomes), share, flagged, len(outcomes) - len(told), len(wrong)])
        rows[-1].append(", ".join(map(str, wrong[:6])) or "-")
    header = ("clocks off up to", "rigs", "converged % (99)", "flagged", "refused", "wrong (0)", "seeds of these")
    return table(title, header, rows)


def tell_bound(found: Mapping[int, Sequence[Outcome]], title: str) -> str:
    """A row for each method and sensor: root mean square of error over bound, by axis."""
    rows = []
    for n, outcomes in found.items():
        for method in [k for k in outcomes[0] if k not in ("seed", "refused", "names")]:
            ratio = np.array([o[method] for o in outcomes])
            for i, name in enumerate(outcomes[0]["names"]):
                rows.append([n, method, name, int(np.isfinite(ratio[:, i, 3]).sum())])
                rows[-1] += [rms(ratio[:, i, k]) for k in range(7)]
    return table(title, ("sensors", "method", "sensor", "rigs", *AXES), rows)


def right(outcome: Outcome) -> bool:
    """Whether everything determined lies where its joint covariance allows."""
    known = np.ravel(outcome["determined"])
    error, cov = np.ravel(outcome["error"])[known], np.array(outcome["covariance"])[np.ix_(known, known)]
    return not known.any() or bool(error @ np.linalg.solve(cov, error) < chdtri(int(known.sum()), 1 - SURE))


def mean(values: Any) -> float:
    """The mean of what is known; nan if nothing is."""
    known = np.ravel(values)[np.isfinite(np.ravel(values))]
    return float(known.mean()) if known.size else float("nan")


def rms(values: Any) -> float:
    """The root mean square of what is known."""
    return float(np.sqrt(mean(np.square(values))))


def band(dof: int, count: int) -> tuple[float, float]:
    """Where the mean of ``count`` chi-square values of so many degrees of freedom lies 99 times in 100."""
    low, high = chdtri(dof * max(count, 1), [0.995, 0.005]) / max(count, 1)
    return float(low), float(high)


def table(title: str, header: Sequence[str], rows: Sequence[Sequence[Any]]) -> str:
    """Markdown with aligned columns; floats to three digits, nan as a dash."""
    cells = [list(header), *([_cell(v) for v in row] for row in rows)]
    width = [max(len(row[k]) for row in cells) for k in range(len(header))]
    lines = ["| " + " | ".join(c.rjust(w) for c, w in zip(row, width, strict=True)) + " |" for row in cells]
    rule = "|" + "|".join("-" * (w + 1) + ":" for w in width) + "|"
    return "\n".join([title, "", lines[0], rule, *lines[1:], ""])


def tell(text: str, out: Path | None) -> None:
    """Print, and write to a file if one is named."""
    print(text)
    if out is not None:
        out.write_text(text + "\n")


def _within(pull: Any) -> list[float]:
    known = np.abs(pull[np.isfinite(pull)])
    return [round(100 * mean(known < k), 1) for k in (1, 2, 3)]


def _known_error(o: Outcome) -> Any:
    return np.where(o["determined"], o["error"], np.nan).ravel()


def _statistic(outcomes: Sequence[Outcome], name: str, sensor: str) -> float:
    return mean([o["statistics"].get(name, {}).get(sensor, np.nan) for o in outcomes])


def _noise(o: Outcome, sensor: str, part: str) -> float:
    return float(o["statistics"].get("noise_scale", {}).get(sensor, {}).get(part, np.nan))


def _cell(value: Any) -> str:
    if not isinstance(value, float):
        return str(value)
    return f"{value:.3g}" if np.isfinite(value) else "-"
