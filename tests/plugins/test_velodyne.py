"""The velodyne sensor on ray-cast streets with known motion, and on real sweeps."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from calib_toolkit import DataError, Motions, Scan, SensorTable, Stream, se3
from calib_toolkit_plugins import registration
from calib_toolkit_plugins.velodyne import VelodyneOptions, deskew, estimate, open_table

Array = NDArray[np.float64]

PERIOD = 0.1
FORWARD = np.array([1.2, 0.01, 0.005, 0.002, -0.003, 0.02])
GROUND = -1.8
BEAMS, COLUMNS = 40, 720
TUNNEL = np.array([[0.0, side, 2.0, 150.0, 1.0, 6.0, 0.0] for side in (-9.0, 9.0)])


def street(seed: int) -> Array:
    """(n, 7) boxes: centre, half sizes, yaw. Houses on both sides, cars, poles."""
    rng = np.random.default_rng(seed)
    boxes = []
    for side in (-1, 1):
        x = -60.0
        while x < 60.0:
            length, depth, height = rng.uniform([6, 4, 4], [18, 6, 9])
            y = side * (rng.uniform(8, 13) + depth / 2)
            boxes.append(
                [x + length / 2, y, height / 2 + GROUND, length / 2, depth / 2, height / 2, rng.normal(0, 0.06)]
            )
            x += length + rng.uniform(0.5, 6)
    for half, number, near, far in (([2.1, 0.9, 0.75], 14, 4.0, 6.0), ([0.15, 0.15, 2.8], 16, 5.5, 7.5)):
        x, y = rng.uniform(-50, 50, number), rng.choice([-1, 1], number) * rng.uniform(near, far, number)
        boxes += [[x[i], y[i], GROUND + half[2], *half, rng.normal(0, 0.3)] for i in range(number)]
    return np.array(boxes)


def sweep(boxes: Array, T_world_mid: Array, step: Array, rng: np.random.Generator, sigma: float) -> Scan:
    """One clockwise sweep of a scanner that moves by ``step`` a period; its stamp is the middle."""
    azimuth = -np.pi + (np.arange(COLUMNS) + 0.5) * 2 * np.pi / COLUMNS
    azimuth, elevation = (m.ravel() for m in np.meshgrid(azimuth, np.radians(np.linspace(-24.8, 2, BEAMS))))
    part = -azimuth / (2 * np.pi)
    beams = np.stack(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], axis=1
    )
    T = T_world_mid @ se3.matrix(part[:, None] * step)
    ranges = first_hit(boxes, T[:, :3, 3], np.einsum("nij,nj->ni", T[:, :3, :3], beams))
    hit = ranges < 80.0
    ranges = ranges + sigma * rng.standard_normal(len(ranges))
    points = (beams * ranges[:, None])[hit]
    return Scan(points.astype(np.float32), (part[hit] * PERIOD).astype(np.float32))


def first_hit(boxes: Array, origin: Array, beam: Array) -> Array:
    with np.errstate(divide="ignore", invalid="ignore"):
        down = (GROUND - origin[:, 2]) / beam[:, 2]
        nearest = np.where(down > 0, down, np.inf)
        for box in boxes:
            R_box_world = se3.exp_so3([0.0, 0.0, -box[6]])
            start, along = (origin - box[:3]) @ R_box_world.T, beam @ R_box_world.T
            one, other = (-box[3:6] - start) / along, (box[3:6] - start) / along
            enter, leave = np.minimum(one, other).max(axis=1), np.maximum(one, other).min(axis=1)
            nearest = np.where((enter < leave) & (enter > 0.5) & (enter < nearest), enter, nearest)
    return nearest


def drive(boxes: Array, step: Array, number: int, seed: int = 0, sigma: float = 0.02) -> Stream:
    """Equal steps from the origin."""
    rng = np.random.default_rng(seed)
    poses = [np.linalg.matrix_power(se3.matrix(step), k) for k in range(number)]
    return Stream("velo", "velodyne", PERIOD * np.arange(number), [sweep(boxes, T, step, rng, sigma) for T in poses])


@pytest.fixture(scope="module")
def stream() -> Stream:
    return drive(street(1), FORWARD, 4)


@pytest.fixture(scope="module")
def motions(stream: Stream) -> Motions:
    return estimate(stream, VelodyneOptions())


def test_motion_is_found_to_millimetres(stream: Stream, motions: Motions) -> None:
    error = np.abs(motions.vec - FORWARD)
    assert np.array_equal(motions.start, stream.stamps[:-1])
    assert np.array_equal(motions.end, stream.stamps[1:])
    assert error[:, :3].max() < 0.008
    assert error[:, 3:].max() < 0.0008


def test_moving_points_to_the_stamp_matters(stream: Stream, motions: Motions) -> None:
    raw = estimate(stream, VelodyneOptions(deskew=False))
    backward = [replace(s, times=-s.times) for s in stream.readings]
    wrong_way = estimate(replace(stream, readings=backward), VelodyneOptions())
    error, without, wrong = (np.abs(m.vec - FORWARD)[:, :3].max() for m in (motions, raw, wrong_way))
    assert without > 2 * error
    assert wrong > 2 * error


def test_the_motions_before_and_after_keep_wobble_out() -> None:
    """Pitch that swings from step to step is gone in the middle of a sweep, where two steps meet."""
    boxes, rng, poses, readings = street(5), np.random.default_rng(0), [np.eye(4)], []
    steps = np.array([[1.2, 0, 0, 0, swing, 0] for swing in (0.02, -0.02, 0.02, -0.02, 0.02)])
    for step in steps:
        poses.append(poses[-1] @ se3.matrix(step))
    for T in poses:
        readings.append(sweep(boxes, T, np.array([1.2, 0, 0, 0, 0, 0]), rng, 0.02))
    wobbling = Stream("velo", "velodyne", PERIOD * np.arange(6), readings)
    error = np.sqrt(np.mean((estimate(wobbling, VelodyneOptions()).vec - steps)[1:-1, 3:] ** 2))
    assert error < 0.0006  # 0.0017 with the motion before alone


def test_points_are_moved_to_where_they_were_at_the_stamp() -> None:
    rng = np.random.default_rng(0)
    still, times = rng.uniform(-50, 50, (100, 3)), rng.uniform(-0.05, 0.05, 100)
    velocity = np.array([15.0, 0.3, -0.2, 0.02, -0.03, 0.35])
    T_mid_then = se3.matrix(times[:, None] * velocity)
    seen = np.einsum("nij,nj->ni", se3.invert(T_mid_then)[:, :3, :3], still) + se3.invert(T_mid_then)[:, :3, 3]
    assert np.abs(deskew(seen, times, velocity) - still).max() < 1e-3


@pytest.mark.parametrize("step", [[3.0, 0.05, 0.0, 0.002, 0.004, 0.09], [0.0] * 6, [-1.0, 0, 0, 0, 0, -0.03]])
def test_a_slice_starts_from_nothing(step: list[float]) -> None:
    motions = estimate(drive(street(2), np.array(step), 2), VelodyneOptions())
    assert len(motions) == 1
    assert np.abs(motions.vec[0] - step).max() < 0.01


def test_slices_agree_with_the_whole(stream: Stream, motions: Motions) -> None:
    tail = estimate(stream[2:], VelodyneOptions())
    assert np.abs(tail.vec - motions.vec[2:]).max() < 0.005


def test_same_input_same_output(stream: Stream, motions: Motions) -> None:
    again = estimate(stream, VelodyneOptions())
    assert np.array_equal(again.vec, motions.vec)
    assert np.array_equal(again.cov, motions.cov)


def test_paper_minimum_is_an_option(stream: Stream, motions: Motions) -> None:
    paper = estimate(stream, VelodyneOptions(point_to_plane=True))
    assert np.abs(paper.vec - FORWARD).max() < 0.02
    assert not np.allclose(paper.vec, motions.vec, atol=1e-6)


def test_jacobian_is_the_derivative(motions: Motions, stream: Stream) -> None:
    a, b = (registration.surface(s.points.astype(float), 0.5) for s in stream.readings[:2])
    at = registration.plane_residuals(a, b, se3.matrix(motions.vec[0]), 0.2)

    def errors(vec: Array) -> Array:
        T = se3.matrix(vec)
        return np.einsum("ij,ij->i", at.points @ T[:3, :3].T + T[:3, 3] - at.targets, at.normals)

    steps = 1e-6 * np.eye(6)
    vec = motions.vec[0]
    numeric = np.stack([(errors(vec + d) - errors(vec - d)) / 2e-6 for d in steps], axis=1)
    assert np.allclose(errors(vec), at.errors, atol=1e-12)
    assert np.allclose(at.jacobian, numeric, atol=1e-6)


def test_covariance_is_that_of_range_noise(motions: Motions, stream: Stream) -> None:
    """Against brute force: the minimum recomputed under noise of every range, matches and normals kept."""
    a, b = (registration.surface(s.points.astype(float), 0.5) for s in stream.readings[:2])
    T = registration.point_to_plane(a, b, se3.matrix(motions.vec[0]), 0.2, iterations=10)
    at = registration.plane_residuals(a, b, T, 0.2)
    claimed = registration.range_covariance(at, 0.01, 3.0)
    rng = np.random.default_rng(3)
    A, R = at.jacobian, T[:3, :3]
    base = np.linalg.lstsq(A, at.errors, rcond=None)[0]
    beam_p = at.points / np.linalg.norm(at.points, axis=1, keepdims=True)
    beam_q = a.points / np.linalg.norm(a.points, axis=1, keepdims=True)
    found = []
    for _ in range(400):
        points = at.points + 0.01 * rng.standard_normal((len(at.points), 1)) * beam_p
        targets = (a.points + 0.01 * rng.standard_normal((len(a.points), 1)) * beam_q)[at.planes]
        moved = points @ R.T
        J = np.hstack([at.normals, np.cross(moved, at.normals) @ se3.left_jacobian(se3.log_so3(R))])
        errors = np.einsum("ij,ij->i", moved + T[:3, 3] - targets, at.normals)
        found.append(base - np.linalg.lstsq(J, errors, rcond=None)[0])
    ratio = np.diag(np.cov(np.array(found).T)) / np.diag(claimed)
    assert np.all((ratio > 0.75) & (ratio < 1.33)), ratio


def test_claimed_covariance_against_errors() -> None:
    """The paper's 0.1 m covers a scanner of 2 cm: mean squared error in sigmas at most the ideal 6."""
    rng = np.random.default_rng(5)
    nees = []
    for seed in range(6):
        step = np.array([rng.uniform(0.3, 2.0), *rng.normal(0, [0.02, 0.01, 0.002, 0.004, 0.02])])
        m = estimate(drive(street(seed), step, 3, seed), VelodyneOptions())
        error = m.vec - step
        nees += list(np.einsum("ni,nij,nj->n", error, np.linalg.inv(m.cov), error))
    assert len(nees) == 12
    assert 0.1 < np.median(nees) < 6.0
    assert np.mean(nees) < 12.0


