"""Simulated drives on disk: read by the real readers, resumed, refused, and the same whatever made them."""

import hashlib
import json
import shutil
from dataclasses import replace

import cv2
import numpy as np
import pytest
from click.testing import CliRunner

from calib_toolkit import DataError, Scan, open_log, read_calibration, se3
from calib_toolkit.cli import main
from calib_toolkit.progress import Silent
from calib_toolkit_datasets.simulation import command, rigs, scene, vehicle, writing
from calib_toolkit_datasets.simulation.camera import CameraModel
from calib_toolkit_datasets.simulation.ins import InsModel
from calib_toolkit_datasets.simulation.lidar import LidarModel
from calib_toolkit_datasets.simulation.writing import Wish, write

SECONDS = 2.0


def wish(rig="kitti", **other):
    usual = rigs.RIGS[rig](3)
    return replace(
        Wish(rig, SECONDS, 3, usual.drive, usual.scene, "extract" if rig == "kitti" else "folders"), **other
    )


def quick_reading(wish, sensor, instant, k, layout):
    """Instead of casting rays: a scan of few points that tell the instant, or a black image."""
    if isinstance(sensor.model, LidarModel):
        angle = np.linspace(-3.1, 3.1, 50, dtype=np.float32)
        points = np.column_stack([10 * np.cos(angle), 10 * np.sin(angle), np.full(50, instant, np.float32)])
        return layout.scan(Scan(points, intensity=np.full(50, 0.25, np.float32)))
    width, height = sensor.model.intrinsics.size
    image = np.zeros((height, width, 3) if sensor.model.colour else (height, width), np.uint8)
    return cv2.imencode(".png", image)[1].tobytes()


class Counted(Silent):
    """Keeps what was begun and what was done."""

    def __init__(self):
        self.begun, self.made = {}, {}

    def begin(self, task, total, done=0):
        self.begun[task], self.made[task] = (total, done), 0

    def advance(self, task, units):
        self.made[task] += units


@pytest.fixture
def quick(monkeypatch):
    monkeypatch.setattr(writing, "_reading", quick_reading)
    monkeypatch.setattr(writing, "_scene", lambda wish: None)


def hashes(folder):
    files = sorted(f for f in folder.rglob("*") if f.is_file())
    return {str(f.relative_to(folder)): hashlib.sha256(f.read_bytes()).hexdigest() for f in files}


def true_poses(w, sensor, stamps):
    return vehicle.path(w.seconds, w.seed, w.drive).at(stamps) @ sensor.T_vehicle_sensor


@pytest.mark.parametrize("rig", rigs.RIGS)
def test_the_readers_find_every_sensor_with_its_kind_its_stamps_and_its_lens(quick, tmp_path, rig):
    write(tmp_path, wish(rig), Silent(), 1)
    log, made = open_log(tmp_path), rigs.RIGS[rig](3)
    assert set(log.streams) == {s.name for s in made.sensors}
    for s in made.sensors:
        stream, ns = log.streams[s.name], s.stamps(SECONDS, 3)
        assert stream.kind == s.kind
        assert stream.notes == ()
        unix_ns = np.round(stream.stamps * 1e9).astype(np.int64) + log.epoch_ns
        assert np.abs(unix_ns - rigs.START_NS - ns).max() <= 1
        assert stream.has_scale != isinstance(s.model, CameraModel)
        if isinstance(s.model, CameraModel):
            lens = s.model.intrinsics
            assert pytest.approx(lens.K, abs=1e-6) == stream.intrinsics.K
            assert stream.intrinsics.distortion == pytest.approx(lens.distortion, abs=1e-9)
            assert stream.intrinsics.size == lens.size
            assert stream.readings[1].shape == ((*lens.size[::-1], 3) if s.model.colour else lens.size[::-1])
        elif isinstance(s.model, LidarModel):
            scan, instants = stream.readings[2], s.instants(ns)
            assert scan.points[:, 2] == pytest.approx(instants[2], abs=1e-6)
            turns = -np.arctan2(scan.points[:, 1], scan.points[:, 0]) / (2 * np.pi * s.model.rate)
            assert scan.times == pytest.approx(turns, abs=1e-6)
            assert scan.intensity == pytest.approx(0.25)


