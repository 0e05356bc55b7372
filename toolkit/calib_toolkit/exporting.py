"""A calibration in the formats of other programs: what may go out, and what came in."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from calib_toolkit import se3
from calib_toolkit.comparison import rebased
from calib_toolkit.errors import DataError
from calib_toolkit.hookspecs import Exporter
from calib_toolkit.types import Calibration, CameraIntrinsics
from calib_toolkit.types.calibration import PARAMETERS


def selected(calibration: Calibration, sensors: Sequence[str]) -> Calibration:
    """Some of the sensors, in the frame and clock of the base or, if it is not among them, of the first.

    Raises DataError for a name that is not there.
    """
    for name in sensors:
        if name not in calibration.names:
            raise DataError(f"there is no sensor '{name}' in it; there are: {', '.join(calibration.names)}")
    names = sorted(dict.fromkeys(sensors), key=lambda name: name != calibration.base)
    return rebased(calibration, names, calibration.t_ref)


def export(
    calibration: Calibration,
    path: Path,
    exporter: Exporter,
    intrinsics: Mapping[str, CameraIntrinsics] | None = None,
    overwrite: bool = False,
) -> list[Path]:
    """The files that an exporter wrote at a path and beside it, all of them or none.

    Raises DataError where the drive did not determine what the format would state, where a name can not be written,
    and where a file is there already, unless it may be overwritten.
    """
    path = path.absolute()
    if len(calibration.names) < 2:
        raise DataError(f"{calibration.names[0]} alone has no pose to write; take at least two sensors")
    _refuse_names(calibration)
    if not exporter.holds_unknown:
        _refuse_unknown(calibration, exporter.id)
    calibration = _exact(calibration)
    try:
        with TemporaryDirectory(prefix=".export-", dir=path.parent) as folder:
            exporter.write(calibration, Path(folder) / path.name, intrinsics or {})
            made = sorted(f.relative_to(folder) for f in Path(folder).rglob("*") if f.is_file())
            files = [path.parent / f for f in made]
            if (there := [f for f in files if f.exists()]) and not overwrite:
                raise DataError(f"{there[0]} is there already; choose another file with -o, or --overwrite it")
            for part, file in zip(made, files, strict=True):
                file.parent.mkdir(exist_ok=True)
                (Path(folder) / part).replace(file)
    except OSError as e:
        raise DataError(f"{path} can not be written ({e.strerror or e}); choose another place with -o") from e
    return files


def _exact(c: Calibration) -> Calibration:
    """The same with rotations that are ones to the last digit, and the base at identity."""
    T = se3.rigid(se3.exp_so3(se3.log_so3(c.T_base_sensor[:, :3, :3])), c.T_base_sensor[:, :3, 3])
    T[c.index(c.base)] = np.eye(4)
    return replace(c, T_base_sensor=T)


def _refuse_names(c: Calibration) -> None:
    for name in c.names:
        if not name.isprintable() or name != name.strip() or not name:
            raise DataError(
                f"the sensor name {name!r} is empty, begins or ends with a space, or holds what can not be printed; "
                "rename it in the calibration"
            )


def _refuse_unknown(c: Calibration, format_id: str) -> None:
    unknown = ~c.determined[:, :6]
    bad = {
        c.names[i]: [PARAMETERS[k] for k in np.flatnonzero(unknown[i])] for i in np.flatnonzero(unknown.any(axis=1))
    }
    if not bad:
        return
    what = "; ".join(f"{', '.join(numbers)} of {n}" for n, numbers in bad.items())
    rest = [n for n in c.names if n not in bad]
    leave = f"leave the sensor out with --sensors {','.join(rest)}, " if len(rest) > 1 else ""
    raise DataError(
        f"the drive did not determine {what}, which {format_id} can not say; {leave}measure it and give it to "
        "run --prior, or choose yaml or csv, which say null"
    )
