"""Drives that leave directions open: what an estimator flags, beside what the true motion tells of it."""

from collections.abc import Sequence

import numpy as np
from bound import VAGUE, information, null_space
from numpy.typing import NDArray
from rigs import AXES, CONSTANT, Outcome, Rig, draw, measured, pulls, solve
from scipy.spatial.transform import Rotation
from summaries import mean, table

Array = NDArray[np.float64]

KINDS = ("static", CONSTANT, "straight", "turn", "planar")
LENGTHS, HOUR = (30.0, 60.0, 120.0, 300.0, 600.0), 3600.0
"""Seconds; the rigs of a kind are divided among the lengths, and a tenth as many drive for an hour."""
NORMAL_KINDS, NORMAL_LENGTHS = ("street", "court"), (60.0, 120.0)
ASIDE_DEG = 10.0
"""An open direction counts as flagged if it is no further than this from what is flagged."""


def draw_failures(rigs: int, first: int, kinds: Sequence[str], shortest: float, longest: float) -> list[Rig]:
    """A lidar that stands upright and an INS, on every kind of drive of so many seconds."""
    counts = {s: max(rigs // len(LENGTHS), 1) for s in LENGTHS} | {HOUR: max(rigs // 10, 1)}
    failing = [(kind, s, count) for kind in KINDS for s, count in counts.items()]
    normal = [(kind, s, rigs) for kind in NORMAL_KINDS for s in NORMAL_LENGTHS]
    return [
        draw(seed, kind, 2, seconds, level=True)
        for kind, seconds, count in (*failing, *normal)
        if kind in kinds and shortest <= seconds <= longest
        for seed in range(first, first + count)
    ]


def look(rig: Rig, method: str) -> Outcome:
    """What :func:`rigs.solve` tells, and how it compares with what the true motion leaves open.

    ``open``: how many directions nothing tells of; ``vague``: these and those it tells too little of; ``flagged``:
    how many were; ``aside``: degrees, in units of ``VAGUE``, of an open direction from what is flagged, at most;
    ``along``: the least sigma along an open direction, in the same units. A refusal flags everything.
    """
    null, vague = null_space(information(rig.path, rig.sensors))
    found = solve(rig, method, measured(rig))
    told: Outcome = {"drive": rig.drive, "seconds": rig.seconds, "open": len(null), "vague": vague}
    if found["refused"]:
        return found | told | {"flagged": len(AXES), "aside": 0.0, "along": float("nan")}
    found["error"] = [_nearest(error, null) for error in found["error"]]
    directions = np.array([[d.get(f"{found['names'][0]}.{axis}", 0.0) for axis in AXES] for d in found["flagged"]])
    flagged, unknown = _basis(directions.reshape(-1, len(AXES)) / VAGUE), _basis(null / VAGUE)
    left = unknown - unknown @ flagged.T @ flagged
    aside = np.linalg.norm(left, 2) if len(left) else 0.0
    told |= {"flagged": len(flagged), "aside": float(np.degrees(np.arcsin(min(aside, 1.0))))}
    return found | told | {"along": _along(unknown, np.array(found["covariance"]))}


def tell_failures(outcomes: Sequence[Outcome], title: str) -> str:
    """A row for each kind and length of the drives that leave directions open."""
    rows = []
    for kind in KINDS:
        for seconds in (*LENGTHS, HOUR):
            of = [o for o in outcomes if (o["drive"], o["seconds"]) == (kind, seconds)]
            if not of:
                continue
            missed = [o["aside"] > ASIDE_DEG for o in of]
            more = [o["flagged"] > o["vague"] for o in of]
            right = len(of) - sum(np.logical_or(missed, more))
            sizes = sorted({o["open"] for o in of})
            counts = [len(of), "/".join(map(str, sizes)), right, sum(missed), sum(more)]
            refused = [bool(o["refused"]) for o in of]
            along = [o["along"] for o in of if np.isfinite(o["along"])]
            rows.append([kind, f"{seconds:g}", *counts, sum(refused), *_too_sure(of)])
            rows[-1] += [float(np.median(along)) if along else np.nan, mean([o["cpu"] for o in of])]
    header: tuple[str, ...] = (
        "drive",
        "s",
        "rigs",
        "open",
        "right",
        "missed (0)",
        "too many",
        "refused",
        "above 3 sigma % (1)",
    )
    header += ("above 5 (0)", "sigma along the open, vague = 1", "cpu s")
    return table(title, header, rows)


def tell_alarms(outcomes: Sequence[Outcome], title: str) -> str:
    """A row for each kind and length of the drives that tell everything."""
    rows = []
    for kind in NORMAL_KINDS:
        for seconds in NORMAL_LENGTHS:
            of = [o for o in outcomes if (o["drive"], o["seconds"]) == (kind, seconds)]
            if of:
                alarms = [o["flagged"] > 0 for o in of]
                vague = [o["vague"] > 0 for o in of]
                rows.append([kind, f"{seconds:g}", len(of), sum(alarms), 100 * mean(alarms), sum(vague)])
                rows[-1] += [sum(bool(o["refused"]) for o in of), *_too_sure(of)]
    header = (
        "drive",
        "s",
        "rigs",
        "flagged",
        "% (1)",
        "truly vague",
        "refused",
        "above 3 sigma % (1)",
        "above 5 (0)",
    )
    return table(title, header, rows)


def _basis(directions: Array) -> Array:
    """Orthonormal rows that span the same."""
    _, size, rows = np.linalg.svd(directions, full_matrices=False)
    return np.asarray(rows[size > 1e-6])


def _nearest(error: Sequence[float], null: Array) -> list[float]:
    """An error (7,) to the nearest of the poses that are as true, if a turn about some axis is open by itself.

    How far the axes across are off can not be told from a rotation vector of many degrees.
    """
    _, share, axes = np.linalg.svd(_basis(null / VAGUE)[:, 3:6])
    by_itself = axes[: len(share)][share > 1 - 1e-3]
    if len(by_itself) != 1:
        return list(error)
    turn = Rotation.from_rotvec(error[3:6]).as_quat()
    about = Rotation.from_quat([*(by_itself[0] * (turn[:3] @ by_itself[0])), turn[3]])
    return [*error[:3], *(about.inv() * Rotation.from_quat(turn)).as_rotvec(), error[6]]


def _along(directions: Array, cov: Array) -> float:
    """The least sigma along any combination of directions (k, 7) in units of ``VAGUE``; nan if there are none."""
    if not len(directions):
        return float("nan")
    variance = directions @ (cov / np.outer(VAGUE, VAGUE)) @ directions.T
    return float(np.sqrt(max(np.linalg.eigvalsh(variance)[0], 0.0)))


def _too_sure(outcomes: Sequence[Outcome]) -> tuple[float, int]:
    """Errors beyond three stated sigmas, in per cent of all that were stated, and how many are beyond five."""
    pull = np.concatenate([np.ravel(pulls(o)) for o in outcomes if not o["refused"]] or [np.zeros(0)])
    known = np.abs(pull[np.isfinite(pull)])
    return 100 * mean(known > 3), int((known > 5).sum())
