"""Logs written as folders: what is read again is what was there, a stopped conversion goes on, losses are named."""

import tomllib
from dataclasses import replace
from pathlib import Path

import folder_builders as build
import numpy as np
import pytest
from folder_builders import PLUGINS, opened
from scipy.spatial.transform import Rotation

from calib_toolkit import (
    CameraIntrinsics,
    DataError,
    Fix,
    LazyReadings,
    Log,
    MotionReading,
    PoseReading,
    Scan,
    Stream,
    se3,
)
from calib_toolkit.progress import Silent
from calib_toolkit_datasets import journal, kitti_writing, rig_writing, trajectory_writing
from calib_toolkit_datasets.bags.frames import reference

N = 14
LENS = CameraIntrinsics(
    np.array([[50.0, 0, 32.25], [0, 50.5, 24], [0, 0, 1]]),
    np.array([-0.2, 0.05, 1e-3, -1e-3, 0.01]),
    (64, 48),
    np.tile(np.array([0, 255], np.uint8), (48, 32)),
)


def spread(rng):
    A = rng.normal(size=(6, 6))
    return A @ A.T / 100 + 1e-4 * np.eye(6)


def whole_log():
    """Everything that a rig.toml can hold, on odd stamps and shared clocks."""
    rng = np.random.default_rng(3)
    at = 0.1 * np.arange(N) + np.round(rng.uniform(0, 0.01, N), 9)
    T = build.drive(N)
    scans = [
        Scan(
            rng.uniform(-9, 9, (40, 3)).astype("f4"),
            rng.uniform(-0.05, 0.05, 40).astype("f4"),
            rng.random(40).astype("f4"),
            rng.integers(0, 64, 40).astype("i4"),
        )
        for _ in range(N)
    ]
    grey = [rng.integers(0, 255, (48, 64)).astype(np.uint8) for _ in range(N)]
    colour = [rng.integers(0, 255, (48, 64, 3)).astype(np.uint8) for _ in range(N)]
    fixes = [Fix(0.85, 0.14 + 1e-7 * k, 100.0, 0.01, -0.02, 3.0, np.array([0.1, 0.2, 0.3])) for k in range(N)]
    fixes[3] = replace(fixes[3], sigma_position=None, sigma_rpy=np.array([1e-3, 2e-3, 3e-3]))
    vec = se3.vector(se3.relative(T[:-1], T[1:]))
    motions = [MotionReading(None), *(MotionReading(v, spread(rng)) for v in vec)]
    motions[5] = MotionReading(None)
    poses = [PoseReading(pose, spread(rng)) for pose in T]
    streams = [
        Stream("top", "velodyne", at, scans),
        Stream("plain", "velodyne", at, [replace(s, times=None, ring=None) for s in scans]),
        Stream("cam", "monocular", at, grey, LENS, False, clock="one trigger"),
        Stream("cam colour", "monocular", at[2:], colour[2:], replace(LENS, mask=None), False, clock="one trigger"),
        Stream("left", "ladybug", at, grey, LENS, False, clock="bug"),
        Stream("right", "ladybug", np.delete(at, 4), grey[:-1], LENS, False, clock="bug"),
        Stream("ins", "gps_ins", at, fixes),
        Stream("slam", "odometry", at, poses),
        Stream("plain/slam", "odometry", at, [PoseReading(p) for p in T], options={"motion_sigma": (0.1,) * 6}),
        Stream("vo", "odometry", at, motions, has_scale=False),
    ]
    frames = {s.name: se3.matrix(rng.normal(size=6)) for s in streams}
    known = reference(
        {("a", n): M for n, M in frames.items()}, {n: n for n in frames}, {s.name: s.has_scale for s in streams}
    )
    return Log(Path("here"), {s.name: s for s in streams}, build.START + 7, known)


def same(a, b):
    """Whether two readings are, as far as text and quaternions can tell."""
    assert type(a) is type(b)
    if isinstance(a, np.ndarray):
        np.testing.assert_array_equal(a, b)
        return
    for field in vars(a):
        x, y = getattr(a, field), getattr(b, field)
        assert (x is None) == (y is None), field
        if x is not None:
            np.testing.assert_allclose(x, y, rtol=1e-14, atol=1e-15, err_msg=field)


