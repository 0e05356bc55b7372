"""Where each sensor sits and how late its clock is, with the joint uncertainty of everything."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from calib_toolkit import se3

Array = NDArray[np.float64]

PARAMETERS = ("x", "y", "z", "rx", "ry", "rz", "dt")
"""One sensor's parameters, in the order of every joint covariance: metres, radians (delta), seconds."""
WANTED = {"x": 0.02, "y": 0.02, "z": 0.02, "rx": 1e-3, "ry": 1e-3, "rz": 1e-3, "dt": 1e-3}
"""Sigma that most uses of a calibration ask for: metres, radians, seconds."""


@dataclass(frozen=True)
class Transform:
    """Pose of frame b in frame a with its covariance.

    T_a_b: (4, 4); maps points in b to a; translation nan where it is not known.
    cov: (6, 6) of ``[x y z rx ry rz]``: ``t_true = t + dt``, ``R_true = Exp(delta) R``, both in axes of a.
    has_scale: False if only the direction of the translation is known.
    """

    a: str
    b: str
    T_a_b: Array
    cov: Array
    has_scale: bool = True


@dataclass(frozen=True)
class Undetermined:
    """A direction of parameter space that the drive says nothing about.

    direction: unit vector over named parameters, ``{"cam0.z": 1.0}``; sentence: what and why and what to do.
    """

    direction: Mapping[str, float]
    sentence: str


@dataclass(frozen=True)
class Calibration:
    """A rig: every sensor's pose in the base sensor's frame, and its clock.

    names: the sensors, base included. T_base_sensor: (n, 4, 4). dt_base_sensor: (n,) seconds, added to a
    sensor's stamp to get base time. has_scale: (n,) whether the sensor measures distances itself.
    covariance: (7n, 7n) in the order of ``names`` x ``PARAMETERS``; rotations are ``delta`` in
    ``R_true = Exp(delta) R_est``, base axes; rows of the base are zero.
    determined: (n, 7) False where the drive does not determine the parameter (its value is then not to be used).
    clock_skew: (n,) seconds per second about ``t_ref``.
    """

    base: str
    names: tuple[str, ...]
    T_base_sensor: Array
    dt_base_sensor: Array
    covariance: Array
    has_scale: NDArray[np.bool_]
    determined: NDArray[np.bool_]
    undetermined: tuple[Undetermined, ...] = ()
    clock_skew: Array = field(default_factory=lambda: np.zeros(0))
    t_ref: float = 0.0

    def __post_init__(self) -> None:
        if not self.clock_skew.size:
            object.__setattr__(self, "clock_skew", np.zeros(len(self.names)))

    def index(self, name: str) -> int:
        """Row of a sensor."""
        return self.names.index(name)

    def renamed(self, names: Mapping[str, str]) -> "Calibration | None":
        """With other names for some sensors, and without those whose names are taken; None if the base's is."""
        taken = {new for old, new in names.items() if new != old}
        if self.base in taken and self.base not in names:
            return None
        keep = [i for i, n in enumerate(self.names) if n in names or n not in taken]
        rows = (7 * np.array(keep)[:, None] + np.arange(7)).ravel()
        return replace(
            self,
            base=names.get(self.base, self.base),
            names=tuple(names.get(self.names[i], self.names[i]) for i in keep),
            T_base_sensor=self.T_base_sensor[keep],
            dt_base_sensor=self.dt_base_sensor[keep],
            covariance=self.covariance[np.ix_(rows, rows)],
            has_scale=self.has_scale[keep],
            determined=self.determined[keep],
            undetermined=(),
            clock_skew=self.clock_skew[keep],
        )

    @property
    def sigma(self) -> Array:
        """(n, 7) one-sigma of each parameter; nan where the drive does not determine it."""
        variance = np.diag(self.covariance).reshape(-1, 7)
        return np.where(self.determined, np.sqrt(np.maximum(variance, 0.0)), np.nan)

    def between(self, a: str, b: str) -> Transform:
        """``T_a_b`` of any two sensors, with the covariance that their joint covariance gives it."""
        i, j = self.index(a), self.index(b)
        T_w_a, T_w_b = self.T_base_sensor[i], self.T_base_sensor[j]
        J_a, J_b = se3.relative_jacobians(T_w_a, T_w_b)
        J = np.concatenate([J_a, J_b], axis=1)
        rows = np.r_[7 * i : 7 * i + 6, 7 * j : 7 * j + 6]
        cov = J @ self.covariance[np.ix_(rows, rows)] @ J.T
        known = bool(np.all(self.determined[[i, j], :3]))
        return Transform(a, b, se3.relative(T_w_a, T_w_b), cov, known)

    def dt_at(self, a: str, b: str, stamp: float) -> float:
        """``dt_a_b`` at a stamp, seconds: where clocks run at different speeds it changes with time."""
        i, j = self.index(a), self.index(b)
        return self.dt_between(a, b)[0] + float(self.clock_skew[j] - self.clock_skew[i]) * (stamp - self.t_ref)

    def dt_between(self, a: str, b: str) -> tuple[float, float]:
        """``dt_a_b`` (added to b's stamps to get a's time) and its sigma, seconds."""
        i, j = self.index(a), self.index(b)
        rows = [7 * i + 6, 7 * j + 6]
        C = self.covariance[np.ix_(rows, rows)]
        return float(self.dt_base_sensor[j] - self.dt_base_sensor[i]), float(
            np.sqrt(max(C[0, 0] + C[1, 1] - 2 * C[0, 1], 0.0))
        )