def test_what_a_tunnel_hides_is_not_claimed() -> None:
    motions = estimate(drive(TUNNEL, FORWARD, 2), VelodyneOptions())
    sigma = np.sqrt(np.diagonal(motions.cov, axis1=1, axis2=2))[0]
    assert abs(motions.vec[0, 0] - FORWARD[0]) > 0.5, "a bare tunnel shows nothing of the speed"
    assert sigma[0] > 2.0
    assert np.all(sigma[2:] < 0.02)


def test_failed_steps_are_left_out(stream: Stream) -> None:
    elsewhere = drive(street(9), FORWARD, 2, seed=4)
    few = Scan(stream.readings[1].points[:100], stream.readings[1].times[:100])
    readings = [*stream.readings[:3], *elsewhere.readings, few, *elsewhere.readings]
    motions = estimate(Stream("velo", "velodyne", PERIOD * np.arange(8), readings), VelodyneOptions())
    assert np.allclose(motions.start, [0.0, 0.1, 0.3, 0.6])
    assert np.abs(motions.vec - FORWARD).max() < 0.02


def test_a_jump_is_left_out() -> None:
    boxes = street(2)
    rng = np.random.default_rng(0)
    places = [0.0, 0.2, 0.4, 2.9, 3.1]
    poses = [se3.matrix([x, 0, 0, 0, 0, 0]) for x in places]
    readings = [sweep(boxes, T, np.zeros(6), rng, 0.02) for T in poses]
    moving = Stream("velo", "velodyne", PERIOD * np.arange(5), readings)
    motions = estimate(moving, VelodyneOptions(max_jump=1.0))
    assert np.allclose(motions.start, [0.0, 0.1, 0.3])
    assert np.abs(motions.vec[:, 0] - 0.2).max() < 0.01


