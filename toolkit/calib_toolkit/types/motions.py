"""How one sensor moved: steps with covariance, or a trajectory whose errors are correlated."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from calib_toolkit import se3

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Motions:
    """Measured motions of one sensor, each from its start stamp to its end stamp.

    start, end: (n,) seconds; any spacing, gaps and overlap allowed.
    vec: (n, 6) of ``T_start_end``: ``[x y z rx ry rz]``, metres and radians, angle-axis.
    cov: (n, 6, 6) of vec, in that order; noise is additive per component, in the axes of the sensor at start.
    has_scale: False if only the direction of the translation is known (then its length is one).

    What more readings do not average out, sigmas of errors that stay as they are through the recording:
    lean: (3,) radians about the sensor's axes, by which all translations are turned against all rotations, and, about
        where the sensor goes, the axes of all rotations; by at most 0.015 degrees of it across that, too.
    late: seconds by which all motions seem to happen later than their stamps say.
    """

    start: Array
    end: Array
    vec: Array
    cov: Array
    has_scale: bool = True
    lean: Array = field(default_factory=lambda: np.zeros(3))
    late: float = 0.0

    def __post_init__(self) -> None:
        n = len(self.start)
        shapes = {"end": (n,), "vec": (n, 6), "cov": (n, 6, 6), "lean": (3,)}
        for name, shape in shapes.items():
            if np.shape(getattr(self, name)) != shape:
                raise ValueError(f"Motions.{name} has shape {np.shape(getattr(self, name))}, expected {shape}")

    def __len__(self) -> int:
        return len(self.start)

    def __getitem__(self, part: slice | NDArray[np.bool_] | NDArray[np.int64]) -> "Motions":
        return replace(self, start=self.start[part], end=self.end[part], vec=self.vec[part], cov=self.cov[part])

    @staticmethod
    def concatenate(parts: Sequence["Motions"]) -> "Motions":
        """One after the other, in the order given."""
        return Motions(
            np.concatenate([p.start for p in parts]),
            np.concatenate([p.end for p in parts]),
            np.concatenate([p.vec for p in parts]),
            np.concatenate([p.cov for p in parts]),
            all(p.has_scale for p in parts),
            np.max([p.lean for p in parts], axis=0),
            max(p.late for p in parts),
        )

    def shifted(self, dt: float) -> "Motions":
        """The same motions on a clock that reads ``dt`` seconds more."""
        return replace(self, start=self.start + dt, end=self.end + dt)


@dataclass(frozen=True)
class Trajectory:
    """Poses of one sensor in a world frame, with the two parts of their error.

    stamps: (n,) seconds, increasing. T_world_sensor: (n, 4, 4).
    cov: (n, 6, 6) of the error that each pose has on its own, independent of the others.
    drift: (n, 6, 6) of the error gathered from pose k-1 to pose k, on top of all earlier drift; drift[0] is 0.
    Both are of ``(dt, delta)`` in ``t_true = t + dt``, ``R_true = Exp(delta) R``, world axes for cov, axes of
    the sensor at pose k-1 for drift.
    has_attitude: False where only positions were told, whose rotations then mean nothing.
    lean: as of :class:`Motions`.
    """

    stamps: Array
    T_world_sensor: Array
    cov: Array
    drift: Array
    has_attitude: bool = True
    lean: Array = field(default_factory=lambda: np.zeros(3))

    def __len__(self) -> int:
        return len(self.stamps)

    @staticmethod
    def concatenate(parts: Sequence["Trajectory"]) -> "Trajectory":
        """Parts in one world frame, in order; what a part repeats of the one before it is left out."""
        last, kept = -np.inf, []
        for part in parts:
            new = part.stamps > last
            kept.append((part.stamps[new], part.T_world_sensor[new], part.cov[new], part.drift[new]))
            last = part.stamps[-1]
        stamps, poses, cov, drift = (np.concatenate(c) for c in zip(*kept, strict=True))
        lean = np.max([p.lean for p in parts], axis=0)
        return Trajectory(stamps, poses, cov, drift, all(p.has_attitude for p in parts), lean)

    def motions(self) -> Motions:
        """Motion from each pose to the next, with the covariance that both poses and the drift give it."""
        T_a, T_b = self.T_world_sensor[:-1], self.T_world_sensor[1:]
        T_a_b = se3.relative(T_a, T_b)
        J_a, J_b = se3.relative_jacobians(T_a, T_b)
        cov = J_a @ self.cov[:-1] @ np.swapaxes(J_a, 1, 2) + J_b @ self.cov[1:] @ np.swapaxes(J_b, 1, 2)
        vec = se3.vector(T_a_b)
        to_vec = np.linalg.inv(se3.vec_jacobian(vec))
        cov = to_vec @ (cov + self.drift[1:]) @ np.swapaxes(to_vec, 1, 2)
        return Motions(self.stamps[:-1], self.stamps[1:], vec, cov, lean=self.lean)
