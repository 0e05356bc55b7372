"""Which directions the drive tells nothing of, found and not assumed, in words that say what to drive instead.

A sensor's reading changes when its pose does; how, depends on the motion alone. Two sensors tell that motion with
independent noise, so the product of what each makes of a change is zero on average along a direction that nothing
excited, whatever either states of its noise. A direction counts as told when its product stands well above the
spread that the sensors' disagreement gives it, and is not mostly noise.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from calib_toolkit import observability, se3
from calib_toolkit.sync import Steps
from calib_toolkit.types import Undetermined

Array = NDArray[np.float64]

POSE = ("x", "y", "z", "rx", "ry", "rz")
UNITS = np.repeat([1.0, 0.1], 3)
"""Metres and radians that are worth the same where a direction mixes the two."""
PURE = 0.05
"""Share of a direction below which it is left out of its name."""


def untold(steps: Steps, T: Array) -> list[Array]:
    """For each sensor but the base, orthonormal directions (6, k) of its pose that change no reading.

    In ``UNITS`` of ``(dt, delta)``, base axes. T: (n, 4, 4), about right.
    """
    found = []
    for i in range(1, len(T)):
        a, b = _changes(steps, i, T[i])
        excited = np.einsum("mdi,mdj->ij", a, b)
        _, vectors = np.linalg.eigh(excited + excited.T)
        open_ = [v for v in vectors.T if not observability.stand_out(a @ v, b @ v)]
        found.append(np.array(open_).reshape(-1, 6).T)
    return found


def strengths(steps: Steps, T: Array) -> Array:
    """(n, 6) from 0 to 1: what each sensor and the base have in common of a change along each axis; 1 of the base."""
    found = np.ones((len(T), 6))
    for i in range(1, len(T)):
        a, b = _changes(steps, i, T[i])
        power = np.sqrt(np.einsum("mdi,mdi->i", a, a) * np.einsum("mdi,mdi->i", b, b))
        found[i] = np.clip(np.einsum("mdi,mdi->i", a, b) / np.maximum(power, 1e-300), 0.0, 1.0)
    return found


def clock(name: str) -> Undetermined:
    """Of a sensor whose clock nothing told."""
    return Undetermined(
        {f"{name}.dt": 1.0},
        f"the clock offset of {name} was not determined and is taken as zero: neither how the vehicle turned nor how "
        "fast it went changed so that it would show; drive bends at changing speed",
    )


def turns(directions: Array) -> Array:
    """(6, j) what of untold directions (6, k) are turns and nothing else."""
    return _inside(directions, np.eye(6)[:, 3:])


def nearest(T: Array, directions: Array) -> Array:
    """Of all poses (4, 4) that are as good along untold directions (6, k), about the one nearest to the base."""
    T = T.copy()
    for v in _apart(directions).T:
        shift, turn = v[:3], v[3:] * UNITS[3:]
        if shift @ shift > PURE**2:
            s = -(shift @ T[:3, 3]) / (shift @ shift)
            T[:3, 3] += s * shift + s**2 / 2 * np.cross(turn, shift)
            T[:3, :3] = se3.exp_so3(s * turn) @ T[:3, :3]
    return T


def in_words(base: str, name: str, directions: Array) -> list[Undetermined]:
    """A sentence for each untold direction (6, k) of a sensor."""
    if directions.shape[1] == 6:
        why = "the vehicle hardly moved; drive bends to both sides, and a ramp, kerbs or rough ground"
        return [_undetermined(name, v, why, base) for v in np.eye(6)]
    tidy = [_tidy(v) for v in _apart(directions).T]
    return [_undetermined(name, v, _remedy(v, len(tidy)), base) for v in tidy]


def without_scale(names: Sequence[str]) -> list[Undetermined]:
    """No sensor of the rig measures distances."""
    why = "no sensor knows distances, only directions; add a lidar, a GPS/INS or an odometry"
    return [_undetermined(name, v, why, names[0]) for name in names[1:] for v in np.eye(6)[:3]]


def _changes(steps: Steps, i: int, T: Array) -> tuple[Array, Array]:
    """What the base and sensor i make of a change of its pose: (m, d, 6) each, in units of their disagreement."""
    R, t = T[:3, :3], T[:3, 3]
    w = (steps.vec[0, :, 3:], steps.vec[i, :, 3:] @ R.T)
    swing = [se3.exp_so3(v) - np.eye(3) for v in w]
    shift = [swing[0] @ t + steps.vec[0, :, :3], steps.vec[i, :, :3] @ R.T]
    keep = [np.broadcast_to(np.eye(3), (len(steps), 3, 3))] * 2
    if not steps.has_scale[i]:  # how far it went is not known, and what lies along does not show
        length = np.linalg.norm(shift[0], axis=1, keepdims=True)
        shift[1] = shift[1] / np.maximum(np.linalg.norm(shift[1], axis=1, keepdims=True), 1e-12) * length
        # each across its own travel: a noise that both share would pass for motion
        keep = [_across(p) / np.maximum(length, max(float(np.median(length)), 1e-9))[..., None] for p in shift]
    both = np.zeros((2, len(steps), 6, 6))
    if steps.has_scale.any():
        sigma = _size((keep[0] @ (shift[0] - shift[1])[..., None])[..., 0])
        for change, k, s, p in zip(both, keep, swing, shift, strict=True):
            change[:, :3, :3], change[:, :3, 3:] = k @ s / sigma, k @ se3.skew(p) / sigma
    sigma = _size(w[0] - w[1])
    for change, v in zip(both, w, strict=True):
        change[:, 3:, 3:] = se3.skew(v) / sigma
    return both[0] * UNITS, both[1] * UNITS


def _across(v: Array) -> Array:
    """Projections (m, 3, 3) onto what is across vectors (m, 3)."""
    unit = v / np.maximum(np.linalg.norm(v, axis=1, keepdims=True), 1e-12)
    return np.asarray(np.eye(3) - unit[:, :, None] * unit[:, None, :])


def _size(error: Array) -> float:
    """Of a usual error (m, 3), one axis of it."""
    return max(float(np.sqrt(np.median(np.einsum("mi,mi->m", error, error)) / 2.37)), 1e-12)


def _apart(directions: Array) -> Array:
    """The same space (6, k) by directions that mix shifts with turns as little as can be."""
    shifts = _inside(directions, np.eye(6)[:, :3])
    turns = _inside(directions, np.eye(6)[:, 3:])
    pure = np.concatenate([shifts, turns], axis=1)
    rest = directions - pure @ (pure.T @ directions)
    U, s, _ = np.linalg.svd(rest, full_matrices=False)
    return np.concatenate([pure, U[:, s > 0.5]], axis=1)


def _inside(directions: Array, room: Array) -> Array:
    """(6, j) what of a space lies, but for a small angle, in another one; along axes where it can."""
    U, s, _ = np.linalg.svd(room.T @ directions, full_matrices=False)
    k = int(np.sum(s > 0.97))
    inside = room @ U[:, :k]
    return room if k == room.shape[1] else inside


def _tidy(v: Array) -> Array:
    """Without its small parts, and positive where it is largest."""
    v = np.where(np.abs(v) < PURE * np.abs(v).max(), 0.0, v)
    return np.asarray(v / np.linalg.norm(v) * np.sign(v[np.argmax(np.abs(v))]))


def _remedy(v: Array, count: int) -> str:
    """Why a direction is open, and what to drive."""
    turned, shifted = np.linalg.norm(v[3:]), np.linalg.norm(v[:3])
    if turned and shifted:
        return (
            "it turns about a point about which the whole vehicle turned all the time; drive bends to both sides, "
            "and straight on"
        )
    if turned:
        return "the vehicle only drove straight ahead; drive bends to both sides"
    if count >= 3:
        return "the vehicle hardly turned; drive bends to both sides, and a ramp, kerbs or rough ground"
    return (
        "the vehicle turned about that axis only; drive over a kerb, a ramp or a speed bump, or give a measured "
        "value with --prior"
    )


def _undetermined(name: str, v: Array, why: str, base: str) -> Undetermined:
    parts = {f"{name}.{axis}": float(x) for axis, x in zip(POSE, v * UNITS, strict=True) if x}
    size = float(np.linalg.norm(list(parts.values())))
    turned, shifted = np.any(v[3:]), np.any(v[:3])
    if turned and shifted:
        axis, point = v[3:] * UNITS[3], v[:3]
        where = ", ".join(f"{c:.1f}" for c in np.cross(axis, point) / (axis @ axis))
        about = observability.axis_words(axis / np.linalg.norm(axis), base)
        what = f"the pose of {name} was not determined against turning it about {about} through the point ({where}) m"
    else:
        kind, part = ("rotation", v[3:]) if turned else ("position", v[:3])
        along = observability.axis_words(part / np.linalg.norm(part), base)
        what = f"the {kind} of {name} {'about' if turned else 'along'} {along} was not determined"
    return Undetermined({key: x / size for key, x in parts.items()}, f"{what}: {why}")
