"""The parts of the experiments: sections, errors, baselines, the table on disk, its statistics and its figures."""

import json
from dataclasses import replace

import numpy as np
import pytest
from builders import CAMERA, INS, LIDAR, MOUNTS, QUIET, drive, exact_turns, in_base, known_times, pose
from scipy.spatial.transform import Rotation

from calib_toolkit import CameraIntrinsics, Config, Log, Stream, config, paper, pipeline, se3
from calib_toolkit.config import METHODS
from calib_toolkit.errors import DataError, NotObservableError
from calib_toolkit.evaluation import baselines, drives, experiment, figures, measures, panorama, summary
from calib_toolkit.evaluation.errors import euler_sigma, rotation_error, rotation_sigma
from calib_toolkit.evaluation.measures import FORWARD_LEFT_UP, measure_pair, measure_panoramic, measure_timing
from calib_toolkit.evaluation.paper import beside
from calib_toolkit.evaluation.protocols import PROTOCOLS
from calib_toolkit.evaluation.sections import Draw, cut, plan
from calib_toolkit.evaluation.store import Store
from calib_toolkit.progress import Silent
from calib_toolkit.timing import TimingOptions
from calib_toolkit.types import Motions
from calib_toolkit_datasets.simulated import SimulatedSensor, measure, path, truth
from calib_toolkit_datasets.simulation.ins import InsModel
from calib_toolkit_datasets.simulation.rigs import Mounted, Rig
from calib_toolkit_datasets.simulation.rigs import truth as rig_truth

FAST = Config(method="paper", jobs=1, timing=TimingOptions(steps=1000))
PAPER = ("paper",)
SIGMA = (0.004, 0.004, 0.004, 2e-4, 2e-4, 2e-4)
SIDEWAYS, BACK = pose(0.2, 0.8, 1.1, -90, 0, -20), pose(0.1, -0.4, 1.2, -88, 1, 60)


def a_drive(sensors, seconds=60.0, seed=3, name="rough", clocks=None):
    """A simulated recording as the experiments see it."""
    true = path(seconds, seed, "rough")
    log = Log(None, {s.name: measure(true, s, seed) for s in sensors})
    names = tuple(s.name for s in sensors)
    return drives.Drive(name, log, drive(true, sensors, seed), clocks or names, truth(sensors))


def sensor(name, mount, **values):
    """One with a little noise."""
    return SimulatedSensor(name, mount, **{"sigma": SIGMA, **values})


@pytest.fixture(scope="module")
def two():
    return a_drive([sensor("velo", LIDAR), sensor("ins", INS, dt=0.03, rate=20.0)])


@pytest.fixture(scope="module")
def ring():
    cameras = {"cam0": CAMERA, "cam1": SIDEWAYS, "cam2": BACK}
    return a_drive([sensor(n, T, dt=0.01 * k, has_scale=False) for k, (n, T) in enumerate(cameras.items())])


# ---- sections


def test_drives_take_turns_and_short_ones_are_said_to_be(two, ring):
    short = a_drive([sensor("velo", LIDAR), sensor("ins", INS)], seconds=15.0, name="short")
    draws, skipped = plan([two, short], (10.0, 30.0, 90.0), (0.1, 1.0), 3)
    assert [d.drive for d in draws if d.seconds == 10.0] == [0, 1, 0] * 2
    assert [d.drive for d in draws if d.seconds == 30.0] == [0] * 6
    assert [d.seconds for d in draws].count(90.0) == 0
    assert [d.spread for d in draws][:6] == [0.1] * 3 + [1.0] * 3
    assert len(skipped) == 2
    assert skipped[0].startswith("30 s: longer than short (")
    assert skipped[1].startswith("90 s: longer than rough, short (")


def test_a_section_lies_in_the_drive_and_is_told_by_the_seed_alone(two):
    draws, _ = plan([two], (20.0,), (0.0,), 40)
    cuts = [cut(d, [two], "pair", 5) for d in draws]
    starts = np.array([c.start for c in cuts])
    first, last = two.span
    assert starts.min() >= 0
    assert starts.max() <= last - first - 20
    assert np.ptp(starts) > 0.8 * (last - first - 20)  # over the whole drive
    for c in cuts:
        for m in c.motions.values():
            assert m.start[0] >= first + c.start
            assert first + c.start + 20 >= m.end[-1] > first + c.start + 19.7
    again = cut(Draw(0, 20.0, 0.0, 7), [two], "pair", 5)
    assert again.start == cuts[7].start
    others = [cut(Draw(0, 20.0, 0.0, 7), [two], "pair", 6), cut(Draw(0, 20.0, 0.0, 7), [two], "timing", 5)]
    others.append(cut(Draw(0, 20.0, 0.0, 8), [two], "pair", 5))
    assert again.start not in [o.start for o in others]


def test_clocks_are_moved_and_the_truth_with_them(two):
    still, near, far = (cut(Draw(0, 20.0, spread, 3), [two], "timing", 0) for spread in (0.0, 0.1, 1.0))
    assert near.start == far.start
    shift = [c.motions["ins"].start[0] - still.motions["ins"].start[0] for c in (near, far)]
    applied = [two.truth.dt_base_sensor[1] - c.truth.dt_base_sensor[1] for c in (near, far)]
    assert applied[1] == pytest.approx(10 * applied[0])
    assert 0 < abs(applied[0]) <= 0.1
    assert shift == pytest.approx(applied)
    # the base stays where it is
    assert near.truth.dt_base_sensor[0] == 0
    kept = two.motions["velo"].start
    assert np.isin(near.motions["velo"].start, kept).all()