def test_nothing_usable_gives_no_motion() -> None:
    empty = Scan(np.zeros((0, 3), dtype=np.float32))
    assert len(estimate(Stream("velo", "velodyne", [0.0, 0.1], [empty, empty]), VelodyneOptions())) == 0


def test_nan_rows_are_dropped(stream: Stream, motions: Motions) -> None:
    def spoilt(scan: Scan) -> Scan:
        rows = np.full((50, 3), np.nan, dtype=np.float32)
        return Scan(np.vstack([rows, scan.points]), np.concatenate([np.full(50, np.nan, np.float32), scan.times]))

    dirty = replace(stream, readings=[spoilt(s) for s in stream.readings])
    assert np.allclose(estimate(dirty, VelodyneOptions()).vec, motions.vec, atol=1e-9)


def test_scans_without_times_are_registered_as_they_are(stream: Stream) -> None:
    timeless = replace(stream, readings=[Scan(s.points) for s in stream.readings[:2]], stamps=stream.stamps[:2])
    assert np.abs(estimate(timeless, VelodyneOptions()).vec - FORWARD).max() < 0.1


def test_one_scan_is_refused(stream: Stream) -> None:
    with pytest.raises(DataError, match=r"sensor velo: a motion takes two scans, and there are 1"):
        estimate(stream[:1], VelodyneOptions())


