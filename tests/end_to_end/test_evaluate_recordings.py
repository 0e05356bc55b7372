"""``calib-toolkit evaluate`` on the real recordings, made folders with a truth."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from evaluated import evaluate, rows_of

from calib_toolkit import open_log
from calib_toolkit.config import METHODS


@pytest.fixture(scope="module")
def folders(recordings, tmp_path_factory):
    """docs/results/recordings.py on the real recordings."""
    out = tmp_path_factory.mktemp("recordings")
    script = Path(__file__).parents[2] / "docs" / "results" / "recordings.py"
    subprocess.run([sys.executable, script, recordings, out], check=True)
    return out


def test_the_recordings_become_folders_with_a_truth(folders):
    assert sorted(f.name for f in folders.iterdir()) == ["kitti", "kitti-ins", "kitti-kiss", "ladybug", "shrimp"]
    log = open_log(folders / "kitti")
    c = log.reference
    np.testing.assert_allclose([c.dt_between("cam0", f"cam{k}")[0] for k in range(4)], [0, 0, 6.14e-3, 6.70e-3])
    assert not c.determined[c.index("velo"), 6]
    # the baseline of KITTI's grey stereo pair
    assert c.between("cam0", "cam1").T_a_b[0, 3] == pytest.approx(0.54, abs=0.01)


@pytest.mark.long
@pytest.mark.parametrize(("name", "at_most"), [("kitti", 0.6), ("ladybug", 0.7)])
def test_clocks_of_the_recordings_are_found_within_a_millisecond(folders, tmp_path, name, at_most):
    evaluate("timing", folders / name, "-o", tmp_path, "--repeats", 5, "--seconds", "100", "--jobs", 2)
    rows = rows_of(tmp_path / "timing.csv")
    for method in METHODS:
        e = np.abs([float(r["dt_ms"]) for r in rows if r["estimator"] == method])
        assert len(e) == (30 if name == "kitti" else 40)
        assert np.median(e) < at_most
        assert e.max() < 3