def test_a_section_of_skewed_clocks_is_as_late_as_its_readings_were():
    """Against readings stamped by the simulated clocks themselves: no formula of the drift here."""
    still = InsModel()
    late = Mounted("late", "gps_ins", INS, still, rate=20.0, dt=0.02, skew=1e-3)
    base = Mounted("base", "gps_ins", LIDAR, still, rate=10.0, dt=-0.01, skew=-5e-4)
    motions = {}
    for s in (base, late):
        stamps = s.stamps(100.0, 1) / 1e9
        n = len(stamps) - 1
        motions[s.name] = Motions(stamps[:-1], stamps[1:], np.zeros((n, 6)), np.broadcast_to(np.eye(6), (n, 6, 6)))
    known = drives.rebased(rig_truth(Rig((base, late), "street", "street"), 0.0), ("base", "late"), "a drive")
    skewed = drives.Drive("d", Log(None, {}), motions, ("base", "late"), known)
    for repeat in range(3):
        c = cut(Draw(0, 20.0, 0.0, repeat), [skewed], "pair", 0)
        stamps = c.motions["late"].start
        # what the base's clock says at the instant of each reading
        instants = late.instants(np.round(stamps * 1e9))
        on_base = (instants - base.dt) / (1 + base.skew)
        middle = skewed.span[0] + c.start + 10.0
        k = int(np.argmin(np.abs(stamps - middle)))
        assert stamps[k] + c.truth.dt_base_sensor[1] == pytest.approx(on_base[k], abs=1e-4)
        assert abs(stamps[0] + c.truth.dt_base_sensor[1] - on_base[0]) > 5e-3  # it drifts


# ---- drives and their truth


def test_the_truth_is_seen_from_the_base(two):
    sensors = [sensor(f"s{k}", T, dt=0.1 * k) for k, T in enumerate(MOUNTS)]
    seen = drives.rebased(truth(sensors), ("s2", "s4", "s0"), "a drive")
    assert (seen.base, seen.names) == ("s2", ("s2", "s4", "s0"))
    np.testing.assert_allclose(seen.T_base_sensor, in_base([MOUNTS[2], MOUNTS[4], MOUNTS[0]]), atol=1e-12)
    np.testing.assert_allclose(seen.dt_base_sensor, [0, 0.2, -0.2], atol=1e-12)
    assert seen.determined.all()


@pytest.mark.parametrize(
    ("unknown", "lost"),
    [
        (("s0", slice(0, 3)), {"s0": "t", "s1": "t", "s2": "t"}),  # where the base sits
        (("s1", slice(0, 3)), {"s1": "t"}),
        (("s1", slice(3, 6)), {"s1": "R"}),
        (("s0", slice(3, 6)), {"s0": "tR", "s1": "tR", "s2": "tR"}),
        (("s0", slice(6, 7)), {"s0": "d", "s1": "d", "s2": "d"}),
        (("s2", slice(6, 7)), {"s2": "d"}),
    ],
)
def test_what_the_truth_leaves_open_stays_open(unknown, lost):
    sensors = [sensor(f"s{k}", T) for k, T in enumerate(MOUNTS[:3])]
    there = truth(sensors)
    there.determined[there.index(unknown[0]), unknown[1]] = False
    seen = drives.rebased(there, ("s0", "s1", "s2"), "a drive").determined
    for k, name in enumerate(("s0", "s1", "s2")):
        told = lost.get(name, "")
        assert seen[k].tolist() == ["t" not in told] * 3 + ["R" not in told] * 3 + ["d" not in told]


def test_sensors_that_the_truth_does_not_hold_are_refused():
    there = truth([sensor("velo", LIDAR), sensor("ins", INS)])
    with pytest.raises(DataError, match=r"truth of a drive holds nothing on sensor 'cam9', only on velo, ins; leave"):
        drives.rebased(there, ("velo", "cam9"), "a drive")


def test_the_paper_decides_which_sensors_are_compared(two, ring):
    both = Log(None, {**ring.log.streams, **two.log.streams})
    assert drives.cameras(both) == ["cam0", "cam1", "cam2"]
    assert drives.first_two(both) == ["velo", "ins"]
    with pytest.raises(DataError, match="has no camera, where this experiment compares at least two"):
        drives.cameras(two.log)
    with pytest.raises(DataError, match="no two sensors that measure distances"):
        drives.first_two(ring.log)


# ---- errors


def test_a_rotation_error_is_the_turn_from_the_estimate_to_the_truth():
    R_est = Rotation.from_rotvec([0.3, -1.2, 0.7]).as_matrix()
    delta = np.array([0.02, -0.01, 0.03])
    found = rotation_error(se3.exp_so3(delta) @ R_est @ R_est.T)
    np.testing.assert_allclose([found[k] for k in ("rx", "ry", "rz")], np.degrees(delta))
    assert found["rotation"] == pytest.approx(np.degrees(np.linalg.norm(delta)))
    turn = Rotation.from_euler("ZYX", [3.0, -2.0, 1.0], degrees=True).as_matrix()
    euler = rotation_error(turn)
    np.testing.assert_allclose([euler[k] for k in ("roll", "pitch", "yaw")], [1.0, -2.0, 3.0])


def test_monte_carlo_sigma_of_euler_angles_is_the_linear_one_where_small():
    A = np.random.default_rng(4).normal(size=(3, 3))
    cov = A @ A.T * np.radians(0.4) ** 2
    np.testing.assert_allclose(euler_sigma(cov), np.sqrt(np.diag(cov)), rtol=0.03)
    stated = rotation_sigma(cov)
    np.testing.assert_allclose([stated[k] for k in ("rx", "ry", "rz")], np.degrees(np.sqrt(np.diag(cov))))
    assert not euler_sigma(np.zeros((3, 3))).any()


def test_monte_carlo_sigma_of_euler_angles_knows_large_turns():
    cov = np.diag(np.radians([5.0, 60.0, 5.0]) ** 2)
    many = Rotation.from_rotvec(np.random.default_rng(9).multivariate_normal(np.zeros(3), cov, size=100_000))
    np.testing.assert_allclose(euler_sigma(cov), many.as_euler("ZYX")[:, ::-1].std(axis=0), rtol=0.05)
    assert np.abs(euler_sigma(cov)[1] / np.radians(60.0) - 1) > 0.1  # pitch ends at a right angle