def test_a_rig_loses_nothing(tmp_path):
    log = whole_log()
    done = rig_writing.write(log, tmp_path / "r", Silent())
    assert (dict(done.readings), done.lost) == ({n: len(s) for n, s in log.streams.items()}, ())
    again = opened(tmp_path / "r")
    assert sorted(again.streams) == sorted(log.streams)
    for name, stream in log.streams.items():
        found = again.streams[name]
        assert (found.kind, found.has_scale) == (stream.kind, stream.has_scale), name
        ns = again.epoch_ns + np.round(found.stamps * 1e9).astype(int)
        assert ns.tolist() == (log.epoch_ns + np.round(stream.stamps * 1e9).astype(int)).tolist(), name
        for k in range(len(stream)):
            if name == "ins" and k == 3:
                continue
            if name == "ins":
                stream.readings[k] = replace(stream.readings[k], sigma_rpy=np.zeros(3))  # stated for one: not stated
            same(stream.readings[k], found.readings[k])
        if stream.intrinsics:
            for field in ("K", "distortion", "mask"):
                wanted = getattr(stream.intrinsics, field)
                got = getattr(found.intrinsics, field)
                assert (wanted is None) == (got is None)
                np.testing.assert_array_equal(got, wanted) if wanted is not None else None
        shared = {n for n, s in log.streams.items() if s.clock == stream.clock}
        assert {n for n, s in again.streams.items() if s.clock == found.clock} == shared
    np.testing.assert_allclose(again.reference.T_base_sensor, log.reference.T_base_sensor, atol=1e-12)
    assert again.streams["plain/slam"].options == {"motion_sigma": (0.1,) * 6}
    assert not list((tmp_path / "r").rglob(".*"))


def test_readings_alone_are_not_all_of_a_rig(tmp_path):
    log = whole_log()

    def broken(k):
        if k == 2:
            raise DataError("file 2 is broken")
        return log.streams["top"].readings[k]

    streams = {
        "top": replace(log.streams["top"], readings=LazyReadings(broken, range(N))),
        "cam": replace(log.streams["cam"], intrinsics=None),
        "radar": replace(log.streams["top"], name="radar", kind="radar"),
    }
    done = rig_writing.write(replace(log, streams=streams, reference=None), tmp_path / "r", Silent())
    assert dict(done.readings) == {"top": N - 1, "cam": 0, "radar": 0}
    assert len(opened(tmp_path / "r").streams["top"]) == N - 1
    assert [s.partition(":")[0] for s in done.lost] == ["top", "cam", "radar"]
    assert "file 2 is broken" in done.lost[0]


class Stopped(BaseException):
    """As an interrupt would."""


class Halting(Silent):
    """Stops after so many readings."""

    def __init__(self, after):
        self.left, self.begun = after, {}

    def begin(self, task, total, done=0):
        self.begun[task] = done

    def advance(self, task, units):
        self.left -= units
        if self.left < 0:
            raise Stopped


