"""Where a sensor was at any instant, from its own motion: what moves a scan to the time of an image."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calib_toolkit import se3, sync
from calib_toolkit.types import Motions, Trajectory

Array = NDArray[np.float64]

AROUND = 1.0
"""Seconds of motion looked at beyond the instants that are asked for, so that splines have hold."""


def poses_at(motion: Motions | Trajectory, stamps: ArrayLike, at: float) -> Array:
    """``T_at_stamp`` (m, 4, 4): the sensor's pose at each stamp (m,) in its own frame at the instant ``at``; seconds
    of its own clock.

    Smooth between readings (see :mod:`~calib_toolkit.sync`). nan where its motion is not known in between.
    """
    stamps = np.asarray(stamps, dtype=np.float64)
    motions = motion.motions() if isinstance(motion, Trajectory) else motion
    instants = np.append(stamps, at)
    near = (motions.end > instants.min() - AROUND) & (motions.start < instants.max() + AROUND)
    if not near.any():
        return np.full((len(stamps), 4, 4), np.nan)
    chain = sync.chain(motions[near])
    T_first_knot = [np.eye(4)]
    for link in se3.matrix(chain.vec):
        T_first_knot.append(T_first_knot[-1] @ link)
    k = np.clip(np.searchsorted(chain.knots, instants, side="right") - 1, 0, len(chain.knots) - 2)
    twist = chain.summed(instants) - chain.summed(chain.knots[k])
    shift = np.einsum("nij,nj->ni", se3.left_jacobian(twist[:, 3:]), twist[:, :3])
    T_first = np.array(T_first_knot)[k] @ se3.rigid(se3.exp_so3(twist[:, 3:]), shift)
    found = se3.relative(T_first[-1], T_first[:-1])
    unknown = np.concatenate([[0], np.cumsum(~chain.known)])
    outside = (instants < chain.knots[0] - sync.SAME_STAMP) | (instants > chain.knots[-1] + sync.SAME_STAMP)
    known = (unknown[k] == unknown[k[-1]]) & chain.known[k] & ~outside & chain.known[k[-1]] & ~outside[-1]
    return np.where(known[:-1, None, None], found, np.nan)