# ---- baselines


def test_least_squares_is_exact_without_noise():
    steps = known_times(path(30.0, 2, "rough"), [LIDAR, INS], np.array(QUIET), 1)
    np.testing.assert_allclose(baselines.least_squares(steps), in_base([LIDAR, INS])[1], atol=1e-4)


def test_least_squares_weighs_every_step_alike():
    """One wild step pulls it; the paper's estimator does not move for that (its own tests)."""
    steps = known_times(path(30.0, 2, "rough"), [LIDAR, INS], np.array(QUIET), 1)
    steps.vec[1, 40, :3] += [5.0, 0.0, 0.0]
    assert np.linalg.norm(baselines.least_squares(steps)[:3, 3] - in_base([LIDAR, INS])[1, :3, 3]) > 0.01


def test_least_squares_knows_no_position_without_scale():
    steps = known_times(path(30.0, 2, "rough"), [LIDAR, CAMERA], np.array(QUIET), 1, cameras=[1])
    T = baselines.least_squares(steps)
    np.testing.assert_allclose(T[:3, :3], exact_turns([LIDAR, CAMERA]).R_base_sensor[1], atol=1e-5)
    assert np.isnan(T[:3, 3]).all()


@pytest.mark.skipif(not baselines.opencv_has_hand_eye(), reason="this OpenCV has no calibrateHandEye")
@pytest.mark.parametrize("method", baselines.OPENCV_METHODS)
def test_opencv_is_asked_in_its_own_convention(method):
    steps = known_times(path(60.0, 2, "rough"), [LIDAR, INS], np.array(QUIET), 1)
    T = baselines.opencv_hand_eye(steps, method)
    np.testing.assert_allclose(T, in_base([LIDAR, INS])[1], atol=2e-3)
    # steps may be missing: what is left still belongs together
    keep = np.random.default_rng(1).random(len(steps)) < 0.7
    np.testing.assert_allclose(baselines.opencv_hand_eye(steps[keep], method), T, atol=2e-3)


def test_opencv_refuses_a_camera():
    steps = known_times(path(30.0, 2, "rough"), [LIDAR, CAMERA], np.array(QUIET), 1, cameras=[1])
    with pytest.raises(NotObservableError, match="two sensors that measure distances"):
        baselines.opencv_hand_eye(steps, "opencv-park")


# ---- one repeat


@pytest.fixture(params=METHODS)
def method(request):
    """The configuration of each method."""
    return replace(FAST, method=request.param)


def test_timing_finds_the_clocks_that_were_moved(ring, method):
    found = measure_timing(cut(Draw(0, 50.0, 1.0, 1), [ring], "timing", 0), [method], [])
    assert {f.estimator for f in found} == {method.method}
    assert [f.sensor for f in found] == ["cam1", "cam2"]
    for f in found:
        assert abs(f.error["dt"]) < 5
        assert 0 < f.sigma["dt"] < 5


def test_clocks_without_a_truth_have_no_error(ring):
    section = cut(Draw(0, 50.0, 1.0, 1), [ring], "timing", 0)
    section.truth.determined[2, 6] = False
    try:
        found = measure_timing(section, [FAST], [])
    finally:
        section.truth.determined[2, 6] = True
    assert [set(f.error) for f in found] == [{"dt"}, set()]


def test_a_pair_is_told_beside_least_squares(two, method):
    section = cut(Draw(0, 50.0, 0.0, 0), [two], "pair", 0)
    ours, plain = measure_pair(section, [method], ["least-squares"])
    assert (ours.estimator, plain.estimator) == (method.method, "least-squares")
    assert (ours.sensor, plain.sensor) == ("velo-ins", "velo-ins")
    assert ours.error["rotation"] < 0.5
    assert ours.error["translation"] < 0.3
    assert abs(ours.error["dt"]) < 5
    total = np.linalg.norm([ours.error[k] for k in "xyz"])
    assert ours.error["translation"] == pytest.approx(total)
    assert set(ours.sigma) == {"roll", "pitch", "yaw", "rx", "ry", "rz", "x", "y", "z", "dt"}
    assert plain.error["rotation"] < 2
    assert plain.sigma == {}
    assert "dt" not in plain.error


def test_what_is_not_determined_has_no_error():
    sensors = [sensor("velo", LIDAR), sensor("ins", INS)]
    planar = drives.Drive("planar", None, drive(path(40.0, 3, "planar"), sensors, 3), ("velo", "ins"), truth(sensors))
    (ours,) = measure_pair(cut(Draw(0, 35.0, 0.0, 0), [planar], "pair", 0), [FAST], [])
    # turning about one axis only: nothing tells the yaw of the other sensor, nor so where it sits
    assert {"yaw", "rz", "rotation", "z", "translation"} <= set(ours.undetermined)
    assert not set(ours.undetermined) & (set(ours.error) | set(ours.sigma))
    assert {"roll", "pitch", "dt"} <= set(ours.error)
    assert max(abs(ours.error["roll"]), abs(ours.error["pitch"])) < 1


def test_a_ring_of_cameras_is_told_together_and_apart(ring, method):
    methods = [f"{method.method}-together", f"{method.method}-separate", "least-squares"]
    found = measure_panoramic(cut(Draw(0, 50.0, 0.0, 0), [ring], "panoramic", 0), [method], methods[2:])
    pairs = ["cam0-cam1", "cam0-cam2", "cam1-cam2"]
    assert [(f.estimator, f.sensor) for f in found] == [(m, p) for m in methods for p in pairs]
    assert max(f.error["rotation"] for f in found) < 1.0
    assert [bool(f.sigma) for f in found] == [True] * 3 + [False] * 6
    together = np.array([[f.error[k] / f.sigma[k] for k in ("rx", "ry", "rz")] for f in found[:3]])
    assert np.sqrt(np.mean(together**2)) < 4