@pytest.mark.parametrize(
    ("reading", "sentence"),
    [
        (np.zeros((5, 3)), "not ndarray"),
        (Scan(np.zeros((5, 4), dtype=np.float32)), r"Scans of \(n, 3\) points"),
        (Scan(np.zeros((5, 3), dtype=np.float32), np.zeros(4, dtype=np.float32)), "4 times for 5 points"),
    ],
)
def test_what_is_not_a_scan_is_refused(stream: Stream, reading: object, sentence: str) -> None:
    wrong = replace(stream[:2], readings=[stream.readings[0], reading])
    with pytest.raises(DataError, match=f"sensor velo, scan 1 .*{sentence}"):
        estimate(wrong, VelodyneOptions())


def table(folder: Path, **values: object) -> SensorTable:
    return SensorTable("velo", folder, {"scans": "scans", "times": "times.txt", **values})


@pytest.fixture
def recorded(tmp_path: Path, stream: Stream) -> Path:
    (tmp_path / "scans").mkdir()
    for k, scan in enumerate(stream.readings[:3]):
        np.column_stack([scan.points, np.ones(len(scan.points))]).astype("<f4").tofile(tmp_path / f"scans/{k:06}.bin")
    (tmp_path / "times.txt").write_text("".join(f"2011-10-03 12:55:34.{k}12345678\n" for k in range(3)))
    return tmp_path


def test_a_table_of_a_rig_is_read(recorded: Path, stream: Stream) -> None:
    log = open_table(table(recorded, turns="clockwise"))
    velo = log.streams["velo"]
    assert log.epoch_ns == 1317646534012345678
    assert np.allclose(velo.stamps, [0.0, 0.1, 0.2], atol=1e-9)
    scan, truth = velo.readings[1], stream.readings[1]
    assert np.array_equal(scan.points, truth.points)
    assert np.abs(scan.times - truth.times).max() < 1e-6
    assert np.abs(estimate(velo, VelodyneOptions(**velo.options)).vec - FORWARD).max() < 0.01


def test_stamps_in_seconds_and_scans_in_npy(tmp_path: Path) -> None:
    (tmp_path / "scans").mkdir()
    for k in range(2):
        np.save(tmp_path / f"scans/{k}.npy", np.arange(6.0).reshape(2, 3))
    (tmp_path / "times.txt").write_text("1317646534.012345678\n1.3176465341e9\n\n")
    log = open_table(table(tmp_path))
    assert log.epoch_ns == 1317646534012345678
    assert np.allclose(log.streams["velo"].stamps, [0.0, 0.087654322], atol=1e-9)
    assert log.streams["velo"].readings[0].times is None


@pytest.mark.parametrize("suffix", ["ply", "pcd"])
def test_scans_in_formats_of_open3d(tmp_path: Path, suffix: str) -> None:
    open3d = pytest.importorskip("open3d", exc_type=ImportError)
    (tmp_path / "scans").mkdir()
    points = np.arange(12.0).reshape(4, 3)
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
    open3d.io.write_point_cloud(str(tmp_path / f"scans/0.{suffix}"), cloud)
    (tmp_path / f"scans/1.{suffix}").write_text("nothing of the kind\n")
    (tmp_path / "times.txt").write_text("0\n1\n")
    readings = open_table(table(tmp_path)).streams["velo"].readings
    assert np.allclose(readings[0].points, points)
    with pytest.raises(DataError, match=f"1.{suffix} is not a scan"):
        readings[1]