@pytest.mark.parametrize("rig", rigs.RIGS)
def test_the_reference_of_the_log_is_the_truth(quick, tmp_path, rig):
    write(tmp_path, wish(rig), Silent(), 1)
    log, made = open_log(tmp_path), rigs.RIGS[rig](3)
    truth = read_calibration(tmp_path / "truth.json")
    assert np.array_equal(truth.T_base_sensor, log.reference.T_base_sensor)
    assert truth.base == made.sensors[0].name
    assert np.all(truth.determined)
    for i, s in enumerate(made.sensors):
        assert truth.T_base_sensor[i] == pytest.approx(
            se3.relative(made.sensors[0].T_vehicle_sensor, s.T_vehicle_sensor), abs=1e-12
        )
        at = s.instants(s.stamps(SECONDS, 3))
        stamps = log.streams[s.name].stamps
        in_base = stamps + truth.dt_base_sensor[i] + truth.clock_skew[i] * (stamps - truth.t_ref)
        base_clock = (at - made.sensors[0].dt) / (1 + made.sensors[0].skew) + truth.t_ref
        assert in_base == pytest.approx(base_clock, abs=3e-9)


@pytest.mark.parametrize("rig", ["kitti", "shrimp"])
def test_fixes_come_back_through_files_as_they_were_made(quick, monkeypatch, tmp_path, rig):
    from calib_toolkit_plugins import gps_ins

    silent = InsModel(white=(0.0,) * 6, bias=(0.0,) * 6, correlation=1e12)  # a constant error is none in motion

    def noiseless(seed):
        made = rigs_before[rig](seed)
        return replace(made, sensors=tuple(replace(s, model=silent) if s.name == "ins" else s for s in made.sensors))

    rigs_before = dict(rigs.RIGS)
    monkeypatch.setitem(rigs.RIGS, rig, noiseless)
    writing._rig.cache_clear()
    write(tmp_path, wish(rig), Silent(), 1)
    writing._rig.cache_clear()
    stream, sensor = open_log(tmp_path).streams["ins"], noiseless(3).sensor("ins")
    T = gps_ins.estimate(stream, gps_ins.GpsInsOptions()).T_world_sensor
    true = true_poses(wish(rig), sensor, sensor.instants(sensor.stamps(SECONDS, 3)))
    found, wanted = (se3.relative(p[:1], p) for p in (T, true))
    # a constant error of the heading turns the whole drive
    assert np.linalg.norm(found[:, :3, 3], axis=1) == pytest.approx(
        np.linalg.norm(wanted[:, :3, 3], axis=1), abs=1e-5
    )
    assert se3.vector(found)[:, 3:] == pytest.approx(se3.vector(wanted)[:, 3:], abs=1e-4)
    assert stream.readings[0].sigma_position == pytest.approx(
        0.0370 if rig == "kitti" else silent.sigma[:3], abs=6e-3
    )


def test_oxts_states_the_true_velocities_accelerations_and_turn_rates(quick, tmp_path):
    circle = wish(drive="turn")
    write(tmp_path, circle, Silent(), 1)
    (folder,) = tmp_path.glob("*_extract/oxts/data")
    rows = np.array([[float(x) for x in f.read_text().split()] for f in sorted(folder.iterdir())])
    assert rows.shape == (200, 30)
    sensor = rigs.kitti(3).sensor("ins")
    poses = true_poses(circle, sensor, sensor.instants(sensor.stamps(SECONDS, 3)))
    middle = sensor.T_vehicle_sensor[:2, 3] - [0.0, 6.0 / 0.3]  # of the circle, whose centre is 20 m to the left
    around = 0.3 * np.linalg.norm(middle)
    assert np.hypot(rows[:, 6], rows[:, 7]) == pytest.approx(around, abs=1e-4)
    assert np.hypot(rows[:, 8], rows[:, 9]) == pytest.approx(around, abs=1e-4)
    there = np.diff(poses[:, :2, 3], axis=0) / 0.01
    assert (rows[:-1, [7, 6]] + rows[1:, [7, 6]]) / 2 == pytest.approx(there, abs=1e-3)  # east, north
    assert rows[:, 8] / around == pytest.approx(1.0, abs=0.01)  # forward
    assert np.linalg.norm(rows[:, 11:14], axis=1) == pytest.approx(np.hypot(9.81, 0.3 * around), abs=1e-2)
    assert rows[:, 15] == pytest.approx(0.3 * around, abs=0.1)  # to the left, towards the centre
    assert rows[:, 20:23] == pytest.approx(np.tile([0.0, 0.0, 0.3], (200, 1)), abs=0.01)
    assert np.linalg.norm(rows[:, 17:20], axis=1) == pytest.approx(0.3, abs=1e-4)