def test_a_refusal_is_of_the_method_that_refused():
    """The calibration takes twenty common steps; least squares takes what there is, on offsets of its own."""
    sensors = [sensor("velo", LIDAR, rate=1.0), sensor("ins", INS)]
    slow = a_drive(sensors, seconds=40.0)
    ours, plain = measure_pair(cut(Draw(0, 15.0, 0.0, 0), [slow], "pair", 0), [FAST], ["least-squares"])
    assert "share only" in ours.refused
    assert not plain.refused
    assert plain.error["rotation"] < 10
    gone = cut(Draw(0, 15.0, 0.0, 0), [slow], "pair", 0)
    gone = replace(gone, motions={**gone.motions, "ins": gone.motions["ins"][:0]})
    ours, plain = measure_pair(gone, [FAST], ["least-squares"])
    assert ours.refused.startswith("sensor ins has no motion")
    assert plain.refused == f"needs the clock offsets, which were not found: {ours.refused}"


def test_one_camera_that_is_refused_spoils_its_own_pairs_only(ring):
    section = cut(Draw(0, 50.0, 0.0, 0), [ring], "panoramic", 0)
    section = replace(section, motions={**section.motions, "cam2": section.motions["cam2"][:0]})
    found = measure_panoramic(section, [FAST], ["least-squares"])
    assert [bool(f.refused) for f in found] == [True] * 3 + [False, True, True] * 2
    assert all("sensor cam2 has no motion" in f.refused for f in found if f.refused)
    assert all(f.error["rotation"] < 1 for f in found if not f.refused)


class Other:
    """A method beside the paper's: what it is asked for is noted, and it does as told or as the paper."""

    def __init__(self):
        self.asked, self.fails = [], None

    def calibrate(self, motions, *more):
        """The paper's calibration."""
        self.asked.append(tuple(motions))
        if self.fails:
            raise self.fails
        return paper.calibrate(motions, *more)

    def clock_offsets(self, motions, *more):
        """The paper's offsets."""
        if self.fails:
            raise self.fails
        return paper.clock_offsets(motions, *more)


@pytest.fixture
def other(monkeypatch):
    """Another method, installed."""
    there = Other()
    monkeypatch.setattr(config, "METHODS", ("other", "paper"))
    monkeypatch.setattr(pipeline, "METHODS", {"other": there, "paper": paper})
    return there


def both(first):
    """Configurations of the two methods, in that order."""
    return [replace(FAST, method=m) for m in (first, *{"other", "paper"} - {first})]


@pytest.mark.parametrize(
    ("name", "failure"),
    [
        ("timing", NotObservableError("it is too dark")),
        ("pair", np.linalg.LinAlgError("it broke")),
        ("panoramic", ZeroDivisionError("it fell")),
    ],
)
def test_a_method_that_fails_takes_no_other_with_it(name, failure, two, ring, other):
    section = cut(Draw(0, 20.0, 0.0, 0), [two if name == "pair" else ring], name, 0)
    beside = [] if name == "timing" else ["least-squares"]
    measure = PROTOCOLS[name].measure
    alone = measure(section, [FAST], beside)
    other.fails = failure
    found = measure(section, both("paper"), beside)
    assert [f for f in found if not f.estimator.startswith("other")] == alone
    failed = [f for f in found if f.estimator.startswith("other")]
    plain = [f for f in alone if f.estimator in beside]
    assert len(failed) == len(alone) - len(plain)
    unexpected = "" if isinstance(failure, NotObservableError) else f"unexpected {type(failure).__name__}: "
    assert {f.refused for f in failed} == {f"{unexpected}{failure}"}
    found = measure(section, both("other"), beside)
    assert [f for f in found if f.estimator.startswith("paper")] == alone[: len(alone) - len(plain)]
    # baselines stand on the first method's clock offsets
    assert all(str(failure) in f.refused for f in found if f.estimator in beside)


def test_rows_come_in_the_order_of_the_methods_named(two, other, tmp_path):
    for methods in (("other", "paper"), ("paper", "other")):
        rows = run(two, tmp_path / methods[0], repeats=1, methods=methods).rows
        assert [r["estimator"] for r in rows] == [*methods, "least-squares"]
        # the same draw, and here the same estimate
        assert rows[0]["start"] == rows[1]["start"]
        assert rows[0]["rotation_deg"] == rows[1]["rotation_deg"]
    with pytest.raises(DataError, match=r'begun with estimators = \["paper", "other", "least-squares"\], and'):
        run(two, tmp_path / "paper", repeats=1, methods=("other", "paper"))


def test_offsets_of_clocks_that_drift_are_told_in_the_middle_of_the_section(two, other):
    section = cut(Draw(0, 30.0, 0.0, 0), [two], "pair", 0)
    middle = two.span[0] + section.start + 15.0
    assert section.truth.t_ref == pytest.approx(middle)

    def drifting(c):
        """As much off at its own reference as it drifts until the middle."""
        dt, skew = c.dt_base_sensor - [0, 0.1], np.array([0, 1e-3])
        return replace(c, dt_base_sensor=dt, clock_skew=skew, t_ref=middle - 100)

    other.calibrate = lambda *more: replace(there := paper.calibrate(*more), calibration=drifting(there.calibration))
    other.clock_offsets = lambda *more: drifting(paper.clock_offsets(*more))
    theirs, ours, beside = measure_pair(section, both("other"), ["least-squares"])
    assert theirs.error["dt"] == pytest.approx(ours.error["dt"], abs=1e-6)
    _, plain = measure_pair(section, [FAST], ["least-squares"])
    assert beside.error["rotation"] == pytest.approx(plain.error["rotation"])
    (theirs,), (ours,) = (measure_timing(section, [c], []) for c in both("other"))
    assert theirs.error["dt"] == pytest.approx(ours.error["dt"], abs=1e-6)


