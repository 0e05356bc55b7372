"""The paper's section IV: timing, then rotation, then translation, over all sensors; the first is the base."""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from calib_toolkit import assembly, checks, observability, rotation, sync, timing, translation
from calib_toolkit.config import Config
from calib_toolkit.progress import Progress
from calib_toolkit.types import Calibration, Motions, Result, Undetermined

Array = NDArray[np.float64]

STAGES = "timing, rotation, translation"


def calibrate(motions: Mapping[str, Motions], config: Config, clocks: Sequence[str], progress: Progress) -> Result:
    """All stages, over all sensors at once. clocks: (n,) sensors with equal ones share an offset.

    Raises CalibrationError.
    """
    checks.without_prior(config.prior)
    progress.begin(STAGES, 3)
    names = tuple(motions)
    chains, offsets, unknown_times = _times(motions, config, clocks)
    progress.advance(STAGES, 1)

    steps = sync.synchronise(_on_base_clock(chains, offsets.dt), config.sync.gate)
    checks.steps(steps)
    checks.lengths(names, steps)
    steps = sync.add_timing_noise(steps, offsets.cov)

    rotations = rotation.estimate(steps, config.rotation)
    unknown_turns = observability.unmeasured_turns(names, steps, rotations.R_base_sensor)
    checks.turning(names, unknown_turns)
    unknown_turns += observability.vague_turns(names, rotations.cov, unknown_turns)
    progress.advance(STAGES, 1)

    translations = translation.estimate(steps, rotations, config.translation)
    unknown_shifts = observability.unmeasured_shifts(names, steps, rotations.R_base_sensor, unknown_turns)
    unknown_shifts += observability.vague_shifts(names, translations.cov, unknown_shifts)
    progress.advance(STAGES, 1)

    timed = assembly.calibration(names, steps.has_scale, unknown_times, offsets)
    turned = assembly.calibration(names, steps.has_scale, [*unknown_times, *unknown_turns], offsets, rotations)
    unknown = [*unknown_times, *unknown_turns, *unknown_shifts]
    placed = assembly.calibration(names, steps.has_scale, unknown, offsets, rotations, translations)
    return Result(
        placed,
        {"timing": timed, "rotation": turned, "translation": placed},
        statistics={
            "readings": {n: len(m) for n, m in motions.items()},
            "common_steps": len(steps),
            "steps_rejected": steps.rejected,
            "disagreement": rotation.disagreement(rotations.R_base_sensor, names, steps),
            "seconds": float(np.sum(np.diff(steps.ends, axis=1))),
        },
    )


def clock_offsets(motions: Mapping[str, Motions], config: Config, clocks: Sequence[str]) -> Calibration:
    """The first stage alone. Raises CalibrationError."""
    chains, offsets, unknown = _times(motions, config, clocks)
    return assembly.calibration(tuple(motions), np.array([c.has_scale for c in chains]), unknown, offsets)


def _times(
    motions: Mapping[str, Motions], config: Config, clocks: Sequence[str]
) -> tuple[list[sync.Chain], timing.TimeOffsets, list[Undetermined]]:
    names = tuple(motions)
    checks.moved(motions)
    chains = [sync.chain(m) for m in motions.values()]
    checks.overlap(names, chains, config.timing.max_offset)
    offsets = timing.estimate(chains, clocks, config.timing)
    unknown = observability.unmeasured_times(names, _on_base_clock(chains, offsets.dt), clocks)
    return chains, timing.without(offsets, ~assembly.determined(names, unknown)[:, 6]), unknown


def _on_base_clock(chains: Sequence[sync.Chain], dt: Array) -> list[sync.Chain]:
    return [c.shifted(d) for c, d in zip(chains, dt, strict=True)]