def test_the_sync_layout_is_rectified_and_on_one_clock(quick, tmp_path):
    write(tmp_path, wish(layout="sync"), Silent(), 1)
    log = open_log(tmp_path)
    assert len({tuple(s.stamps) for s in log.streams.values()}) == 1
    assert log.streams["cam2"].intrinsics.distortion.size == 0
    assert np.array_equal(log.streams["cam2"].intrinsics.K, rigs.RECTIFIED.K)
    assert not np.any(log.reference.dt_base_sensor)
    assert np.all(log.reference.determined)
    calib = (tmp_path / "calib_cam_to_cam.txt").read_text()
    P = {line[:9]: line.split()[1:] for line in calib.splitlines()}["P_rect_03"]
    T_cam0_cam3 = log.reference.between("cam0", "cam3").T_a_b
    assert float(P[3]) == pytest.approx(-rigs.RECTIFIED.K[0, 0] * T_cam0_cam3[0, 3], abs=1e-6)


def test_the_trajectory_is_the_vehicles_true_path(quick, tmp_path):
    write(tmp_path, wish("shrimp"), Silent(), 1)
    rows = np.loadtxt(tmp_path / "trajectory.txt")
    assert len(rows) == SECONDS * 100
    at = rows[:, 0] - rigs.START_NS / 1e9
    w = wish("shrimp")
    poses = vehicle.path(w.seconds, w.seed, w.drive).at(np.round(at, 2))
    assert rows[:, 1:4] == pytest.approx(poses[:, :3, 3], abs=1e-9)


def test_what_is_there_is_kept_and_what_is_missing_is_made_again(quick, monkeypatch, tmp_path):
    write(tmp_path, wish(), Silent(), 1)
    before = hashes(tmp_path)
    (drive,) = tmp_path.glob("*_extract")
    gone = [drive / "velodyne_points/data/0000000004.bin", drive / "image_02/data/0000000001.png"]
    gone += [drive / "oxts/data/0000000150.txt", tmp_path / "truth.json", tmp_path / "rig.toml"]
    for file in gone:
        file.unlink()
    gone[0].with_name("0000000004.bin.part").write_bytes(b"cut short")
    kept = drive / "image_02/data/0000000002.png"
    kept.write_bytes(b"left alone")
    progress = Counted()
    write(tmp_path, wish(), progress, 1)
    assert progress.made == {"velo": 1, "cam0": 0, "cam1": 0, "cam2": 1, "cam3": 0, "ins": 1}
    assert progress.begun["velo"] == (19, 18)
    assert kept.read_bytes() == b"left alone"
    after = hashes(tmp_path)
    assert {f for f in before | after if before.get(f) != after.get(f)} == {str(kept.relative_to(tmp_path))}


def test_a_drive_that_was_cut_off_is_no_recording_yet(quick, monkeypatch, tmp_path):
    def killed(wish, sensor, instant, k, layout):
        if k == 7:
            raise KeyboardInterrupt
        return quick_reading(wish, sensor, instant, k, layout)

    monkeypatch.setattr(writing, "_reading", killed)
    with pytest.raises(KeyboardInterrupt):
        write(tmp_path, wish(), Silent(), 1)
    assert not (tmp_path / "rig.toml").exists()
    assert not (tmp_path / "truth.json").exists()
    monkeypatch.setattr(writing, "_reading", quick_reading)
    whole = tmp_path.with_name("whole")
    write(tmp_path, wish(), Silent(), 1)
    write(whole, wish(), Silent(), 1)
    assert hashes(tmp_path) == hashes(whole)


def test_another_drive_in_the_same_folder_is_refused_by_what_differs(quick, tmp_path):
    write(tmp_path, wish("shrimp"), Silent(), 1)
    before = hashes(tmp_path)
    with pytest.raises(DataError, match=r"begun with seed 3, and seed 4 is asked for"):
        write(tmp_path, wish("shrimp", seed=4), Silent(), 1)
    (tmp_path / "drive.json").write_text(
        json.dumps(json.loads((tmp_path / "drive.json").read_text()) | {"version": "0.0.1"})
    )
    with pytest.raises(DataError, match=r"version 0\.0\.1"):
        write(tmp_path, wish("shrimp"), Silent(), 1)
    del before["drive.json"]
    assert before.items() <= hashes(tmp_path).items()