def test_nothing_is_calibrated_twice(ring, other):
    section = cut(Draw(0, 20.0, 0.0, 0), [ring], "panoramic", 0)
    measure_panoramic(section, both("other"), ["least-squares"])
    assert sorted(other.asked) == [("cam0", "cam1"), ("cam0", "cam1", "cam2"), ("cam0", "cam2")]


def test_roll_of_a_camera_is_about_its_optical_axis():
    np.testing.assert_allclose(FORWARD_LEFT_UP @ [0, 0, 1], [1, 0, 0])  # ahead
    np.testing.assert_allclose(FORWARD_LEFT_UP @ [1, 0, 0], [0, -1, 0])  # right
    np.testing.assert_allclose(FORWARD_LEFT_UP @ [0, 1, 0], [0, 0, -1])  # down


# ---- protocols


def test_the_papers_lengths_and_spreads_are_the_defaults():
    assert PROTOCOLS["timing"].seconds == tuple(range(10, 201, 10))
    assert PROTOCOLS["timing"].spreads == (0.1, 1.0)
    assert PROTOCOLS["pair"].seconds == tuple(range(10, 301, 10))
    assert PROTOCOLS["panoramic"].seconds == (30,)


def test_the_papers_numbers_stand_where_they_belong():
    assert beside("timing", "dt", 200.0, 1.0).startswith("KITTI 6, worst 40; Shrimp 2, worst 9; his files")
    assert beside("timing", "dt", 200.0, 0.1) == ""
    assert "1.69" in beside("panoramic", "rotation", 30.0, 0.0)


# ---- the experiment and its table


def run(two, folder, repeats=3, seed=0, seconds=(20.0,), methods=PAPER):
    choices = experiment.Choices(repeats, seconds, methods)
    return experiment.run("pair", [two], folder, choices, replace(FAST, seed=seed), Silent())


def test_every_repeat_has_its_rows(two, tmp_path):
    done = experiment.run("pair", [two], tmp_path, experiment.Choices(3, (20.0,)), FAST, Silent())
    expected = [(str(k), m) for k in range(3) for m in (*METHODS, "least-squares")]
    assert [(r["repeat"], r["estimator"]) for r in done.rows] == expected
    lines = (tmp_path / "pair.csv").read_text().splitlines()
    assert len(lines) == 1 + len(expected)
    assert tuple(lines[0].split(",")) == experiment.columns(PROTOCOLS["pair"])
    assert {r["status"] for r in done.rows} == {"found"}
    settings = json.loads((tmp_path / "pair.json").read_text())
    assert settings["repeats"] == 3
    assert settings["sensors"] == ["velo", "ins"]
    assert settings["methods"] == list(METHODS)
    assert "jobs" not in json.dumps(settings)


def test_a_cut_table_is_completed_to_the_same_bytes(two, tmp_path):
    run(two, tmp_path)
    file = tmp_path / "pair.csv"
    whole = file.read_bytes()
    lines = whole.splitlines(keepends=True)
    worked = []

    class Watching(Silent):
        def begin(self, task, total, done=0):
            worked.append(total - done)

    for left in (
        b"",
        lines[0],
        b"".join(lines[:3]),
        b"".join([lines[0], *lines[5:7], lines[3], lines[4][:30]]),  # out of order, cut inside a number
        b"".join(lines[:-1]) + lines[-1].rstrip(b"\n"),
        whole,
    ):
        file.write_bytes(left)
        experiment.run("pair", [two], tmp_path, experiment.Choices(3, (20.0,), PAPER), FAST, Watching())
        assert file.read_bytes() == whole
    assert worked == [3, 3, 2, 2, 1, 0]


def test_finished_rows_are_taken_as_they_are(two, tmp_path):
    run(two, tmp_path)
    file = tmp_path / "pair.csv"
    rows = file.read_text().splitlines()
    marked = rows[1].split(",")
    marked[9] = "123.456"
    file.write_text("\n".join([rows[0], ",".join(marked), *rows[2:]]) + "\n")
    assert "123.456" in [v for r in run(two, tmp_path).rows for v in r.values()]


def test_other_settings_are_refused(two, tmp_path):
    run(two, tmp_path)
    before = (tmp_path / "pair.csv").read_bytes()
    for changed, sentence in (
        ({"repeats": 4}, "pair.csv was begun with repeats = 3, and this is 4; give the same, or choose another"),
        ({"seed": 1}, "begun with seed = 0, and this is 1"),
        ({"seconds": (21.0,)}, r"begun with seconds = \[20.0\], and this is \[21.0\]"),
    ):
        with pytest.raises(DataError, match=sentence):
            run(two, tmp_path, **changed)
    other = a_drive([sensor("velo", LIDAR), sensor("ins", INS)], seed=4)
    with pytest.raises(DataError, match="begun with motions = "):
        run(other, tmp_path)
    turned = replace(two, truth=replace(two.truth, dt_base_sensor=two.truth.dt_base_sensor + 0.001))
    with pytest.raises(DataError, match="begun with truth = "):
        run(turned, tmp_path)
    assert (tmp_path / "pair.csv").read_bytes() == before


def test_a_table_of_unknown_settings_is_refused(two, tmp_path):
    (tmp_path / "pair.csv").write_text("drive\n")
    with pytest.raises(DataError, match=r"pair\.csv is there without its settings pair\.json"):
        run(two, tmp_path)
    (tmp_path / "pair.json").write_text("{")
    with pytest.raises(DataError, match=r"pair\.json can not be read"):
        run(two, tmp_path)


