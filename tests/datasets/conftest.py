"""Readers as they are installed; simulated drives in no time; a small drive of KITTI raw."""

from collections.abc import Callable
from functools import partial
from pathlib import Path

import kitti_raw_drives
import pytest
from kitti_raw_drives import DriveWriter
from simulated_files import quick_reading

from calib_toolkit import Log, open_log
from calib_toolkit.plugins import Registry, registry
from calib_toolkit_datasets.simulation import writing


@pytest.fixture(scope="session")
def plugins() -> Registry:
    return registry()


@pytest.fixture
def opened(plugins: Registry) -> Callable[[Path], Log]:
    """Opens a recording by whichever reader knows it."""
    return lambda path: open_log(path, plugins=plugins)


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Readings of simulated drives that take no time."""
    monkeypatch.setattr(writing, "_reading", quick_reading)
    monkeypatch.setattr(writing, "_scene", lambda wish: None)


@pytest.fixture
def write_drive(tmp_path: Path) -> DriveWriter:
    """Writes a drive of KITTI raw of a name, a number of frames and an ending of its scans."""
    return partial(kitti_raw_drives.write_drive, tmp_path)
