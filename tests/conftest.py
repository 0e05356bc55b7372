"""Shared fixtures. Tests on real recordings find them through CALIB_TOOLKIT_TEST_DATA and skip without it."""

import os
from pathlib import Path

import pytest

DATA_VARIABLE = "CALIB_TOOLKIT_TEST_DATA"


@pytest.fixture(scope="session")
def recordings() -> Path:
    """The folder of real recordings (multi-array-calib/, kitti-drive-0027/, kitti360-3000/)."""
    folder = os.environ.get(DATA_VARIABLE)
    if not folder:
        pytest.skip(f"{DATA_VARIABLE} is not set: no real recordings to test on")
    if not Path(folder).is_dir():
        pytest.fail(f"{DATA_VARIABLE} names {folder}, which is not a folder")
    return Path(folder)