def test_a_table_with_other_columns_is_refused(tmp_path):
    Store(tmp_path, "t", {}, ["a", "b"]).rewrite([{"a": "1", "b": "2"}])
    with pytest.raises(DataError, match="has other columns"):
        Store(tmp_path, "t", {}, ["a", "c"]).read()


def test_rows_survive_commas_quotes_and_letters(tmp_path):
    store = Store(tmp_path, "t", {}, ["a", "note"])
    rows = [{"a": "1", "note": 'a "b", c; µ'}, {"a": "2", "note": ""}]
    store.rewrite(rows)
    store.append([{"a": "3", "note": "x"}])
    assert store.read() == [*rows, {"a": "3", "note": "x"}]
    with store.table.open("ab") as file:
        file.write("4,µ".encode()[:-1])  # half a letter
    assert len(store.read()) == 3


def test_a_refusal_is_a_row(tmp_path):
    sensors = [sensor("velo", LIDAR), sensor("ins", INS)]
    still = drives.Drive(
        "still", Log(tmp_path, {}), drive(path(40.0, 3, "static"), sensors, 3), ("velo", "ins"), truth(sensors)
    )
    rows = run(still, tmp_path, repeats=2).rows
    assert {r["status"] for r in rows} == {"refused"}
    assert len(rows) == 4
    assert all(len(r["note"]) > 20 and not r["rotation_deg"] for r in rows)
    text = summary.markdown("pair", experiment.Outcome(rows, [], {20.0: 1}))
    assert "4 rows from still, 4 of them refused" in text
    assert "independent, at most: 1 of 20 s." in text
    assert f"- 2 x paper: {rows[0]['note']}" in text


def test_what_nobody_foresaw_is_a_row_too(two, tmp_path, monkeypatch):
    true = measures.calibrate_motions
    times = iter(range(3))

    def failing(*arguments):
        if next(times) == 1:
            raise np.linalg.LinAlgError("SVD did not converge")
        return true(*arguments)

    monkeypatch.setattr(measures, "calibrate_motions", failing)
    rows = run(two, tmp_path).rows
    assert [r["status"] for r in rows] == ["found", "found", "refused", "found", "found", "found"]
    assert rows[2]["note"] == "unexpected LinAlgError: SVD did not converge"


def test_what_nobody_foresaw_outside_of_the_methods_costs_one_repeat(two, tmp_path, monkeypatch):
    true = measures.rotation_error
    times = iter(range(6))  # of the method and of least squares, in three repeats, were it not for the failure

    def failing(R):
        if next(times) == 2:
            raise np.linalg.LinAlgError("SVD did not converge")
        return true(R)

    monkeypatch.setattr(measures, "rotation_error", failing)
    rows = run(two, tmp_path).rows
    assert [r["status"] for r in rows] == ["found"] * 2 + ["refused"] * 2 + ["found"] * 2
    assert {r["note"] for r in rows[2:4]} == {"unexpected LinAlgError: SVD did not converge"}


def test_how_many_sections_can_be_independent_is_said(two, tmp_path):
    first, last = two.span
    done = run(two, tmp_path, repeats=4, seconds=(15.0, 20.0))
    assert 50 < last - first < 60
    assert done.apart == {15.0: 3, 20.0: 2}
    assert "independent, at most: 3 of 15 s, 2 of 20 s." in summary.markdown("pair", done)


def test_a_truth_that_does_not_tell_enough_is_refused(two, ring, tmp_path):
    def without(drive, rows, columns):
        known = drive.truth.determined.copy()
        known[rows, columns] = False
        return replace(drive, truth=replace(drive.truth, determined=known))

    choices, config = experiment.Choices(1, (20.0,)), FAST
    with pytest.raises(DataError, match="does not say how it is turned of ins against velo"):
        experiment.run("pair", [without(two, 1, slice(3, 6))], tmp_path, choices, config, Silent())
    with pytest.raises(DataError, match="does not say how late the clock is of cam1, cam2 against cam0"):
        experiment.run("timing", [without(ring, slice(None), 6)], tmp_path, choices, config, Silent())
    with pytest.raises(DataError, match="ring has cam0, cam1, cam2 where rough has velo, ins; drives of one"):
        experiment.run("pair", [two, replace(ring, name="ring")], tmp_path, choices, config, Silent())
    with pytest.raises(DataError, match=r"no recording lasts long enough: 500 s: longer than rough \(5"):
        experiment.run("pair", [two], tmp_path, experiment.Choices(1, (500.0,)), config, Silent())
    assert not list(tmp_path.iterdir())


# ---- statistics


def rows_of(values, **more):
    """Rows of the timing table with these errors and a sigma of one; None refused, nan not determined."""
    base = {"drive": "d", "seconds": "20", "spread": "1", "estimator": "paper", "sensor": "cam1", "note": ""}
    made = []
    for k, v in enumerate(values):
        row = {**base, **more, "repeat": str(k), "status": "found", "undetermined": ""}
        row |= {"dt_ms": "", "sigma_dt_ms": ""}
        if v is None:
            row |= {"status": "refused", "note": "it stood still"}
        elif np.isnan(v):
            row["undetermined"] = "dt"
        else:
            row |= {"dt_ms": str(v), "sigma_dt_ms": "1"}
        made.append(row)
    return made


def of_all(rows, parameter, estimator="paper", seconds="20"):
    """Statistics of one estimator at one length."""
    some = [r for r in rows if (r["estimator"], r["seconds"]) == (estimator, seconds)]
    return summary.statistics(some, parameter, summary.told_by_all(rows, parameter))


