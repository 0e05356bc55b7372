"""The paper author's stored motions: direction, covariance, failures, and the recordings themselves."""

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.io import loadmat, savemat

from calib_toolkit import Log, ReadContext, se3
from calib_toolkit.errors import DataError
from calib_toolkit_datasets import multi_array_calib

START_US, STEP_US = 1_317_646_534_420_949, 103_617
Array = NDArray[np.float64]


def opened(path: Path) -> Log:
    return multi_array_calib.open_log(path, ReadContext({}, lambda p: pytest.fail(f"opened {p}")))


def motions(n: int) -> Array:
    """T_prev_curr of a drive ahead (z of a camera) that turns; row 0 a placeholder."""
    rng = np.random.default_rng(11)
    vec = np.column_stack([rng.normal(0, 0.02, (n, 2)), np.full(n, 1.1), rng.normal(0, 0.1, (n, 3))])
    vec[0] = 0
    return vec


def write(folder: Path, name: str, key: str, vec: Array, step: int = STEP_US, **more: object) -> Path:
    """As the author stores motions: inverted, variances in a row, unsigned microseconds."""
    n = len(vec)
    variance = np.tile([1e-4, 2e-4, 4e-4, 1e-6, 2e-6, 3e-6], (n, 1))
    variance[0] = 1000
    struct = {
        "T_Skm1_Sk": se3.vector(se3.invert(se3.matrix(vec))),
        "T_Var_Skm1_Sk": variance,
        "time": START_US + step * np.arange(n, dtype=np.uint64),
        **more,
    }
    file = folder / f"{name}Data.mat"
    savemat(file, {key: struct})
    return file


def test_motions_come_out_the_way_the_sensor_moved(tmp_path: Path) -> None:
    vec = motions(6)
    write(tmp_path, "TestVel", "velData", vec)
    stream = opened(tmp_path).streams["velo"]
    assert (stream.kind, stream.has_scale, stream.intrinsics) == ("odometry", True, None)
    assert stream.readings[0].vec is None
    assert stream.notes == ()  # a placeholder is no failure
    for k in range(1, 6):
        assert stream.readings[k].vec == pytest.approx(vec[k], abs=1e-12)


def test_microseconds_and_epoch(tmp_path: Path) -> None:
    write(tmp_path, "TestVel", "velData", motions(4))
    write(
        tmp_path,
        "TestNav",
        "navData",
        motions(5),
        time=np.array([START_US - 7 + 10 * k for k in range(5)], np.uint64),
    )
    log = opened(tmp_path)
    assert log.epoch_ns == (START_US - 7) * 1000
    assert log.streams["velo"].stamps == pytest.approx(7e-6 + STEP_US * 1e-6 * np.arange(4), abs=1e-12)
    assert log.reference is None


def test_inverted_covariance_is_that_of_inverted_noise() -> None:
    rng = np.random.default_rng(5)
    vec = np.array([[1.0, -0.4, 0.3, 0.5, -0.2, 0.9]])
    variance = np.array([[1e-6, 4e-6, 2e-6, 3e-6, 1e-6, 2e-6]])
    inverse, cov = multi_array_calib.inverted(vec, variance)
    noisy = vec + rng.normal(size=(200_000, 6)) * np.sqrt(variance)
    sampled = se3.vector(se3.invert(se3.matrix(noisy)))
    expected = np.cov(sampled.T)
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    assert inverse[0] == pytest.approx(se3.vector(se3.invert(se3.matrix(vec)))[0])
    assert np.max(np.abs(cov[0] - expected) / scale) < 0.01


