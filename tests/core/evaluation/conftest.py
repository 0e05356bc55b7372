"""Drives that the experiments share."""

from dataclasses import replace

import bowls
import pytest
from builders import CAMERA, INS, LIDAR
from recorded_drives import BACK, FAST, SIDEWAYS, a_drive, sensor

from calib_toolkit.config import METHODS
from calib_toolkit.evaluation import sights


@pytest.fixture(scope="session")
def two():
    return a_drive([sensor("velo", LIDAR), sensor("ins", INS, dt=0.03, rate=20.0)])


@pytest.fixture(scope="session")
def ring():
    cameras = {"cam0": CAMERA, "cam1": SIDEWAYS, "cam2": BACK}
    return a_drive([sensor(n, T, dt=0.01 * k, has_scale=False) for k, (n, T) in enumerate(cameras.items())])


@pytest.fixture(params=METHODS)
def method(request):
    """The configuration of each method."""
    return replace(FAST, method=request.param)


@pytest.fixture(scope="session")
def seen():
    return bowls.a_drive()


@pytest.fixture
def bowl(seen, monkeypatch):
    """The one metric that is installed."""
    metric = bowls.Bowl(seen.truth.between("velo", "cam0").T_a_b)
    monkeypatch.setattr(sights, "registry", lambda: bowls.Installed(bowl=metric))
    return metric