def test_statistics_are_those_of_the_absolute_errors():
    s = of_all(rows_of([0.5, -1.5, 2.5, -4.0, None, np.nan]), "dt")
    assert s.error.tolist() == [0.5, 1.5, 2.5, 4.0]
    assert (s.sections, s.refused, s.undetermined, s.no_truth) == (6, 1, 1, 0)
    assert [s.within(k) for k in (1, 2, 3)] == [0.25, 0.5, 0.75]
    head, line = summary.table("timing", rows_of([0.5, -1.5, 2.5, -4.0, None, np.nan]), "dt")
    told = dict(zip(head, line, strict=True))
    assert (told["median"], told["worst"], told["mean"]) == ("2.00", "4.00", "2.12")
    assert told["p95"] == f"{np.percentile([0.5, 1.5, 2.5, 4.0], 95):.2f}"
    assert told["RMS"] == f"{np.sqrt((0.25 + 2.25 + 6.25 + 16) / 4):.2f}"
    assert told["within 1/2/3 sigma %"] == "25/50/75"
    assert (told["sections"], told["refused"], told["left open"]) == ("6", "1", "1")


def test_a_length_that_was_always_refused_keeps_its_line():
    head, line = summary.table("timing", rows_of([None, None]), "dt")
    told = dict(zip(head, line, strict=True))
    assert (told["median"], told["sections"], told["refused"]) == ("", "2", "2")


def test_euler_errors_are_held_against_sigma_as_delta():
    (row,) = rows_of([1.0])
    row |= {"roll_deg": "1", "sigma_roll_deg": "9", "rx_deg": "1.5", "sigma_rx_deg": "0.5"}
    s = of_all([row], "roll")
    assert (s.error.tolist(), s.sigma.tolist(), s.checked.tolist(), s.stated.tolist()) == ([1.0], [9.0], [1.5], [0.5])
    assert [s.within(k) for k in (2, 3)] == [0, 1]


def test_a_stated_sigma_of_zero_is_held_against_the_error():
    rows = [{**r, "sigma_dt_ms": "0"} for r in rows_of([0.0, 4.0])]
    told = dict(zip(*summary.table("timing", rows, "dt"), strict=True))
    assert (told["worst"], told["sigma"], told["within 1/2/3 sigma %"]) == ("4.00", "0.00", "50/50/50")


def test_estimators_are_compared_over_what_all_of_them_tell():
    ours, theirs = [1.0, np.nan, None, 2.0], [3.0, 100.0, 100.0, None]
    rows = rows_of(ours) + rows_of(theirs, estimator="other") + rows_of([None] * 4, estimator="never")
    head, *lines = summary.table("timing", rows, "dt")
    told = {cells["estimator"]: cells for line in lines if (cells := dict(zip(head, line, strict=True)))}
    assert (told["paper"]["mean"], told["paper"]["not by all"]) == ("1.00", "1")
    assert (told["other"]["mean"], told["other"]["not by all"]) == ("3.00", "2")
    # one that tells nothing at all keeps nobody from being told
    assert (told["never"]["mean"], told["never"]["refused"]) == ("", "4")
    alone = rows_of([np.nan] * 2, seconds="10") + rows_of([5.0] * 2, seconds="10", estimator="other")
    assert of_all(rows + alone, "dt", "other", "10").error.tolist() == [5.0, 5.0]


def test_lines_come_by_spread_then_length():
    rows = rows_of([1.0], seconds="100") + rows_of([1.0], seconds="20") + rows_of([1.0], spread="0.1")
    assert [(a, b) for a, b, _, _ in summary.groups(rows)] == [(0.1, 20.0), (1.0, 20.0), (1.0, 100.0)]


# ---- pictures


@pytest.mark.parametrize("name", [n for n, p in PROTOCOLS.items() if not p.sees])
def test_figures_are_drawn(name, two, ring, tmp_path):
    from matplotlib.image import imread

    over = two if name == "pair" else ring
    done = experiment.run(name, [over], tmp_path, experiment.Choices(2, (15.0,)), FAST, Silent())
    figures.draw(name, done.rows, tmp_path / "figure.png")
    image = imread(tmp_path / "figure.png")
    assert image.shape[0] > 300
    assert 0.5 < image[..., :3].mean() < 0.99


TWO = (*METHODS, "another")[:2]


def full_table(name):
    """Rows of two methods, all baselines and every length of the paper, drawn at random."""
    there, rng = PROTOCOLS[name], np.random.default_rng(3)
    methods = [f"{m}{way}" for m in TWO for way in there.ways]
    plain = [] if name == "timing" else ["least-squares", *(baselines.OPENCV_METHODS if name == "pair" else ())]
    rows = []
    for seconds in there.seconds:
        for estimator in (*methods, *plain):
            row = dict.fromkeys(experiment.columns(there), "")
            row |= {
                "drive": "d",
                "estimator": estimator,
                "sensor": "a-b",
                "status": "found",
                "seconds": f"{seconds:g}",
            }
            numbers = [c for c in row if c.endswith(("_deg", "_m", "_ms"))]
            rows += [
                row | {"spread": f"{spread:g}", "repeat": str(k)} | {c: f"{abs(rng.normal()):.3f}" for c in numbers}
                for spread in there.spreads
                for k in range(100 if name == "panoramic" else 3)
            ]
    return rows


@pytest.mark.parametrize("name", [n for n, p in PROTOCOLS.items() if not p.sees])
def test_in_a_full_figure_every_estimator_has_its_colour_and_no_text_lies_on_another(name, monkeypatch):
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    monkeypatch.setitem(figures.STYLES, "another", ("o", figures.OURS[1]))
    figure, rows = Figure(layout="constrained", dpi=110), full_table(name)
    figures.fill(name, figure, rows)
    FigureCanvasAgg(figure).draw()
    (legend,) = figure.legends
    told = [t.get_text() for t in legend.get_texts()]
    expected = {r["estimator"].removesuffix("-together").removesuffix("-separate") for r in rows}
    assert expected <= set(told)
    assert len({figures.STYLES[m][1] for m in expected}) == len(expected)
    texts = list(legend.get_texts())
    for panel in figure.axes:
        lo, hi = panel.get_xlim()
        texts += [panel.title, panel.xaxis.label, panel.yaxis.label]
        texts += [tick.label1 for tick in panel.xaxis.get_major_ticks() if lo <= tick.get_loc() <= hi]
    texts = [t for t in texts if t.get_visible() and t.get_text()]
    boxes = [t.get_window_extent() for t in texts]
    width = figure.canvas.get_width_height()[0]
    for k, (text, box) in enumerate(zip(texts, boxes, strict=True)):
        assert box.x0 >= 0, text
        assert box.x1 <= width, text
        assert not any(box.overlaps(b) for b in boxes[k + 1 :]), text


