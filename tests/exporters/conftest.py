"""What tests of exporters share."""

import numpy as np
import pytest
from exported_rigs import Exporting

from calib_toolkit import CameraIntrinsics
from calib_toolkit.plugins import registry


@pytest.fixture
def exporting(tmp_path, installed):
    """Out and back in, in a temporary folder."""
    return Exporting(tmp_path, installed)


@pytest.fixture(scope="session")
def installed():
    """The registry, which takes a while to build."""
    return registry()


@pytest.fixture
def camera():
    """Intrinsics that every format can hold."""
    return CameraIntrinsics(np.array([[700.0, 0, 320], [0, 710, 240], [0, 0, 1]]), size=(640, 480))
