"""One rig that several modules look at."""

import pytest
from calibrated_rigs import JOINT, QUICK, ROUGH, log_of

from calib_toolkit import calibrate


@pytest.fixture(scope="session")
def joint():
    """The rig on a rough drive, by the joint estimator."""
    return calibrate(log_of(ROUGH), JOINT)


@pytest.fixture(scope="session")
def paper():
    """The rig on a rough drive, by the paper's method."""
    return calibrate(log_of(ROUGH), QUICK)
