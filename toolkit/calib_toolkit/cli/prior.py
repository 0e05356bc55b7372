"""What ``run --prior`` takes: measured numbers in TOML, or a calibration from elsewhere."""

from pathlib import Path
from typing import TYPE_CHECKING

from calib_toolkit.errors import DataError

if TYPE_CHECKING:
    from calib_toolkit.prior_file import Prior


def read(file: Path) -> "Prior":
    """The numbers of a TOML file, or of a calibration in JSON with a sigma. Raises DataError."""
    from calib_toolkit.prior_file import read_prior

    return _of_calibration(file) if file.suffix == ".json" else read_prior(file)


def _of_calibration(file: Path) -> "Prior":
    """Each number that is determined, with its own sigma; correlations are not taken over."""
    import numpy as np

    from calib_toolkit.cli.compare import NUMBERS
    from calib_toolkit.cli.tables import readable
    from calib_toolkit.prior_file import SUREST, Prior
    from calib_toolkit.result_file import read_calibration
    from calib_toolkit.types import Measured

    c = read_calibration(file)
    if not c.covariance.any():
        raise DataError(
            f"{file} does not say how sure its numbers are, which a prior must; import it again with --sigma"
        )
    unit = np.array([1.0] * 3 + [np.pi / 180] * 3 + [1e-3])
    numbers = []
    for name in c.names:
        if name != c.base:
            values, sigmas = readable(c, name)
            rows = zip(NUMBERS, values * unit, sigmas * unit, strict=True)
            numbers += [Measured(name, key, float(v), max(float(s), SUREST)) for key, v, s in rows if s > 0]
    return Prior(c.base, tuple(numbers))
