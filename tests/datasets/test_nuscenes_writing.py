"""Logs as nuScenes: what is written is read again to the last bit, and what has no place is named."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calib_toolkit import DataError, Fix, LazyReadings, Log, Scan, Stream, open_log, se3
from calib_toolkit.progress import Silent
from calib_toolkit.types import Calibration, CameraIntrinsics, MotionReading, PoseReading
from calib_toolkit_datasets.nuscenes import ego
from calib_toolkit_datasets.nuscenes.writing import VERSION, write

START_NS = 1_700_000_000 * 10**9 + 123_456
N = 14
TABLES = (
    *("attribute", "calibrated_sensor", "category", "ego_pose", "instance", "log", "map", "sample"),
    *("sample_annotation", "sample_data", "scene", "sensor", "visibility"),
)
"""All that nuScenes' own toolkit opens."""
T_INS_VELO = se3.matrix([1.0, 0.2, 0.5, 0.01, 0.02, 1.5])


def drive(vehicle="ins"):
    """A scanner, a camera and a GPS/INS, or an odometry of poses; the camera's pose is not known."""
    rng = np.random.default_rng(5)
    scans = [
        Scan(
            rng.uniform(-9, 9, (64, 3)).astype("f4"),
            rng.uniform(-0.05, 0.05, 64).astype("f4"),
            rng.random(64).astype("f4"),
            np.tile(np.arange(32), 2).astype(np.int32),
        )
        for _ in range(N)
    ]
    images = [rng.integers(0, 255, (12, 16, 3)).astype(np.uint8) for _ in range(N)]
    fixes = [
        Fix(0.85, 0.14 + 1e-7 * k, 100.0, 0.01, -0.02, 0.05 * k, np.array([0.02, 0.02, 0.05]), np.full(3, 1e-3))
        for k in range(2 * N)
    ]
    T = se3.matrix(np.column_stack([np.arange(2 * N) * 0.7, np.zeros((2 * N, 4)), np.arange(2 * N) * 0.05]))
    poses = [PoseReading(pose, np.diag([1, 1, 4, 1e-2, 1e-2, 1e-2]) * 1e-4) for pose in T]
    at = np.arange(N) * 0.1
    lens = CameraIntrinsics(np.array([[60.0, 0, 8], [0, 60, 6], [0, 0, 1]]), np.array([-0.2, 0.05, 0, 0]), (16, 12))
    kinds = {"ins": ("gps_ins", fixes), "odo": ("odometry", poses)}
    streams = {
        "velo": Stream("velo", "velodyne", at, scans),
        "cam0": Stream("cam0", "monocular", at + 0.013, images, lens, has_scale=False),
        vehicle: Stream(vehicle, kinds[vehicle][0], np.arange(2 * N) * 0.05 + 0.002, kinds[vehicle][1]),
    }
    names = ("velo", vehicle)
    reference = Calibration(
        base="velo",
        names=names,
        T_base_sensor=np.stack([np.eye(4), se3.invert(T_INS_VELO)]),
        dt_base_sensor=np.zeros(2),
        covariance=np.zeros((14, 14)),
        has_scale=np.ones(2, dtype=bool),
        determined=np.ones((2, 7), dtype=bool),
    )
    return Log(Path("here"), streams, START_NS // 1000 * 1000, reference)


def rows(path, name):
    return json.loads((path / VERSION / f"{name}.json").read_text())


@pytest.mark.parametrize("vehicle", ["ins", "odo"])
def test_what_is_written_is_read_again(tmp_path, plugins, vehicle):
    log = drive(vehicle)
    done = write(log, tmp_path / "a", Silent())
    assert dict(done.readings) == {"velo": N, "cam0": N, vehicle: 2 * N}
    again = open_log(tmp_path / "a", plugins=plugins)
    assert again.notes == ()
    assert {n: s.kind for n, s in again.streams.items()} == {n: s.kind for n, s in log.streams.items()}
    for name, stream in again.streams.items():
        ns = again.epoch_ns + np.round(stream.stamps * 1e9).astype(int)
        wanted = log.epoch_ns + np.round(log.streams[name].stamps * 1e9).astype(int)
        assert ns.tolist() == wanted.tolist()
        assert stream.notes == ()
    for k in (0, 5, N - 1):
        scan, wanted = again.streams["velo"].readings[k], log.streams["velo"].readings[k]
        for field in ("points", "times", "intensity", "ring"):
            np.testing.assert_array_equal(getattr(scan, field), getattr(wanted, field))
        np.testing.assert_array_equal(again.streams["cam0"].readings[k], log.streams["cam0"].readings[k])
        a, b = again.streams[vehicle].readings[k], log.streams[vehicle].readings[k]
        if vehicle == "ins":
            assert [getattr(a, f) for f in ego.FIX] == [getattr(b, f) for f in ego.FIX]
            np.testing.assert_array_equal(a.sigma_position, b.sigma_position)
            np.testing.assert_array_equal(a.sigma_rpy, b.sigma_rpy)
        else:
            np.testing.assert_allclose(a.T_world_sensor, b.T_world_sensor, atol=1e-15)
            np.testing.assert_array_equal(a.cov, b.cov)
    lens = again.streams["cam0"].intrinsics
    np.testing.assert_array_equal(lens.K, log.streams["cam0"].intrinsics.K)
    assert (lens.distortion.tolist(), lens.size) == ([-0.2, 0.05, 0, 0, 0], (16, 12))
    assert (again.reference.base, again.reference.names) == (vehicle, (vehicle, "velo"))
    np.testing.assert_allclose(again.reference.between(vehicle, "velo").T_a_b, T_INS_VELO, atol=1e-15)


def test_what_has_no_place_is_named(tmp_path):
    log = drive()
    motions = [MotionReading(None), *(MotionReading(np.ones(6)) for _ in range(3))]
    masked = replace(log.streams["cam0"].intrinsics, mask=np.ones((12, 16), np.uint8))
    head = replace(log.streams["cam0"], kind="ladybug", clock="bug", intrinsics=masked, stamps=np.arange(N) + 1e-7)
    streams = {**log.streams, "cam0": head, "odo": Stream("odo", "odometry", np.arange(4.0), motions)}
    done = write(replace(log, streams=streams), tmp_path / "a", Silent())
    assert set(done.lost) == {
        "odo: nuScenes has no odometry beside ins",
        "what stamps have below a microsecond",
        "cam0: its pose in ins is not known; null stands in calibrated_sensor.json",
        "cam0: the mask of its images, for which nuScenes has no place",
        "cam0: that it shares the clock of bug, for which nuScenes has no place",
        "the reference's clock offsets and covariance: nuScenes has no place for them",
    }
    assert done.readings["odo"] == 0


def test_readings_that_can_not_be_read_are_counted_and_the_chain_goes_on(tmp_path, plugins):
    log = drive()

    def broken(k):
        if k in (0, 4):
            raise DataError(f"file {k} is broken")
        return log.streams["velo"].readings[k]

    velo = replace(log.streams["velo"], readings=LazyReadings(broken, range(N)))
    fixes = log.streams["ins"].readings
    ins = replace(
        log.streams["ins"],
        readings=LazyReadings(lambda k: fixes[k] if k != 3 else broken(4), range(2 * N)),
    )
    done = write(replace(log, streams={**log.streams, "velo": velo, "ins": ins}), tmp_path / "a", Silent())
    assert (done.readings["velo"], done.readings["ins"]) == (N - 2, 2 * N - 1)
    assert "velo: 2 unreadable, the first because file 0 is broken" in done.lost
    assert "ins: 1 unreadable, the first because file 4 is broken" in done.lost
    again = open_log(tmp_path / "a", plugins=plugins)
    assert len(again.streams["velo"]) == N - 2
    assert again.streams["ins"].readings[3].yaw == fixes[4].yaw
    chained(rows(tmp_path / "a", "sample_data"))


def chained(found):
    """Each row is linked to the one that links to it."""
    by_token = {r["token"]: r for r in found}
    assert len(by_token) == len(found)
    for row in found:
        if row["next"]:
            assert by_token[row["next"]]["prev"] == row["token"]
            assert by_token[row["next"]]["timestamp"] > row["timestamp"]
    heads = [r for r in found if not r["prev"]]
    assert len(heads) == len({r["calibrated_sensor_token"] for r in found})


def test_tables_are_what_nuscenes_own_toolkit_asks_of_them(tmp_path):
    """Every table there, every token known, keyframes near their sample, a pose at the stamp of every reading."""
    write(drive(), tmp_path / "a", Silent())
    path = tmp_path / "a"
    assert sorted(f.stem for f in (path / VERSION).iterdir()) == sorted(TABLES)
    made = {name: rows(path, name) for name in TABLES}
    token = {name: {r["token"]: r for r in made[name]} for name in TABLES}
    chained(made["sample_data"])
    for row in made["sample_data"]:
        assert token["ego_pose"][row["ego_pose_token"]]["timestamp"] == row["timestamp"]
        sample = token["sample"][row["sample_token"]]
        assert abs(sample["timestamp"] - row["timestamp"]) <= 500_000
        assert row["sample_token"] in token["sample"]
        assert row["calibrated_sensor_token"] in token["calibrated_sensor"]
        assert not row["filename"] or (path / row["filename"]).is_file()
        assert row["is_key_frame"] == row["filename"].startswith("samples/") or not row["filename"]
    (scene,) = made["scene"]
    assert made["sample"][0]["token"] == scene["first_sample_token"]
    assert made["sample"][-1]["token"] == scene["last_sample_token"]
    assert scene["nbr_samples"] == len(made["sample"]) == 3
    assert scene["log_token"] in token["log"]
    assert made["map"][0]["log_tokens"] == [scene["log_token"]]
    assert (path / made["map"][0]["filename"]).is_file()
    for sample in made["sample"]:
        keys = [r for r in made["sample_data"] if r["is_key_frame"] and r["sample_token"] == sample["token"]]
        assert len({r["calibrated_sensor_token"] for r in keys}) == len(keys) == 3


def test_poses_of_other_readings_lie_between_those_measured(tmp_path):
    log = drive("odo")
    write(log, tmp_path / "a", Silent())
    poses = {r["token"]: r for r in rows(tmp_path / "a", "ego_pose")}
    for row in rows(tmp_path / "a", "sample_data"):
        if "/velo/" in row["filename"]:
            seconds = row["timestamp"] / 1e6 - log.epoch_ns / 1e9
            steps = max((seconds - 0.002) / 0.05, 0.0)
            pose = poses[row["ego_pose_token"]]
            assert pose["translation"][0] == pytest.approx(0.7 * steps, abs=1e-4)
            assert 2 * np.arctan2(pose["rotation"][3], pose["rotation"][0]) == pytest.approx(0.05 * steps, abs=1e-5)


def test_fixes_become_metres_east_north_and_up_of_the_first():
    fixes = [Fix(0.85, 0.14, 100.0, 0, 0, 0.3), Fix(0.85 + 1e-6, 0.14, 101.0, 0, 0, 0.3)]
    T = ego.poses(fixes)
    np.testing.assert_allclose(T[0], se3.matrix([0, 0, 0, 0, 0, 0.3]), atol=1e-9)
    meridian = 6378137 * (1 - 0.00669438) / (1 - 0.00669438 * np.sin(0.85) ** 2) ** 1.5
    np.testing.assert_allclose(T[1, :3, 3], [0, 1e-6 * (meridian + 101), 1], atol=1e-5)


def test_the_same_log_gives_the_same_bytes(tmp_path):
    for name in "ab":
        write(drive(), tmp_path / name, Silent())
    files = sorted(f.relative_to(tmp_path / "a") for f in (tmp_path / "a").rglob("*") if f.is_file())
    assert len(files) > 3 * N
    assert all((tmp_path / "a" / f).read_bytes() == (tmp_path / "b" / f).read_bytes() for f in files)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda s: {"velo": s["velo"], "cam0": s["cam0"]}, "no GPS/INS and no odometry of poses"),
        (lambda s: {**s, "a/b": s["velo"].named("a/b")}, "sensor 'a/b' can not be a channel"),
        (lambda s: {**s, "velo": replace(s["velo"], stamps=np.arange(N) * 1e-7)}, "two readings in a microsecond"),
        (lambda s: {**s, "velo": replace(s["velo"], stamps=np.arange(N) - 2e9)}, "is not after 1970"),
    ],
)
def test_what_nuscenes_can_not_hold_is_refused(tmp_path, change, said):
    log = drive()
    with pytest.raises(DataError, match=said):
        write(replace(log, streams=change(log.streams)), tmp_path / "a", Silent())


def test_a_sweep_without_times_ring_and_intensity_stays_so_but_for_the_intensity(tmp_path, plugins):
    log = drive()
    bare = [Scan(s.points) for s in log.streams["velo"].readings]
    write(
        replace(log, streams={**log.streams, "velo": replace(log.streams["velo"], readings=bare)}),
        tmp_path / "a",
        Silent(),
    )
    scan = open_log(tmp_path / "a", plugins=plugins).streams["velo"].readings[1]
    np.testing.assert_array_equal(scan.points, bare[1].points)
    assert (scan.times, scan.ring) == (None, None)
    assert not scan.intensity.any()
