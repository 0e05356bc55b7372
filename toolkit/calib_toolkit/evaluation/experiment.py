"""All repeats of an experiment: drawn, done in parallel, kept as they come, and never done twice."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import joblib
import numpy as np

from calib_toolkit import cache
from calib_toolkit.config import METHODS, Config
from calib_toolkit.errors import DataError
from calib_toolkit.evaluation import baselines
from calib_toolkit.evaluation.drives import Drive
from calib_toolkit.evaluation.errors import FAILURES, UNITS, Finding, refusal
from calib_toolkit.evaluation.protocols import Protocol, protocol
from calib_toolkit.evaluation.sections import Draw, Section, cut, fitting, plan, side_by_side, with_sight
from calib_toolkit.evaluation.store import Row, Store
from calib_toolkit.progress import Progress
from calib_toolkit.types import Calibration

DRAW = ("drive", "seconds", "spread", "repeat")
FINDING = ("estimator", "sensor")
NEEDS = {
    "clocks": ([6], "how late the clock is"),
    "rotations": ([3], "how it is turned"),
    "poses": ([*range(6)], "where the sensor is and how it is turned"),
}
"""What an experiment can not do without: columns of ``determined``, and words."""


@dataclass(frozen=True)
class Choices:
    """repeats: sections of each length. seconds: the lengths. methods: the toolkit's own that are compared.
    baseline: whether others run beside. wider: times the motion's sigma that starts are drawn with.
    """

    repeats: int
    seconds: tuple[float, ...]
    methods: tuple[str, ...] = METHODS
    baseline: bool = False
    wider: float = 1.0


@dataclass(frozen=True)
class Outcome:
    """rows: of the whole table, in the order of the plan. skipped: sentences on lengths that no drive lasts.

    apart: by length, how many of the sections there can be at most that do not overlap.
    """

    rows: list[Row]
    skipped: list[str]
    apart: Mapping[float, int]


def run(
    name: str, drives: Sequence[Drive], folder: Path, choices: Choices, config: Config, progress: Progress
) -> Outcome:
    """Do what is not yet in ``folder/NAME.csv``. Raises CalibrationError.

    Drives must have the same sensors. A repeat that is refused is a row that says so.
    """
    experiment = protocol(name)
    check(experiment, {d.name: d.truth for d in drives})
    lengths, said = fitting(drives, choices.seconds) if experiment.sees else (choices.seconds, [])
    draws, skipped = plan(drives, lengths, experiment.spreads, choices.repeats)
    skipped = said + skipped
    if not draws:
        raise DataError(
            f"no recording lasts long enough: {'; '.join(skipped)}; choose shorter lengths with --seconds"
        )
    estimators = experiment.estimators(choices.methods, choices.baseline, config.appearance)
    labels = experiment.labels(tuple(drives[0].motions))
    configs = tuple(replace(config, method=m) for m in choices.methods)
    work = _Work(name, configs, tuple(experiment.baselines(choices.baseline)), tuple(estimators), tuple(labels))
    store = Store(folder, name, _settings(name, drives, choices, config, estimators), columns(experiment))
    done = _finished(store.read(), len(estimators) * len(labels))
    done = {key: done[key] for d in draws if (key := _key(d, drives)) in done}
    store.rewrite(row for rows in done.values() for row in rows)
    left = [d for d in draws if _key(d, drives) not in done]
    progress.begin(name, len(draws), len(done))
    pool = joblib.Parallel(n_jobs=config.jobs, return_as="generator_unordered", max_nbytes=None)
    todo = (joblib.delayed(work)(d, _section(d, drives, name, choices, config), drives[d.drive].name) for d in left)
    for draw, rows in pool(todo):
        store.append(rows)
        done[_key(draw, drives)] = rows
        progress.advance(name, 1)
    ordered = [row for d in draws for row in done[_key(d, drives)]]
    store.rewrite(ordered)
    apart = {s: min(choices.repeats, side_by_side(drives, s)) for s in dict.fromkeys(d.seconds for d in draws)}
    return Outcome(ordered, skipped, apart)


def check(experiment: Protocol, truths: Mapping[str, Calibration]) -> None:
    """Refuse recordings that can not be compared, told by their names and truths. Raises DataError."""
    first, told = next(iter(truths.items()))
    if len(told.names) < 2:
        raise DataError(f"{first}: comparing takes at least two sensors, and this is {told.names[0]}; name more")
    experiment.labels(told.names)
    for name, truth in truths.items():
        if truth.names != told.names:
            raise DataError(
                f"{name} has {', '.join(truth.names)} where {first} has {', '.join(told.names)}; "
                "drives of one experiment have the same sensors: choose them with --sensors"
            )
        needed, words = NEEDS[experiment.needs]
        known = np.asarray(truth.determined[1:, needed].all(axis=1))
        # sensors whose clock nobody knows may run along; a rotation is what the others are told against
        if not (known.any() if experiment.needs == "clocks" else known.all()):
            unknown = ", ".join(n for n, k in zip(truth.names[1:], known, strict=True) if not k)
            raise DataError(
                f"the truth of {name} does not say {words} of "
                f"{unknown} against {truth.base}; leave it out with --sensors, or give another truth with --truth"
            )


def notes(name: str, choices: Choices) -> list[str]:
    """Sentences on how it was done that the table does not tell, and on what this installation can not do."""
    if name == "appearance":
        return [
            "every start is the truth moved by a draw from the motion's covariance"
            f"{f', its sigmas {choices.wider:g} times as large' if choices.wider != 1 else ''}, since one part of a "
            "drive always ends in the same motion result; the search is told that covariance"
        ]
    if name == "pair" and choices.baseline and not baselines.opencv_has_hand_eye():
        return ["OpenCV's hand-eye calibration is left out: this OpenCV has no calibrateHandEye (4.x has)"]
    return []


def columns(experiment: Protocol) -> tuple[str, ...]:
    """Of an experiment's table: what was drawn, what was found, errors with their unit, and stated sigmas."""
    named = [f"{p}_{UNITS[p]}" for p in _parameters(experiment)]
    sigmas = [f"sigma_{n}" for n in named if not n.startswith(("rotation", "translation"))]
    return (*DRAW, "start", *FINDING, "status", "undetermined", *named, *sigmas, "note")


