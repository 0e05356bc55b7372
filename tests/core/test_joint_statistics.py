"""Whether the joint estimator's sigmas hold: the experiments of docs/results/honesty.py on few rigs.

Bounds are those of the experiments, widened for how few rigs there are.
"""

import importlib.util
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from click.testing import CliRunner

FOLDER = Path(__file__).parents[2] / "docs/results"
METHOD = "joint"


@pytest.fixture(scope="module")
def lab():
    """The experiments' modules; their folder comes last, for one of them is named like Python's own statistics."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "path", [*sys.path, str(FOLDER)])
        spec = importlib.util.spec_from_file_location("experiments", FOLDER / "honesty.py")
        experiments = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(experiments)
        names = ("bound", "failures", "rigs", "summaries")
        yield SimpleNamespace(experiments=experiments, **{name: sys.modules[name] for name in names})


@pytest.fixture(scope="module")
def three(lab):
    """Rigs of a lidar, an INS and a camera on normal drives."""
    return [lab.rigs.draw(seed, lab.rigs.NORMAL[seed % 3], 3) for seed in range(24)]


@pytest.fixture(scope="module")
def outcomes(lab, three):
    return [lab.rigs.solve(rig, METHOD) for rig in three]


def test_the_band_of_500_rigs(lab):
    assert lab.summaries.band(6, 500) == pytest.approx((5.61, 6.41), abs=0.01)
    assert lab.summaries.band(1, 500) == pytest.approx((0.84, 1.17), abs=0.01)


def test_information_is_that_of_two_readings_of_one_motion(lab):
    """Two sensors: what the latent motion leaves is what either's noise, carried to the other, leaves."""
    rig = lab.rigs.draw(3, "street", 2, 30.0)
    true, (a, b) = rig.path, rig.sensors
    stamps = lab.bound.instants(true)
    J_x, J_z = lab.bound._sensitivity(true, a, b, stamps, lab.bound._motion(true, a, stamps))
    noise = np.diag(np.square(b.sigma)) + J_z @ np.diag(np.square(a.sigma)) @ np.swapaxes(J_z, 1, 2)
    expected = np.einsum("mki,mkj->ij", J_x, np.linalg.solve(noise, J_x))
    assert lab.bound.information(true, rig.sensors) == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize(
    ("drive", "count"),
    [("static", 7), ("straight-constant", 5), ("straight", 4), ("turn", 3), ("planar", 1), ("street", 0)],
)
def test_what_a_drive_leaves_open_comes_from_the_true_motion(lab, drive, count):
    rig = lab.rigs.draw(1, drive, 2, 60.0, level=True)
    null, vague = lab.bound.null_space(lab.bound.information(rig.path, rig.sensors))
    assert len(null) == count
    assert vague >= count
    if drive == "planar":
        assert np.abs(null[0]) == pytest.approx(np.eye(7)[2], abs=1e-3)
    if drive == "turn":  # round the centre, 20 m aside: yaw mixed with a shift, beside height and clock
        about = np.array([20.0, -0.6, 0.0, 0.0, 0.0, 1.0, 0.0])
        assert np.linalg.norm(null @ about) == pytest.approx(np.linalg.norm(about), rel=1e-3)


def test_a_command_prints_what_it_writes(lab, tmp_path):
    file = tmp_path / "coverage.md"
    options = ["--rigs", "1", "--jobs", "1", "--method", "paper", "--out", str(file)]
    done = CliRunner().invoke(lab.experiments.main, ["coverage", *options], catch_exceptions=False)
    assert done.exit_code == 0
    assert file.read_text() in done.output
    assert file.read_text().count("\n| ") == 15


@pytest.mark.long
def test_errors_are_as_large_as_stated(lab, outcomes):
    assert not [o["refused"] for o in outcomes if o["refused"]]
    assert sum(bool(o["flagged"]) for o in outcomes) <= 1
    for i in range(2):
        assert 3.6 < lab.summaries.mean([lab.rigs.nees(o, [i], range(6)) for o in outcomes]) < 8.8
    pull = np.array([lab.rigs.pulls(o) for o in outcomes])
    assert 0.5 < np.nanmean(pull[..., 6] ** 2) < 1.7
    known = np.abs(pull[np.isfinite(pull)])
    assert 0.58 < np.mean(known < 1) < 0.78
    assert np.mean(known < 2) > 0.92
    assert np.mean(known < 3) > 0.985


