"""From a log to a calibration: what comes back, and every drive or rig that is refused, in its own sentence."""

import re
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
from builders import CAMERA, INS, LIDAR, drive, motions_of, pose, turn_error
from numpy.testing import assert_allclose

from calib_toolkit import Config, Log, Motions, calibrate, open_log, se3, write_calibration
from calib_toolkit.errors import ConfigError, DataError, NotObservableError
from calib_toolkit.pipeline import calibrate_motions
from calib_toolkit.timing import TimingOptions
from calib_toolkit_datasets.simulated import SimulatedSensor, measure, path, truth

SENSORS = [
    SimulatedSensor("velo", LIDAR),
    SimulatedSensor("ins", INS, dt=0.02, rate=20.0),
    SimulatedSensor("cam", CAMERA, dt=-0.05, has_scale=False),
]
STREET, ROUGH = path(60, 0, "street"), path(60, 0, "rough")
QUICK = Config(method="paper", jobs=1, timing=TimingOptions(steps=2000))


def log_of(true, sensors=SENSORS, seed=0):
    return Log(Path("drive"), {s.name: measure(true, s, seed) for s in sensors})


def flat(n=200, noise=0.0, turning=True):
    """Two flat odometries, x y yaw and nothing else, as of robots that live in the plane."""
    rng, base = np.random.default_rng(0), np.zeros((n, 6))
    base[:, 0] = 1.0 if turning else 0.0
    base[:, 5] = 0.05 * np.sin(np.arange(n) * 0.1) * turning
    T = pose(1.0, 0.5, 0, 0, 0, 20)
    stamps, cov = 0.1 * np.arange(n + 1), np.broadcast_to(1e-6 * np.eye(6), (n, 6, 6))
    other = se3.vector(se3.invert(T) @ se3.matrix(base) @ T)
    for vec in (base, other):
        vec[:, [0, 1, 5]] += noise * rng.normal(size=(n, 3))
    return {name: Motions(stamps[:-1], stamps[1:], vec, cov) for name, vec in (("a", base), ("b", other))}


@pytest.fixture(scope="module")
def result():
    return calibrate(log_of(ROUGH), QUICK)


def test_a_rig_is_found_within_what_is_stated(result):
    """Five sigma, since the method trims and so states too little (see the statistics)."""
    found, true = result.calibration, truth(SENSORS)
    assert (found.base, found.names) == ("velo", ("velo", "ins", "cam"))
    assert found.undetermined == ()
    error = np.column_stack(
        [
            true.T_base_sensor[:, :3, 3] - found.T_base_sensor[:, :3, 3],
            turn_error(found.T_base_sensor[:, :3, :3], true.T_base_sensor[:, :3, :3]),
            true.dt_base_sensor - found.dt_base_sensor,
        ]
    )
    assert np.all(np.abs(error[1:]) < 5 * found.sigma[1:])
    assert np.all(found.sigma[1:] < [0.15] * 3 + [np.radians(0.3)] * 3 + [0.02])
    assert_allclose(found.sigma[0], 0.0)


def test_every_stage_is_kept_and_says_only_what_it_knew(result):
    timed, turned, placed = (result.stages[s] for s in ("timing", "rotation", "translation"))
    assert_allclose(timed.determined[1:], [[False] * 6 + [True]] * 2)
    assert_allclose(turned.determined[1:], [[False] * 3 + [True] * 4] * 2)
    assert placed is result.calibration
    assert_allclose(turned.T_base_sensor[:, :3, :3], placed.T_base_sensor[:, :3, :3])


def test_statistics_count_readings_and_steps(result):
    assert set(result.statistics["readings"]) == {"velo", "ins", "cam"}
    assert 500 < result.statistics["common_steps"] <= 600
    assert result.statistics["seconds"] == pytest.approx(result.statistics["common_steps"] / 10, rel=0.01)
    assert result.configuration["timing"]["steps"] == 2000


def test_the_same_twice_is_the_same(result):
    again = calibrate(log_of(ROUGH), QUICK).calibration
    assert np.array_equal(again.T_base_sensor, result.calibration.T_base_sensor)
    assert np.array_equal(again.covariance, result.calibration.covariance)


def test_the_base_is_the_one_chosen_and_by_default_the_first_with_scale():
    log = log_of(ROUGH, [SENSORS[2], SENSORS[0], SENSORS[1]])
    assert calibrate(log, QUICK).calibration.names == ("velo", "cam", "ins")
    config = Config(base="ins", jobs=1, timing=QUICK.timing)
    assert calibrate(log, config).calibration.names == ("ins", "cam", "velo")


