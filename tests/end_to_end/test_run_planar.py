"""What a plane does not tell: nulls in the file, sentences in the table, and a measured height that fills them."""

import json

import numpy as np
import pytest
from small_runs import SHARP_CAM, SHARP_INS, SHARP_VELO, as_array, recorded, run

from calib_toolkit.result_file import read_calibration

DRIVE = 'seconds = 80\nseed = 5\ndrive = "planar"\n' + SHARP_VELO + SHARP_INS + SHARP_CAM + "dt = 0.025\n"


@pytest.fixture(scope="module")
def planar(tmp_path_factory):
    """A drive on a plane: (what was printed, the file's content as text)."""
    folder = tmp_path_factory.mktemp("planar")
    status, printed, text = run(recorded(folder, DRIVE), folder / "out")
    assert status == 3, printed
    return printed, text


def test_what_was_not_determined_is_null_with_a_direction_and_a_sentence(planar):
    printed, found = planar[0], json.loads(planar[1])
    assert found["undetermined"]
    order = found["covariance"]["order"]
    matrix = as_array(found["covariance"]["matrix"])
    for u in found["undetermined"]:
        assert set(u) == {"direction", "sentence"}
        assert set(u["direction"]) <= set(order)
        assert np.linalg.norm(list(u["direction"].values())) == pytest.approx(1)
        assert f"not determined: {u['sentence']}" in printed
    for name in ("ins", "cam0"):
        sensor = found["sensors"][name]
        assert sensor["sigma"]["z"] is None
        assert sensor["T_base_sensor"][2][3] is None
        assert np.isnan(matrix[order.index(f"{name}.z")]).all()
        assert sensor["sigma"]["dt"] > 0
    assert np.isfinite(matrix[order.index("ins.dt"), order.index("ins.dt")])


def test_only_the_height_of_a_planar_drive_is_open(planar):
    """A camera, which knows no distances, hardly tells how far to the side it sits either; that is said apart."""
    undetermined = [u for u in json.loads(planar[1])["undetermined"] if "found only to" not in u["sentence"]]
    assert [u["direction"] for u in undetermined] == [{"ins.z": 1.0}, {"cam0.z": 1.0}]
    assert all("or give a measured value with --prior" in u["sentence"] for u in undetermined)


def test_a_measured_height_fills_the_null(tmp_path):
    (tmp_path / "tape.toml").write_text("base = 'velo'\n[ins]\nz = [-0.80, 0.02]\n")
    status, printed, text = run(
        recorded(tmp_path, DRIVE), tmp_path / "out", "--prior", tmp_path / "tape.toml", "--sensors", "velo,ins"
    )
    assert status == 0, printed
    found = json.loads(text)
    assert found["sensors"]["ins"]["T_base_sensor"][2][3] == pytest.approx(-0.8, abs=1e-3)
    assert found["sensors"]["ins"]["sigma"]["z"] == pytest.approx(0.02, rel=0.02)
    assert found["statistics"]["prior"] == ["ins.z"]
    assert "note: held by measured values: ins.z" in printed


def test_a_null_stays_a_null_when_read_back(planar, tmp_path):
    (tmp_path / "calibration.json").write_text(planar[1])
    c = read_calibration(tmp_path / "calibration.json")
    assert not c.determined[c.index("ins"), 2]
    assert np.isnan(c.sigma[c.index("ins"), 2])
    assert not c.between("velo", "ins").has_scale
    assert [u.sentence for u in c.undetermined]