@pytest.mark.long
def test_cameras_alone_tell_their_turns(lab):
    rigs = [lab.rigs.draw(seed, lab.rigs.NORMAL[seed % 3], 3, places=lab.rigs.CAMERAS) for seed in range(9)]
    found = [lab.rigs.solve(rig, METHOD) for rig in rigs]
    turns = [lab.rigs.nees(o, [i], (3, 4, 5)) for o in found for i in range(2)]
    assert np.all(np.isfinite(turns))
    assert 1.4 < np.mean(turns) < 5.0


@pytest.mark.long
def test_three_readings_in_ten_may_be_wrong(lab, three, outcomes):
    wrong = [lab.rigs.solve(lab.experiments.change(rig, "all", outliers=0.3), METHOD) for rig in three[:7]]
    per_dof = lab.summaries.mean([lab.rigs.nees(o, [i], range(6)) / 6 for o in wrong for i in range(2)])
    assert 0.5 < per_dof < 1.7
    assert sum(not np.all(o["determined"]) for o in wrong) <= 1
    known = (np.array([np.where(o["determined"], o["error"], np.nan) for o in f]) for f in (wrong, outcomes[:7]))
    error, clean = (np.nanmean(e**2, axis=0) for e in known)
    assert lab.summaries.rms(np.sqrt(error / clean)) < 1.8
    rejected = [list(o["statistics"]["rejected"].values()) for o in wrong]
    assert 0.15 < np.mean(rejected) < 0.45


@pytest.mark.long
@pytest.mark.parametrize("stated", [0.5, 2.0])
def test_a_wrong_sigma_is_found_out_among_three_sensors(lab, three, stated):
    found = [lab.rigs.solve(lab.experiments.change(rig, "ins", stated=stated), METHOD) for rig in three[:5]]
    for part in ("turns", "shifts"):
        scale = [o["statistics"]["noise_scale"]["ins"][part] * stated**2 for o in found]
        assert 0.8 < np.median(scale) < 1.25
    assert 0.5 < lab.summaries.mean([lab.rigs.nees(o, [i], range(6)) / 6 for o in found for i in range(2)]) < 2.0


@pytest.mark.long
@pytest.mark.parametrize("drive", ["static", "straight-constant", "straight", "turn", "planar"])
def test_what_a_drive_left_open_is_flagged(lab, drive):
    found = {
        seconds: [lab.failures.look(lab.rigs.draw(seed, drive, 2, seconds, level=True), METHOD) for seed in range(2)]
        for seconds in (30.0, 120.0)
    }
    for outcome in found[30.0] + found[120.0]:
        assert outcome["aside"] < lab.failures.ASIDE_DEG
        assert outcome["flagged"] <= outcome["vague"] or outcome["refused"]
        assert outcome["refused"] or not np.any(np.abs(lab.rigs.pulls(outcome)) > 5)
    short, long = (np.median([o["along"] for o in found[s]]) for s in (30.0, 120.0))
    assert np.isnan(short) or np.isnan(long) or long > 0.7 * short


@pytest.mark.long
@pytest.mark.parametrize(("most_dt", "seconds", "count"), [(1.0, 60.0, 8), (60.0, 120.0, 2)])
def test_sensors_that_sit_anyhow_are_placed_or_refused(lab, most_dt, seconds, count):
    rigs = [lab.experiments.anyhow(seed, most_dt, seconds) for seed in range(count)]
    found = [lab.rigs.solve(rig, METHOD) for rig in rigs]
    told = lab.rigs.solved(found)
    assert [o["seed"] for o in told if not lab.summaries.right(o)] == []
    assert most_dt > 1 or sum(bool(np.all(o["determined"])) for o in told) >= count - 1


@pytest.mark.long
def test_errors_are_near_the_bound_and_below_the_papers(lab, three):
    found = [lab.experiments.against_bound(lab.experiments.together(rig)) for rig in three[:6]]
    ratio = {method: np.array([o[method] for o in found]) for method in (METHOD, "paper")}
    assert lab.summaries.rms(ratio[METHOD]) < 1.35
    assert lab.summaries.rms(ratio[METHOD]) < lab.summaries.rms(ratio["paper"])
    for i, k in np.ndindex(2, 7):
        assert 0.3 < lab.summaries.rms(ratio[METHOD][:, i, k]) < 2.0