@pytest.mark.parametrize(
    ("values", "sentence"),
    [
        ({"scan": "x"}, "velo has the key 'scan', which is unknown here; it may have scans, times, turns"),
        ({"times": 3}, "sensor velo needs times = "),
        ({"turns": "left"}, "turns = 'left' is not known"),
        ({"scans": "nowhere"}, "sensor velo: scans = 'nowhere', but there is no folder .*nowhere"),
        ({"scans": "."}, "holds no scans"),
        ({"times": "nowhere.txt"}, "sensor velo: times = 'nowhere.txt', but there is no file .*nowhere.txt"),
        ({"times": "short.txt"}, "holds 2 stamps and .* 3 scans"),
        ({"times": "blank.txt"}, "blank.txt, line 2 holds no stamp"),
        ({"times": "infinite.txt"}, "infinite.txt, line 1 holds no stamp"),
    ],
)
def test_bad_tables_are_refused(recorded: Path, values: dict[str, object], sentence: str) -> None:
    (recorded / "short.txt").write_text("0\n1\n")
    (recorded / "blank.txt").write_text("0\n\n1\n")
    (recorded / "infinite.txt").write_text("inf\n1\n2\n")
    with pytest.raises(DataError, match=sentence):
        open_table(table(recorded, **values))


@pytest.mark.parametrize("name", ["cut.bin", "pickle.npy", "flat.npy"])
def test_bad_scan_files_are_refused(tmp_path: Path, name: str) -> None:
    (tmp_path / "scans").mkdir()
    file = tmp_path / "scans" / name
    contents = {"cut.bin": np.zeros(7, "<f4"), "pickle.npy": np.array([{}], dtype=object), "flat.npy": np.zeros(3)}
    contents[name].tofile(file) if name == "cut.bin" else np.save(file, contents[name], allow_pickle=True)
    (tmp_path / "times.txt").write_text("0\n")
    log = open_table(table(tmp_path))
    with pytest.raises(DataError, match=name):
        log.streams["velo"].readings[0]


@pytest.fixture(scope="module")
def real(recordings: Path) -> Stream:
    """KITTI-360, about 36 km/h."""
    files = sorted((recordings / "kitti360-3000/velodyne_points/data").glob("*.bin"))
    period, readings = 0.1046, []
    for file in files:
        points = np.fromfile(file, dtype="<f4").reshape(-1, 4)[:, :3]
        times = -np.arctan2(points[:, 1], points[:, 0]) / (2 * np.pi) * period
        readings.append(Scan(points, times.astype(np.float32)))
    return Stream("velo", "velodyne", period * np.arange(len(files)), readings)


def test_real_sweeps_chain(real: Stream) -> None:
    """Two steps against the one step over both."""
    single, double = (estimate(real[part], VelodyneOptions()) for part in (slice(0, 7), slice(0, 7, 2)))
    assert (len(single), len(double)) == (6, 3)
    T = se3.matrix(single.vec)
    error = se3.vector(se3.invert(T[0::2] @ T[1::2]) @ se3.matrix(double.vec))
    assert np.all(np.abs(single.vec[:, 0] - 1.02) < 0.05)
    assert np.abs(error[:, :3]).max() < 0.04
    assert np.abs(error[:, 3:]).max() < 0.004


def test_three_metres_are_found_from_nothing(real: Stream) -> None:
    """Without the coarse cells three of these four stop short, at 1.3 to 2.1 m."""
    for k in (8, 16, 24, 32):
        pair = Stream("velo", "velodyne", [0.0, 0.1], [real.readings[k], real.readings[k + 3]])
        motions = estimate(pair, VelodyneOptions())
        assert len(motions) == 1
        assert 3.0 < motions.vec[0, 0] < 3.15


@pytest.mark.long
def test_real_steps_are_all_found_and_agree(real: Stream) -> None:
    """Over 49 steps: the rms of two steps against one, per axis."""
    single, double = (estimate(real[part], VelodyneOptions()) for part in (slice(None), slice(0, None, 2)))
    assert (len(single), len(double)) == (49, 24)
    T = se3.matrix(single.vec[:48])
    error = se3.vector(se3.invert(T[0::2] @ T[1::2]) @ se3.matrix(double.vec))
    rms = np.sqrt(np.mean(error**2, axis=0))
    assert np.all(rms < [0.015, 0.006, 0.01, 0.002, 0.002, 0.0005]), rms
