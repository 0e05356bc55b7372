"""What a drive does not tell is refused or left open: no turns, a plane, cameras alone, clocks far apart."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from small_runs import CAM, CAM1, HEAD, INS, VELO

BODIES = pytest.mark.parametrize(
    "body", [VELO + INS, VELO + INS + CAM, CAM + CAM1], ids=["scaled", "camera", "cameras"]
)


@BODIES
@pytest.mark.parametrize(("kind", "method"), [("static", "joint"), ("static", "paper"), ("straight", "paper")])
def test_no_turning_at_all(refused, drive, kind, method, body):
    sentence = refused(drive(body, HEAD + f"drive = '{kind}'\n"), "--method", method)
    assert "turn" in sentence
    assert "overlap" not in sentence
    assert "drive" in sentence.partition("turn")[2]  # what to do about it


def test_cameras_on_a_straight_drive_are_refused(refused, drive):
    sentence = refused(drive(CAM + CAM1, HEAD + "drive = 'straight'\n"))
    assert "drive bends to both sides" in sentence


@pytest.mark.parametrize("body", [VELO + INS, VELO + INS + CAM], ids=["scaled", "camera"])
def test_a_straight_drive_leaves_open_what_it_can_not_tell(run, drive, written, body):
    result = run(drive(body, HEAD + "drive = 'straight'\n"))
    assert result.exit_code == 3, result.output
    found = written()
    for name in list(found["sensors"])[1:]:
        assert [found["sensors"][name]["sigma"][k] for k in ("x", "y", "z", "rx")] == [None] * 4
        assert all(found["sensors"][name]["sigma"][k] > 0 for k in ("ry", "rz"))
    said = " ".join(u["sentence"] for u in found["undetermined"])
    assert "the vehicle only drove straight ahead; drive bends to both sides" in said


def test_a_plane_tells_no_height(run, drive, written):
    result = run(drive(head=HEAD + "drive = 'planar'\n"))
    assert result.exit_code == 3
    found = written()
    assert found["sensors"]["ins"]["sigma"]["z"] is None
    assert found["sensors"]["ins"]["T_base_sensor"][2][3] is None
    assert any("ins" in u["sentence"] and u["direction"].get("ins.z", 0) for u in found["undetermined"])


def test_cameras_only_have_rotation_and_time_but_no_translation(run, drive, written):
    result = run(drive(CAM + CAM1))
    assert result.exit_code == 3, result.output
    found = written()
    cam1 = found["sensors"]["cam1"]
    T = np.array(cam1["T_base_sensor"], dtype=float)
    truth = Rotation.from_euler("ZYX", [[-90, 0, -90], [-120, 0, -90]], degrees=True)
    error = (truth[0].inv() * truth[1]).inv() * Rotation.from_matrix(T[:3, :3])
    assert np.degrees(error.magnitude()) < 1.5
    assert abs(cam1["dt_base_sensor"]) < 0.01
    assert np.isnan(T[:3, 3]).all()
    assert [cam1["sigma"][k] for k in "xyz"] == [None] * 3
    assert all(cam1["sigma"][k] > 0 for k in ("rx", "ry", "rz", "dt"))
    reasons = [u["sentence"] for u in found["undetermined"] if u["direction"].get("cam1.x")]
    assert reasons
    assert "no sensor knows distances" in reasons[0]


def test_no_overlap_in_time(refused, drive):
    sentence = refused(drive(VELO + INS.replace("-0.06", "100.0")))
    assert "velo" in sentence
    assert "ins" in sentence
    assert "epoch" in sentence


def test_clocks_that_are_far_apart_are_found(run, rig, written):
    result = run(rig(lambda t, p, q: (t + 15.0, p, q)))
    assert result.exit_code == 0, result.output
    b = written()["sensors"]["b"]
    assert b["dt_base_sensor"] == pytest.approx(-15.0, abs=2e-3)
    assert [row[3] for row in b["T_base_sensor"][:3]] == pytest.approx([0.5] * 3, abs=4 * b["sigma"]["z"])


def test_clocks_further_apart_than_the_papers_search_are_not_believed(run, rig, written):
    result = run(rig(lambda t, p, q: (t + 15.0, p, q)), "--method", "paper")
    if result.exit_code == 1:
        return
    assert result.exit_code == 3, result.output
    b = written()["sensors"]["b"]
    assert b["dt_base_sensor"] is None
    # what was made of readings that do not belong together must not pass as measured
    assert [b["sigma"][k] for k in ("x", "y", "z", "rx", "ry", "rz")] == [None] * 6