def test_another_base_tells_the_same_rig(result):
    other = calibrate(log_of(ROUGH), Config(base="ins", jobs=1, timing=QUICK.timing)).calibration
    for a, b in (("velo", "ins"), ("velo", "cam")):
        T, S = (c.between(a, b) for c in (result.calibration, other))
        sigma = np.sqrt(np.diag(T.cov))
        assert np.all(np.abs(T.T_a_b[:3, 3] - S.T_a_b[:3, 3]) < 2 * sigma[:3])
        assert np.all(np.abs(turn_error(S.T_a_b[:3, :3], T.T_a_b[:3, :3])) < 2 * sigma[3:])


def test_sensors_of_one_clock_share_their_offset():
    heads = [SimulatedSensor(f"head{k}", CAMERA, dt=0.3, has_scale=False) for k in range(2)]
    motions = drive(ROUGH, [SENSORS[0], *heads], 0)
    found = calibrate_motions(motions, QUICK, ("velo", "ladybug", "ladybug")).calibration
    assert found.dt_base_sensor[1] == found.dt_base_sensor[2] == pytest.approx(0.3, abs=0.02)


def test_a_sensor_on_the_bases_clock_is_never_said_to_be_of_unknown_time():
    motions = drive(path(60, 0, "turn"), [SimulatedSensor(n, T) for n, T in (("a", LIDAR), ("b", INS))], 0)
    found = calibrate_motions(motions, QUICK, ("vehicle", "vehicle")).calibration
    assert not any("b.dt" in u.direction for u in found.undetermined)
    assert (found.dt_base_sensor[1], found.sigma[1, 6]) == (0.0, 0.0)


def test_cameras_alone_give_time_and_rotation_but_no_positions():
    sensors = [SimulatedSensor(n, T, has_scale=False) for n, T in (("left", CAMERA), ("right", pose(0, -1, 1, -90)))]
    found = calibrate(log_of(ROUGH, sensors), QUICK).calibration
    assert_allclose(found.determined[1], [False] * 3 + [True] * 4)
    assert np.all(np.isnan(found.T_base_sensor[1, :3, 3]))
    assert all("no sensor knows distances" in u.sentence for u in found.undetermined)


@pytest.mark.parametrize(
    ("kind", "open_"), [("planar", {"x", "y", "z", "rz"}), ("turn", {"x", "y", "z", "rz", "dt"})]
)
def test_what_a_flat_drive_leaves_open_has_no_sigma(kind, open_):
    """The paper's rotation stage looks at turns alone, so about the one axis of a flat drive it knows nothing."""
    found = calibrate(log_of(path(100, 1, kind), SENSORS[:2]), QUICK).calibration
    names = np.array(["x", "y", "z", "rx", "ry", "rz", "dt"])
    assert set(names[~found.determined[1]]) == open_
    assert set(names[np.isnan(found.sigma[1])]) == open_


@pytest.mark.parametrize("noise", [0.0, 1e-3])
def test_two_flat_odometries_are_told_what_they_can_not_know(noise):
    found = calibrate_motions(flat(noise=noise), QUICK).calibration
    assert not found.determined[1, 5]
    assert np.all(np.isfinite(found.covariance))


@pytest.mark.parametrize("kind", ["static", "straight"])
def test_a_drive_without_turns_is_refused(kind):
    with pytest.raises(NotObservableError, match="the vehicle hardly turned"):
        calibrate(log_of(path(60, 0, kind), SENSORS[:2]), QUICK)


@pytest.mark.parametrize("start", ["correlation", "zero"])
def test_a_drive_without_any_motion_at_all_is_refused_for_the_right_reason(start):
    with pytest.raises(NotObservableError, match="the vehicle hardly turned"):
        calibrate_motions(flat(turning=False), Config(timing=TimingOptions(steps=500, start=start)))


def test_a_rig_that_turns_in_place_is_calibrated():
    """A sensor at the centre goes nowhere while another swings about it: both are in metres."""
    rng, n = np.random.default_rng(0), 400
    turns = np.column_stack([0.05 * rng.normal(size=(n, 2)), 0.2 * np.sin(0.1 * np.arange(n))])
    base = np.column_stack([0.002 * rng.normal(size=(n, 3)), turns])
    T = pose(1.0, 0.3, 0.5, 5, 5, 30)
    stamps, cov = 0.1 * np.arange(n + 1), np.broadcast_to(1e-6 * np.eye(6), (n, 6, 6))
    other = se3.vector(se3.invert(T) @ se3.matrix(base) @ T)
    motions = {k: Motions(stamps[:-1], stamps[1:], v, cov) for k, v in (("a", base), ("b", other))}
    assert_allclose(calibrate_motions(motions, QUICK).calibration.T_base_sensor[1], T, atol=2e-3)