def test_a_folder_with_something_else_in_it_is_refused(tmp_path):
    (tmp_path / "letters.txt").write_text("mine")
    with pytest.raises(DataError, match="holds files of something else"):
        write(tmp_path, wish(), Silent(), 1)
    assert [f.name for f in tmp_path.iterdir()] == ["letters.txt"]


@pytest.mark.parametrize("content", ["[1]", "not json", "3"])
def test_a_folder_whose_description_is_damaged_is_refused(tmp_path, content):
    (tmp_path / "drive.json").write_text(content)
    with pytest.raises(DataError, match=str(tmp_path)):
        write(tmp_path, wish(), Silent(), 1)


def test_a_full_disk_is_foreseen(monkeypatch, tmp_path):
    usage = shutil.disk_usage(tmp_path)._replace(free=50_000_000)
    monkeypatch.setattr(writing, "disk_usage", lambda folder: usage)
    with pytest.raises(DataError, match=r"takes about 0\.1 GB and .* has 0\.1 GB free"):
        write(tmp_path, wish(), Silent(), 1)


@pytest.mark.parametrize(
    ("other", "sentence"),
    [
        ({"rig": "truck"}, "there is no rig called 'truck'"),
        ({"drive": "moon"}, "there is no drive called 'moon'"),
        ({"scene": "moon"}, "there is no scene called 'moon'"),
        ({"layout": "folders"}, "there is no layout of a kitti called 'folders'"),
        ({"seconds": 0.1}, "from 1 to 1800 seconds"),
        ({"seconds": float("nan")}, "from 1 to 1800 seconds"),
        ({"seed": -1}, "a seed is 0 or more"),
    ],
)
def test_a_wish_that_can_not_be_met_is_refused(other, sentence):
    with pytest.raises(DataError, match=sentence):
        replace(wish(), **other)


def test_the_command_knows_what_there_is():
    assert set(command.RIGS) == set(rigs.RIGS)
    assert set(command.SCENES) == set(scene.LAYOUTS)
    assert set(command.DRIVES) == set(vehicle.DRIVES)
    assert set(command.LAYOUTS) == set(writing.LAYOUTS)


def test_the_command_says_what_it_wrote_and_what_comes_next(quick, tmp_path):
    options = [
        "--rig",
        "shrimp",
        "--seconds",
        "1",
        "--seed",
        "3",
        "--drive",
        "street",
        "--scene",
        "open",
        "--jobs",
        "1",
    ]
    done = CliRunner().invoke(command.simulate, [str(tmp_path / "dst"), *options])
    assert done.exit_code == 0, done.output
    assert "1 s of street with the shrimp rig, scene open, seed 3" in done.output
    assert "ladybug5" in done.output
    assert f"calib-toolkit run {tmp_path / 'dst'}" in done.output
    again = CliRunner().invoke(command.simulate, [str(tmp_path / "dst"), *options])
    assert "all there already" in again.output


def test_the_command_refuses_in_one_sentence(tmp_path):
    done = CliRunner().invoke(main, ["simulate", str(tmp_path), "--rig", "shrimp", "--layout", "sync"])
    assert done.exit_code == 1
    assert done.output.count("\n") == 1
    assert "layout of a shrimp" in done.output


def test_readings_are_the_same_in_whatever_order_they_are_made(tmp_path):
    w, layout = wish("shrimp", seconds=1.0), writing._layout(wish("shrimp"))
    sensor = writing.build_rig(w).sensor("velo")
    at = sensor.instants(sensor.stamps(w.seconds, w.seed))
    made = {}
    for k in (3, 0, 3):
        made.setdefault(k, set()).add(writing._reading(w, sensor, float(at[k]), k, layout))
        if k == 0:
            writing._scene.cache_clear()
    assert [len(x) for x in made.values()] == [1, 1]
    assert made[0] != made[3]
    assert len(next(iter(made[0]))) > 16 * 50_000


@pytest.mark.long
def test_the_same_seed_gives_the_same_bytes_with_one_process_and_with_two(tmp_path):
    for jobs in (1, 2):
        write(tmp_path / str(jobs), wish("shrimp", seconds=1.0), Silent(), jobs)
    one, two = (hashes(tmp_path / str(jobs)) for jobs in (1, 2))
    assert one == two
    assert len(one) > 40
