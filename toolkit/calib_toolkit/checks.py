"""What stops a calibration between its stages: each refusal is a sentence that says what to do."""

from collections.abc import Mapping, Sequence

import numpy as np

from calib_toolkit import sync
from calib_toolkit.errors import ConfigError, DataError, NotObservableError
from calib_toolkit.types import Measured, Motions, Undetermined

LARGEST_VEHICLE = 20.0
"""Metres: no two sensors are further apart."""
FEWEST_STEPS = 20
"""Common steps below which nothing is worth estimating."""


def moved(motions: Mapping[str, Motions]) -> None:
    """Refuse sensors without any motion."""
    still = [name for name, m in motions.items() if not len(m)]
    if still:
        raise DataError(
            f"sensor {still[0]} has no motion in this part of the drive; take another part, or leave the sensor out"
        )


def overlap(names: Sequence[str], chains: Sequence[sync.Chain], max_offset: float) -> None:
    """Refuse recordings that no clock offset up to ``max_offset`` seconds brings together."""
    start, end = sync.common_span(chains)
    if start < end + max_offset:
        return
    late = names[int(np.argmax([c.knots[0] for c in chains]))]
    early = names[int(np.argmin([c.knots[-1] for c in chains]))]
    raise DataError(
        f"sensor {late} starts {start - end:.1f} s after sensor {early} ends, so they never recorded together; check "
        "that both are of the same drive and that their clocks count from the same epoch, in seconds"
    )


def steps(common: sync.Steps) -> None:
    """Refuse too few common steps."""
    if len(common) >= FEWEST_STEPS:
        return
    raise NotObservableError(
        f"the sensors share only {len(common)} steps, too few to calibrate from ({common.rejected} more were dropped "
        "because their turns disagreed by many sigma); take a longer part of the drive, or check the sensors' clocks"
    )


def lengths(names: Sequence[str], common: sync.Steps) -> None:
    """Refuse sensors that measure in different units: points of one vehicle go equally far, but for its turning."""
    length = np.linalg.norm(common.vec[..., :3], axis=-1).sum(axis=1)
    noise = np.sqrt(np.trace(common.cov[..., :3, :3], axis1=-2, axis2=-1)).sum(axis=1)
    by_turning = LARGEST_VEHICLE * np.linalg.norm(common.vec[0, :, 3:], axis=-1).sum()
    for i, name in enumerate(names[1:], start=1):
        apart = abs(length[i] - length[0]) - 4 * (noise[i] + noise[0]) - by_turning
        if common.has_scale[i] and length[i] > 0 and apart > 0.5 * min(length[i], length[0]):
            raise DataError(
                f"sensor {name} says it drove {length[i]:.4g} m where {names[0]} says {length[0]:.4g} m, so one of "
                "them is not in metres; convert it, or state has_scale = false"
            )


def turning(names: Sequence[str], unknown: Sequence[Undetermined]) -> None:
    """Refuse a drive that says nothing about any sensor."""
    open_directions = [key.rpartition(".")[0] for u in unknown for key in list(u.direction)[:1]]
    if all(open_directions.count(name) == 3 for name in names[1:]):
        raise NotObservableError(
            "the vehicle hardly turned in this part of the drive, so nothing can be told of how sensors sit; "
            "drive bends to both sides, and a ramp, kerbs or rough ground"
        )


def still() -> None:
    """Refuse a drive on which the vehicle stood."""
    raise NotObservableError(
        "the vehicle hardly moved or turned in this part of the drive, so nothing can be told of how sensors sit; "
        "drive bends to both sides, and a ramp, kerbs or rough ground"
    )


def without_prior(prior: Sequence[Measured]) -> None:
    """Refuse measured numbers, which the paper's method has no place for."""
    if prior:
        raise ConfigError("the paper's method takes no measured numbers; leave out --prior, or choose --method joint")