def test_millimetres_are_refused():
    motions = drive(STREET, SENSORS[:2], 0)
    m = motions["ins"]
    units = np.array([1000.0] * 3 + [1] * 3)
    motions["ins"] = Motions(m.start, m.end, m.vec * units, m.cov * units * units[:, None])
    with pytest.raises(DataError, match=r"ins says it drove .* not in metres"):
        calibrate_motions(motions, QUICK)


def test_one_sensor_is_refused():
    with pytest.raises(DataError, match="drive: calibrating takes at least two sensors, and this is velo"):
        calibrate(log_of(STREET, SENSORS[:1]), QUICK)


def test_recordings_of_different_times_are_refused_by_name():
    motions = drive(STREET, SENSORS[:2], 0)
    motions["ins"] = motions["ins"].shifted(1000.0)
    with pytest.raises(DataError, match=r"sensor ins starts 9\d\d\.\d s after sensor velo ends"):
        calibrate_motions(motions, QUICK)


def test_too_few_steps_are_refused():
    sensors = [SimulatedSensor(n, T, rate=1.0) for n, T in (("a", LIDAR), ("b", INS))]
    with pytest.raises(NotObservableError, match=r"only \d+ steps, too few"):
        calibrate_motions(drive(path(15, 0, "rough"), sensors, 0), QUICK)


def test_a_base_that_is_not_there_is_refused_with_those_that_are():
    with pytest.raises(ConfigError, match="'radar' is not among the sensors; there are: velo, ins, cam"):
        calibrate(log_of(STREET), Config(base="radar", jobs=1))


def test_a_camera_as_base_is_refused_with_those_that_could_be():
    with pytest.raises(ConfigError, match="'cam' is a camera and knows no distances; choose one of: velo, ins"):
        calibrate(log_of(STREET), Config(base="cam", jobs=1))


def test_the_part_of_a_drive_that_is_asked_for_is_used():
    config = Config(start=10.0, duration=30.0, jobs=1, timing=QUICK.timing)
    assert calibrate(log_of(ROUGH, SENSORS[:2]), config).statistics["seconds"] == pytest.approx(30, abs=1)


def test_what_was_wrong_with_a_recording_is_repeated_as_a_warning():
    motions = {s.name: motions_of(ROUGH, s, 0) for s in SENSORS[:2]}
    found = calibrate_motions(motions, QUICK, warnings=["left out: scan 7"])
    assert found.warnings == ("left out: scan 7",)
    assert not found.complete


def test_what_the_paper_map_names_exists():
    """Every ``module.name`` in code quotes, but for configuration keys and the paper's own symbols."""
    text = (Path(__file__).parents[2] / "docs" / "paper-map.md").read_text()
    rooms = {
        "calib_toolkit": "delta likelihood observability rotation se3 sync timing translation",
        "calib_toolkit_plugins": "epipolar gps_ins monocular registration two_view velodyne",
        "calib_toolkit_datasets": "simulated",
    }
    homes = {room: package for package, names in rooms.items() for room in names.split()}
    named = [n.split(".") for n in re.findall(r"`([a-z][a-z0-9_]*(?:\.[A-Za-z_]+)+)`", text)]
    found = [n for n in named if n[0] in homes]
    assert len(found) > 30
    for room, name, *attribute in found:
        module = import_module(f"{homes[room]}.{room}")
        options = {field for o in vars(module).values() for field in getattr(o, "__dataclass_fields__", ())}
        assert hasattr(module, name) or name in options, f"{room}.{name}"
        if attribute:
            members = getattr(module, name)
            assert hasattr(members, attribute[0]) or attribute[0] in members.__dataclass_fields__


def test_a_sensor_without_any_motion_is_refused_by_name():
    (moving,) = drive(path(20, 0), [SimulatedSensor("lidar", LIDAR)], 0).values()
    with pytest.raises(DataError, match="sensor camera has no motion in this part"):
        calibrate_motions({"lidar": moving, "camera": moving[:0]})


@pytest.mark.parametrize("named", [".", "rig.toml"])
def test_a_truth_beside_a_recording_is_its_reference(tmp_path, named):
    (tmp_path / "drive").mkdir()
    sensors = "[sensors.lidar]\npose = [0.0, 0.0, 1.0, 0.0, 0.0, 0.0]\n"
    (tmp_path / "drive" / "simulated.toml").write_text(f"seconds = 2\nseed = 1\n{sensors}")
    (tmp_path / "rig.toml").write_text('[sensors.lidar]\nlog = "drive"\n')
    told = open_log(tmp_path / "drive").reference
    assert told is not None
    write_calibration(told, tmp_path / "truth.json")
    reference = open_log(tmp_path / named).reference
    assert reference is not None
    assert reference.names == ("lidar",)
