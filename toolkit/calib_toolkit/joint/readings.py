"""Motions made ready: in order of time, no more often than a vehicle moves, and not too sure of themselves."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from calib_toolkit import se3
from calib_toolkit.types import Motions

Array = NDArray[np.float64]

OFTEN = 0.05
"""Seconds that joined readings of a sensor with scale last, where two or more fit: errors of shorter ones are hardly
independent."""


WIDENED = 2.0
"""Times that :func:`doubted` makes the variance of a usual reading what was stated."""


def ready(motions: Motions) -> Motions:
    """In order of time; those of a sensor read at some 30 Hz or more joined, as many as make a twentieth second."""
    m = motions[np.argsort(motions.start, kind="stable")]
    period = float(np.median(m.end - m.start))
    together = round(OFTEN / max(period, 1e-4))
    return doubted(joined(m, together) if m.has_scale and together > 1 else m)


def doubted(m: Motions) -> Motions:
    """With the noise of a usual reading, alike about all axes, added to each one's own.

    Which readings a sensor states to be good tells less than it claims: where one of them may count a hundred times
    as much as another, offsets of the ladybug come out ten stated sigma wrong.
    """
    usual = np.median(np.einsum("nii->ni", m.cov), axis=0)
    shift, turn = usual[:3].sum() / (3 if m.has_scale else 2), usual[3:].mean()
    return replace(m, cov=m.cov + np.diag(np.repeat([shift, turn], 3)))


def joined(m: Motions, together: int) -> Motions:
    """So many successive motions as one each, except across gaps. The last of a run may be fewer.

    Their errors are taken as independent.
    """
    gap = np.concatenate([[True], np.abs(m.start[1:] - m.end[:-1]) > 1e-6])
    first = np.flatnonzero(gap)
    place = np.arange(len(m)) - first[np.cumsum(gap) - 1]
    begins = np.flatnonzero(place % together == 0)
    ends = np.append(begins[1:], len(m))
    vec, cov = m.vec[begins], m.cov[begins]
    for k in range(1, together):
        more = np.flatnonzero(begins + k < ends)
        vec[more], cov[more] = _then(vec[more], cov[more], m.vec[begins[more] + k], m.cov[begins[more] + k])
    return replace(m, start=m.start[begins], end=m.end[ends - 1], vec=vec, cov=cov)


def travel(m: Motions) -> Motions:
    """Motions that hold what a sensor travelled in the place of its turns, and do not travel."""
    vec, cov = np.zeros_like(m.vec), np.tile(np.eye(6), (len(m), 1, 1))
    vec[:, 3:], cov[:, 3:, 3:] = m.vec[:, :3], m.cov[:, :3, :3]
    return replace(m, vec=vec, cov=cov)


def _then(vec_a: Array, cov_a: Array, vec_b: Array, cov_b: Array) -> tuple[Array, Array]:
    """One motion (n, 6) after another, with covariance (n, 6, 6)."""
    vec = se3.vector(se3.matrix(vec_a) @ se3.matrix(vec_b))
    R_a = se3.exp_so3(vec_a[:, 3:])
    J_a, J_b = se3.vec_jacobian(vec_a), se3.vec_jacobian(vec_b)
    by_a, by_b = np.zeros((2, len(vec), 6, 6))
    by_a[:, :3, :3] = by_a[:, 3:, 3:] = np.eye(3)
    by_a[:, :3, 3:] = -se3.skew((R_a @ vec_b[:, :3, None])[..., 0])
    by_b[:, :3, :3] = by_b[:, 3:, 3:] = R_a
    to_vec = np.linalg.inv(se3.vec_jacobian(vec))
    by_a, by_b = to_vec @ by_a @ J_a, to_vec @ by_b @ J_b
    return vec, by_a @ cov_a @ np.swapaxes(by_a, 1, 2) + by_b @ cov_b @ np.swapaxes(by_b, 1, 2)