def test_figures_stand_a_table_without_any_number(tmp_path):
    figures.draw("timing", rows_of([None, np.nan]), tmp_path / "figure.png")
    assert (tmp_path / "figure.png").stat().st_size > 1000


def sphere(directions):
    """A colour for each direction of the world."""
    yaw, up = np.arctan2(directions[..., 1], directions[..., 0]), directions[..., 2]
    channels = [128 + 100 * np.sin(3 * yaw), 128 + 100 * np.cos(2 * yaw + up), 128 + 100 * up]
    return np.clip(np.stack(channels, axis=-1), 0, 255).astype(np.uint8)


def views_of(R, K, size):
    """What ideal cameras at R (in the first one's axes) see of the sphere."""
    u, v = np.meshgrid(np.arange(size[0]), np.arange(size[1]))
    rays = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones_like(u, dtype=float)], axis=-1)
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    return [sphere((rays @ r.T) @ FORWARD_LEFT_UP.T) for r in R]


def ring_of_five():
    turns = se3.exp_so3(np.radians(np.arange(0, 360, 72))[:, None] * [0.0, 1.0, 0.0])
    K = np.array([[150.0, 0, 160], [0, 150.0, 200], [0, 0, 1]])
    return turns, K, (320, 400)


@pytest.fixture
def small_panorama(monkeypatch):
    monkeypatch.setattr(panorama, "SIZE", (480, 240))


def test_a_panorama_from_true_rotations_is_the_sphere(small_panorama):
    R, K, size = ring_of_five()
    views = [(i, CameraIntrinsics(K), r) for i, r in zip(views_of(R, K, size), R, strict=True)]
    made = panorama.panorama(views).astype(float)
    expected = sphere(panorama._rays()).astype(float)
    level = slice(83, 157)  # all around the horizon there is a camera
    assert made[level].any(axis=-1).all()
    assert np.abs(made[level] - expected[level]).mean() < 1.5
    assert not made[:33].any()
    wrong = [(i, k, r @ se3.exp_so3(np.radians([0, 5.0, 0]))) for i, k, r in views]
    assert np.abs(panorama.panorama(wrong)[level] - expected[level]).mean() > 5


def test_the_mean_rotation_is_read_back_from_the_table(ring, tmp_path):
    done = experiment.run("panoramic", [ring], tmp_path, experiment.Choices(1, (50.0,), PAPER), FAST, Silent())
    names = list(ring.motions)
    rows = [r for r in done.rows if r["estimator"] == "paper-together"]
    R = panorama.mean_rotations(rows, names, ring.truth.T_base_sensor[:, :3, :3])
    for k, name in enumerate(names[1:], start=1):
        (row,) = [r for r in rows if r["sensor"] == f"cam0-{name}"]
        off = np.degrees(np.linalg.norm(se3.log_so3(ring.truth.T_base_sensor[k, :3, :3] @ R[k].T)))
        assert off == pytest.approx(float(row["rotation_deg"]), rel=1e-4)
    from calib_toolkit import calibrate_motions

    section = cut(Draw(0, 50.0, 0.0, 0), [ring], "panoramic", 0)
    there = calibrate_motions(section.motions, FAST, section.clocks).calibration.T_base_sensor[:, :3, :3]
    np.testing.assert_allclose(R, there, atol=1e-5)
    refused = [{**r, "status": "refused", "rx_deg": ""} for r in rows]
    assert panorama.mean_rotations(refused, names, ring.truth.T_base_sensor[:, :3, :3]) is None


def test_the_panorama_is_drawn_from_images_or_says_why_not(ring, tmp_path, small_panorama):
    done = experiment.run("panoramic", [ring], tmp_path, experiment.Choices(1, (20.0,), PAPER), FAST, Silent())
    sentence = panorama.draw(ring, done.rows, tmp_path / "panorama.png")
    assert sentence.startswith("no panorama: ")
    assert sentence.endswith("holds no images, only motions of cam0")
    assert not (tmp_path / "panorama.png").exists()

    _, K, size = ring_of_five()
    R = ring.truth.T_base_sensor[:, :3, :3]
    stamps = np.array([0.0, 30.0])
    seen = views_of(R, K, size)
    streams = {
        n: Stream(n, "monocular", stamps, [np.zeros_like(i), i], CameraIntrinsics(K), has_scale=False)
        for n, i in zip(ring.motions, seen, strict=True)
    }
    with_images = drives.Drive("d", Log(tmp_path, streams), ring.motions, ring.clocks, ring.truth)
    # the first method's, whoever else is in the table
    wild = [{**r, "estimator": "other-together", "rx_deg": ""} for r in done.rows]
    assert panorama.draw(with_images, [*done.rows, *wild], tmp_path / "panorama.png") == (
        "panorama of cam0, cam1, cam2: panorama.png"
    )
    sentence = panorama.draw(with_images, [*wild, *done.rows], tmp_path / "p.png")
    assert sentence == "no panorama: no repeat of other-together determined the rotation of every camera"
    blind = {n: Stream(n, "monocular", s.stamps, s.readings, has_scale=False) for n, s in streams.items()}
    without = drives.Drive("d", Log(tmp_path, blind), ring.motions, ring.clocks, ring.truth)
    assert "does not hold the intrinsics of cam0" in panorama.draw(without, done.rows, tmp_path / "p.png")
