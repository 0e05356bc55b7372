"""All repeats of an experiment: drawn, done in parallel, kept as they come, and never done twice."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import joblib

from calib_toolkit import cache
from calib_toolkit.config import METHODS, Config
from calib_toolkit.errors import DataError
from calib_toolkit.evaluation import baselines
from calib_toolkit.evaluation.drives import Drive
from calib_toolkit.evaluation.errors import FAILURES, UNITS, Finding, refusal
from calib_toolkit.evaluation.protocols import Protocol, protocol
from calib_toolkit.evaluation.sections import Draw, Section, cut, plan, side_by_side
from calib_toolkit.evaluation.store import Row, Store
from calib_toolkit.progress import Progress
from calib_toolkit.types import Calibration

DRAW = ("drive", "seconds", "spread", "repeat")
FINDING = ("estimator", "sensor")


@dataclass(frozen=True)
class Choices:
    """repeats: sections of each length. seconds: the lengths. methods: the toolkit's own that are compared.
    baseline: whether others run beside.
    """

    repeats: int
    seconds: tuple[float, ...]
    methods: tuple[str, ...] = METHODS
    baseline: bool = False


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
    draws, skipped = plan(drives, choices.seconds, experiment.spreads, choices.repeats)
    if not draws:
        raise DataError(
            f"no recording lasts long enough: {'; '.join(skipped)}; choose shorter lengths with --seconds"
        )
    estimators = experiment.estimators(choices.methods, choices.baseline)
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
    todo = (joblib.delayed(work)(d, cut(d, drives, name, config.seed), drives[d.drive].name) for d in left)
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
        clocks = experiment.needs == "clocks"
        known = truth.determined[1:, 6 if clocks else 3]
        # sensors whose clock nobody knows may run along; a rotation is what the others are told against
        if not (known.any() if clocks else known.all()):
            unknown = ", ".join(n for n, k in zip(truth.names[1:], known, strict=True) if not k)
            raise DataError(
                f"the truth of {name} does not say {'how late the clock is' if clocks else 'how it is turned'} of "
                f"{unknown} against {truth.base}; leave it out with --sensors, or give another truth with --truth"
            )


def notes(name: str, choices: Choices) -> list[str]:
    """Sentences on what this installation can not do."""
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
        "options": options,
        "version": ours,
    }