def test_cameras_in_the_order_of_their_numbers(tmp_path: Path) -> None:
    for number in (10, 2, 1):
        K = np.array([[400.0 + number, 0, 60, 0], [0, 400.0, 50, 0], [0, 0, 1, 0]])
        mask = np.ones((100, 120), np.uint8)
        write(tmp_path, f"TestCam{number}", f"cam{number}Data", motions(3), K=K, D=np.zeros(5, np.uint8), mask=mask)
    write(tmp_path, "TestNav", "navData", motions(3))
    write(tmp_path, "TestVel", "velData", motions(3))
    log = opened(tmp_path)
    assert list(log.streams) == ["velo", "ins", "cam0", "cam1", "cam2"]
    cameras = [log.streams[f"cam{i}"] for i in range(3)]
    assert [c.intrinsics.K[0, 0] for c in cameras if c.intrinsics] == [401, 402, 410]
    assert [c.has_scale for c in cameras] == [False] * 3
    intrinsics = cameras[0].intrinsics
    assert intrinsics is not None
    assert intrinsics.mask is not None
    assert (intrinsics.K.shape, intrinsics.size, intrinsics.mask.shape) == ((3, 3), (120, 100), (100, 120))


def test_cameras_of_one_trigger_share_a_clock(tmp_path: Path) -> None:
    for number, late in ((1, 0), (2, 0), (3, 7), (4, 7)):
        times = START_US + late + STEP_US * np.arange(4, dtype=np.uint64)
        write(tmp_path, f"TestCam{number}", f"cam{number}Data", motions(4), time=times)
    write(tmp_path, "TestNav", "navData", motions(4))
    write(tmp_path, "TestVel", "velData", motions(4))
    clocks = {n: s.clock for n, s in opened(tmp_path).streams.items()}
    assert [clocks[f"cam{i}"] for i in range(4)] == ["cam0", "cam0", "cam2", "cam2"]
    # the same stamps, and no trigger that is known of
    assert (clocks["velo"], clocks["ins"]) == ("velo", "ins")


@pytest.mark.parametrize(("value", "column"), [(1000.0, 4), (np.nan, 0), (0.0, 2)])
def test_rows_that_failed_hold_no_motion(tmp_path: Path, value: float, column: int) -> None:
    variance = np.full((6, 6), 1e-4)
    variance[3, column] = value
    write(tmp_path, "TestVel", "velData", motions(6), T_Var_Skm1_Sk=variance)
    stream = opened(tmp_path).streams["velo"]
    assert [r.vec is None for r in stream.readings] == [True, False, False, True, False, False]
    assert len(stream.notes) == 1
    assert "1 reading(s)" in stream.notes[0]
    assert "row 3" in stream.notes[0]


def test_no_motion_reaches_over_a_dropped_reading(tmp_path: Path) -> None:
    times = np.array([START_US + STEP_US * k for k in (0, 1, 2, 2, 4, 5)], np.uint64)
    write(tmp_path, "TestVel", "velData", motions(6), time=times)
    stream = opened(tmp_path).streams["velo"]
    assert stream.stamps == pytest.approx(STEP_US * 1e-6 * np.array([0, 1, 2, 4, 5]))
    assert [r.vec is None for r in stream.readings] == [True, False, False, True, False]
    assert "row 3" in stream.notes[0]


