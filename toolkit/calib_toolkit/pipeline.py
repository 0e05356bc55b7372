"""From a recorded drive to a calibrated rig: each sensor's own motion, then all of them together."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path

from calib_toolkit import antenna, appearance, assembly, cache, joint, paper
from calib_toolkit.config import Config
from calib_toolkit.errors import ConfigError, DataError
from calib_toolkit.estimation import SensorMotion, estimate_motions
from calib_toolkit.plugins import Registry, registry
from calib_toolkit.progress import Progress, Silent
from calib_toolkit.result_file import read_calibration
from calib_toolkit.types import Calibration, Log, Motions, Result, Trajectory

METHODS = {"joint": joint, "paper": paper}
"""The estimators: modules with ``calibrate`` and ``clock_offsets``."""
TRUTH = "truth.json"
"""A calibration that may lie in a recording's folder, to compare with."""


def open_log(path: Path | str, format_id: str | None = None, plugins: Registry | None = None) -> Log:
    """The recording at a path, by the reader named or the one that recognises it. Raises DataError.

    A ``truth.json`` in its folder, in the schema of calibration.json, becomes the log's reference.
    """
    log = (plugins or registry()).open_log(Path(path), format_id)
    folder = Path(path) if Path(path).is_dir() else Path(path).parent
    truth = folder / TRUTH
    return replace(log, reference=read_calibration(truth)) if truth.is_file() else log


def calibrate(
    log: Log,
    config: Config | None = None,
    plugins: Registry | None = None,
    progress: Progress | None = None,
    cache_folder: Path | None = None,
    pictures: Path | None = None,
) -> Result:
    """Where every sensor of the log sits and how late its clock is. Raises CalibrationError.

    First each sensor's own motion, then :func:`calibrate_motions`, then what pairs that see the same place look like,
    and at last receivers that tell positions alone.
    pictures: folder for overlays of each pair before and after that.
    """
    config, plugins, progress = config or Config(), plugins or registry(), progress or Silent()
    log = log.trim(config.start, config.duration)
    folder = cache_folder or cache.default_folder()
    moved = sensor_motions(log, config, plugins, progress, folder)
    antennas = {n: m.motion for n, m in moved.items() if isinstance(m.motion, Trajectory) and m.is_antenna}
    names = _base_first({n: m for n, m in moved.items() if n not in antennas}, config.base)
    skipped = [*log.notes, *(note for n in (*names, *antennas) for note in (*log.streams[n].notes, *moved[n].notes))]
    clocks = [log.streams[n].clock for n in names]
    motions = {n: moved[n].motions for n in names}
    result = calibrate_motions(motions, _without(config, antennas), clocks, skipped, progress)
    whole = {n: moved[n].motion for n in names}
    result = appearance.refine(result, log, whole, config, plugins, progress, pictures, folder)
    return _with_antennas(result, motions[names[0]], antennas, config) if antennas else result


def sensor_motions(
    log: Log, config: Config, plugins: Registry, progress: Progress, cache_folder: Path
) -> dict[str, SensorMotion]:
    """Each sensor's own motion with its covariance (section V)."""
    if len(log.streams) < 2:
        raise DataError(
            f"{log.source}: calibrating takes at least two sensors, and this is {', '.join(log.streams) or 'none'}; "
            "name more with --sensors"
        )
    streams = [(s, plugins.sensor(s.kind, s.name)) for s in log.streams.values()]
    return estimate_motions(streams, config.sensors, progress, config.jobs, cache_folder)


def calibrate_motions(
    motions: Mapping[str, Motions],
    config: Config | None = None,
    clocks: Sequence[str] = (),
    warnings: Sequence[str] = (),
    progress: Progress | None = None,
) -> Result:
    """The calibration that the sensors' motions tell, by the method chosen; the first sensor is the base.

    clocks: (n,) sensors that name the same clock share one offset; each its own if empty. Raises CalibrationError.
    """
    config = config or Config()
    if len(motions) == 1:
        found = Result(assembly.alone(*motions), {})
    else:
        found = METHODS[config.method].calibrate(motions, config, clocks or tuple(motions), progress or Silent())
    chosen = {
        **asdict(config),
        "prior": [asdict(m) for m in config.prior],
        "appearance": list(config.appearance),
    }
    return replace(found, warnings=tuple(warnings), configuration=chosen)


def clock_offsets(
    motions: Mapping[str, Motions], config: Config | None = None, clocks: Sequence[str] = ()
) -> Calibration:
    """How late each clock is, and nothing else: the first stage alone. Arguments as of :func:`calibrate_motions`."""
    config = config or Config()
    return METHODS[config.method].clock_offsets(motions, config, clocks or tuple(motions))


def _without(config: Config, sensors: Collection[str]) -> Config:
    """The same with nothing measured of some sensors."""
    return replace(config, prior=tuple(m for m in config.prior if m.sensor not in sensors))


def _with_antennas(result: Result, base: Motions, antennas: Mapping[str, Trajectory], config: Config) -> Result:
    """The result with receivers that tell positions alone, and with all that was measured."""
    stated = {**result.configuration, "prior": [asdict(m) for m in config.prior]}
    measured = [m for m in config.prior if m.sensor in antennas]
    return antenna.added(replace(result, configuration=stated), base, antennas, measured)


def _base_first(moved: Mapping[str, SensorMotion], base: str | None) -> list[str]:
    """The sensors' names, the base before the others: the one chosen, or the first that has scale."""
    if not moved:
        raise DataError("positions alone tell nothing of each other; add a lidar or an odometry")
    if base is not None and base not in moved:
        raise ConfigError(f"the base '{base}' is not among the sensors; there are: {', '.join(moved)}")
    scaled = [n for n, m in moved.items() if m.motions.has_scale]
    first = base or (scaled or list(moved))[0]
    if scaled and first not in scaled:
        raise ConfigError(
            f"the base '{first}' is a camera and knows no distances; choose one of: {', '.join(scaled)}"
        )
    return [first, *(n for n in moved if n != first)]