def contents(folder):
    return {p.relative_to(folder): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


@pytest.mark.parametrize("write", [rig_writing.write, kitti_writing.write])
def test_a_stopped_conversion_goes_on(tmp_path, write):
    log = whole_log()
    if write is kitti_writing.write:
        keep = {n: log.streams[n] for n in ("top", "cam", "ins")}
        log = replace(log, streams={n: replace(s, clock=n) for n, s in keep.items()})
    once = write(log, tmp_path / "once", Silent())
    for after in (3, 20):
        with pytest.raises(Stopped):
            write(log, tmp_path / "again", Halting(after))
    file = tmp_path / "again" / journal.FILE
    known = len(file.read_bytes().splitlines())
    assert known == 4 + 21
    file.write_bytes(file.read_bytes()[:-9])  # the last line was cut short
    seen = Halting(10**6)
    assert write(log, tmp_path / "again", seen) == once
    assert sum(seen.begun.values()) == known - 1
    assert contents(tmp_path / "again") == contents(tmp_path / "once")


def test_trajectories_for_tum(tmp_path):
    log = whole_log()
    vo = log.streams["vo"]
    log = replace(log, streams={**log.streams, "vo": replace(vo, has_scale=True)})
    done = trajectory_writing.write(log, tmp_path / "t", Silent())
    assert done.readings["slam"] == N
    assert done.readings["top"] == 0
    names = ["ins.txt", "plain_slam.txt", "slam.txt", "vo-2.txt", "vo.txt"]
    assert sorted(p.name for p in (tmp_path / "t").iterdir()) == names
    rows = np.loadtxt(tmp_path / "t/slam.txt")
    T = se3.rigid(np.array([se3.exp_so3(np.zeros(3))] * N), rows[:, 1:4])
    np.testing.assert_allclose(T[:, :3, 3], build.drive(N)[:, :3, 3], atol=1e-12)
    # of the motions: what stands between two rows is the motion that was read
    rows = np.loadtxt(tmp_path / "t/vo-2.txt")
    poses = se3.rigid(Rotation.from_quat(rows[:, 4:]).as_matrix(), rows[:, 1:4])
    np.testing.assert_allclose(se3.vector(se3.relative(poses[2], poses[3])), vo.readings[8].vec, atol=1e-12)
    lost = "\n".join(done.lost)
    for words in ("top: 14 readings of a velodyne", "slam: its cov", "ins: where on earth", "1 steps that failed"):
        assert words in lost


def test_a_fix_is_east_north_and_up_of_the_first(tmp_path):
    step = 1e-6
    fixes = [Fix(0.85 + step * k, 0.14, 100.0 + k, 0.0, 0.0, np.pi / 2) for k in range(3)]
    stream = Stream("ins", "gps_ins", np.arange(3.0), fixes)
    trajectory_writing.write(Log(Path("here"), {"ins": stream}), tmp_path / "t", Silent())
    rows = np.loadtxt(tmp_path / "t/ins.txt")
    radius = 6378137.0 * (1 - 0.00669437999014) / (1 - 0.00669437999014 * np.sin(0.85) ** 2) ** 1.5 + 100
    np.testing.assert_allclose(rows[1, 1:4], [0, radius * step, 1], atol=1e-4)
    np.testing.assert_allclose(rows[0, 4:], [0, 0, np.sqrt(0.5), np.sqrt(0.5)], atol=1e-12)


def test_positions_without_attitude(tmp_path):
    fixes = [Fix(0.85, 0.14 + 1e-7 * k, 100.0, *[np.nan] * 3, np.full(3, 0.1)) for k in range(N)]
    log = Log(Path("here"), {"gps": Stream("gps", "gps_ins", np.arange(1.0 * N), fixes)}, build.START)
    rig_writing.write(log, tmp_path / "r", Silent())
    found = opened(tmp_path / "r").streams["gps"].readings[4]
    assert np.isnan([found.roll, found.pitch, found.yaw]).all()
    assert (found.lon, found.sigma_position.tolist()) == (pytest.approx(fixes[4].lon, rel=1e-15), [0.1] * 3)
    with pytest.raises(DataError, match="no sensor that tells a trajectory"):
        trajectory_writing.write(log, tmp_path / "t", Silent())
    done = kitti_writing.write(log, tmp_path / "k", Silent())
    assert done.readings["gps"] == 0
    assert "tells no attitude" in "".join(done.lost)


def test_names_that_files_can_not_have(tmp_path):
    log = whole_log()
    stream = log.streams["slam"]
    streams = {n: replace(stream, name=n, clock=n) for n in ("../up", "a/b", "a_b", 'say "so"')}
    rig_writing.write(Log(Path("here"), streams), tmp_path / "in/r", Silent())
    assert sorted(tomllib.loads((tmp_path / "in/r/rig.toml").read_text())["sensors"]) == sorted(streams)
    assert [p.name for p in (tmp_path / "in").iterdir()] == ["r"]
    assert sorted(opened(tmp_path / "in/r").streams) == sorted(streams)


@pytest.fixture
def written(tmp_path):
    rig_writing.write(whole_log(), tmp_path / "r", Silent())
    return tmp_path / "r"


@pytest.mark.parametrize(
    "table", ["top/times.txt", "cam/times.txt", "left/times.txt", "ins/fixes.csv", "slam/poses.csv", "vo/poses.csv"]
)
def test_a_table_that_was_cut_anywhere_in_its_last_line_says_so(tmp_path, table):
    rig_writing.write(whole_log(), tmp_path, Silent())
    assert opened(tmp_path).notes == ()
    raw = (tmp_path / table).read_bytes()
    first = raw.rindex(b"\n", 0, -1) + 2
    for size in [*range(first, len(raw) - 4, 9), *range(len(raw) - 4, len(raw))]:
        (tmp_path / table).write_bytes(raw[:size])
        try:
            log = opened(tmp_path)
        except DataError:
            continue
        said = " ".join((*log.notes, *(n for s in log.streams.values() for n in s.notes)))
        assert str(tmp_path / table) in said, raw[:size][-40:]


def test_forty_damaged_files_of_a_rig(written):
    assert sum(build.damaged(written, PLUGINS, 40)) == 40


@pytest.mark.long
def test_a_thousand_damaged_files_of_a_rig(written):
    assert sum(build.damaged(written, PLUGINS, 1000, 3)) == 1000