def test_damaged_files_are_named(tmp_path: Path) -> None:
    file = write(tmp_path, "TestVel", "velData", motions(4))
    whole = file.read_bytes()
    for content in (b"", whole[:200], whole[: len(whole) // 2], b"text" * 100):
        file.write_bytes(content)
        with pytest.raises(DataError, match=r"TestVelData\.mat: sensor velo can not be read"):
            opened(tmp_path)
    savemat(file, {"velData": {"time": np.arange(4)}})
    with pytest.raises(DataError, match=r"TestVelData\.mat: sensor velo can not be read"):
        opened(tmp_path)
    write(tmp_path, "TestVel", "velData", motions(4), time=np.arange(3, dtype=np.uint64))
    with pytest.raises(DataError, match="sensor velo has 3 stamps, 4 motions"):
        opened(tmp_path)


@pytest.mark.parametrize(
    ("at", "content"),
    [
        (0, b"\0"),  # a type that SciPy's table of types does not have
        (0, b"\x0e"),  # a matrix where numbers belong
        (4, b"\xff\xff"),  # more bytes than there are
        (-31, b"\x08"),  # complex, and no imaginary part
        (-32, b"\x05"),  # sparse
        (-16, b"\x09"),  # a row more than there are
    ],
)
def test_an_element_that_would_end_the_process_is_refused(tmp_path: Path, at: int, content: bytes) -> None:
    file = write(tmp_path, "TestVel", "velData", motions(4))
    raw = bytearray(file.read_bytes())
    numbers = raw.index(b"\x09\0\0\0")  # doubles
    raw[numbers + at : numbers + at + len(content)] = content
    file.write_bytes(raw)
    with pytest.raises(DataError, match=r"TestVelData\.mat: sensor velo can not be read \(ValueError"):
        opened(tmp_path)


def test_structs_without_end_are_not_made(tmp_path: Path) -> None:
    file = write(tmp_path, "TestVel", "velData", motions(4))
    raw = bytearray(file.read_bytes())
    raw[167] = 16  # the second size of the struct, 1, becomes 268435457
    file.write_bytes(raw)
    with pytest.raises(DataError, match=r"sensor velo can not be read \(ValueError"):
        opened(tmp_path)


def test_packed_files_are_read_and_lie_no_deeper_than_is_sane(tmp_path: Path) -> None:
    write(tmp_path, "TestVel", "velData", motions(9))
    whole = opened(tmp_path).streams["velo"].readings[3].vec
    content = loadmat(tmp_path / "TestVelData.mat")
    savemat(tmp_path / "TestVelData.mat", {"velData": content["velData"]}, do_compression=True)
    np.testing.assert_array_equal(opened(tmp_path).streams["velo"].readings[3].vec, whole)
    nested: dict[str, object] = {"a": 1}
    for _ in range(40):
        nested = {"a": nested}
    savemat(tmp_path / "TestVelData.mat", {"velData": nested})
    with pytest.raises(DataError, match=r"sensor velo can not be read \(ValueError"):
        opened(tmp_path)


def test_two_files_of_one_sensor_are_refused(tmp_path: Path) -> None:
    write(tmp_path, "AVel", "velData", motions(4))
    write(tmp_path, "BVel", "velData", motions(4))
    with pytest.raises(DataError, match=r"two files of one sensor \(velo\)"):
        opened(tmp_path)


def test_only_such_folders_match(tmp_path: Path) -> None:
    assert not multi_array_calib.matches(tmp_path)
    assert not multi_array_calib.matches(tmp_path / "nowhere")
    file = write(tmp_path, "TestVel", "velData", motions(4))
    assert multi_array_calib.matches(tmp_path)
    assert not multi_array_calib.matches(file)
    with pytest.raises(DataError, match="name a folder that does"):
        opened(file)


@pytest.mark.parametrize(
    ("folder", "counts"),
    [
        ("kitti", {"velo": 4548, **{f"cam{i}": 4550 for i in range(4)}}),
        ("shrimp", {"velo": 3744, "ins": 29909, **{f"cam{i}": 3139 for i in range(6)}}),
    ],
)
def test_the_authors_recordings(recordings: Path, folder: str, counts: dict[str, int]) -> None:
    path = recordings / "multi-array-calib" / folder
    assert multi_array_calib.matches(path)
    log = opened(path)
    assert {n: len(s) for n, s in log.streams.items()} == counts
    for stream in log.streams.values():
        motion = np.array([r.vec for r in stream.readings if r.vec is not None])
        cov = np.array([r.cov for r in stream.readings if r.vec is not None])
        assert len(motion) > 0.95 * len(stream)
        assert np.all(np.linalg.eigvalsh(cov) > 0)
        if not stream.has_scale:
            assert stream.clock == ("cam0" if folder == "shrimp" else stream.name)  # one ladybug, four cameras
            assert np.linalg.norm(motion[:, :3], axis=1) == pytest.approx(1.0)


def test_the_author_drove_forward(recordings: Path) -> None:
    """Along x of the velodyne, along z of KITTI's cameras."""
    log = opened(recordings / "multi-array-calib" / "kitti")
    velo, cam0 = (
        np.array([r.vec for r in log.streams[n].readings if r.vec is not None])[:, :3] for n in ("velo", "cam0")
    )
    assert np.median(velo[:, 0]) > 0.5
    assert np.median(cam0[:, 2]) > 0.95