@dataclass(frozen=True)
class _Work:
    """One repeat, as a worker does it. configs: one for each method. others: the baselines. estimators: of both."""

    name: str
    configs: tuple[Config, ...]
    others: tuple[str, ...]
    estimators: tuple[str, ...]
    labels: tuple[str, ...]

    def __call__(self, draw: Draw, section: Section, drive: str) -> tuple[Draw, list[Row]]:
        experiment = protocol(self.name)
        try:
            findings = experiment.measure(section, self.configs, self.others)
        except FAILURES as e:  # one bad section must not cost all the others
            findings = [Finding(m, label, refused=refusal(e)) for m in self.estimators for label in self.labels]
        drawn = (drive, f"{draw.seconds:g}", f"{draw.spread:g}", str(draw.repeat), f"{section.start:.3f}")
        start = dict(zip((*DRAW, "start"), drawn, strict=True))
        return draw, [start | _row(f, columns(experiment)) for f in findings]


def _section(d: Draw, drives: Sequence[Drive], name: str, choices: Choices, config: Config) -> Section:
    section = cut(d, drives, name, config.seed)
    return with_sight(section, d, drives[d.drive], choices.wider) if protocol(name).sees else section


def _row(f: Finding, titles: Sequence[str]) -> dict[str, str]:
    """Six digits: more would differ from one machine to the next."""
    row = dict.fromkeys(titles[len(DRAW) + 1 :], "")
    row |= {f"{p}_{UNITS[p]}": f"{e:.6g}" for p, e in f.error.items()}
    row |= {f"sigma_{p}_{UNITS[p]}": f"{s:.6g}" for p, s in f.sigma.items()}
    status, note = ("refused" if f.refused else "found"), " ".join(f.refused.split())
    told = {"estimator": f.estimator, "sensor": f.sensor, "status": status, "note": note}
    return {**row, **told, "undetermined": " ".join(f.undetermined)}


def _parameters(experiment: Protocol) -> list[str]:
    turned = ["rx", "ry", "rz"] if "rotation" in experiment.parameters else []
    return [*experiment.parameters, *turned]


def _finished(rows: Sequence[Row], each: int) -> dict[tuple[str, ...], list[Row]]:
    """The rows of every repeat that has all of them."""
    found: dict[tuple[str, ...], list[Row]] = {}
    for row in rows:
        found.setdefault(tuple(row[c] for c in DRAW), []).append(row)
    return {key: rows for key, rows in found.items() if len(rows) == each}


def _key(d: Draw, drives: Sequence[Drive]) -> tuple[str, ...]:
    return drives[d.drive].name, f"{d.seconds:g}", f"{d.spread:g}", str(d.repeat)


def _settings(
    name: str, drives: Sequence[Drive], choices: Choices, config: Config, estimators: Sequence[str]
) -> dict[str, Any]:
    """Everything that decides a number; not how many processes there are."""
    try:
        ours = version("calib-toolkit")
    except PackageNotFoundError:
        ours = "unknown"
    options: Mapping[str, Any] = {k: v for k, v in asdict(config).items() if k not in ("jobs", "seed", "method")}
    truths = [
        (t.T_base_sensor, t.dt_base_sensor, t.clock_skew, t.t_ref, t.determined) for t in (d.truth for d in drives)
    ]
    return {
        "protocol": name,
        "drives": [d.name for d in drives],
        "sensors": list(drives[0].motions),
        "motions": cache.key_of([[d.motions, d.clocks] for d in drives]),
        "truth": cache.key_of(truths),
        "seconds": list(choices.seconds),
        "repeats": choices.repeats,
        "seed": config.seed,
        "methods": list(choices.methods),
        "estimators": list(estimators),
        **({"wider": choices.wider} if protocol(name).sees else {}),
        "options": options,
        "version": ours,
    }
