"""The monocular camera on rendered images of a textured room, on bad images, and on a real drive."""

from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from calib_toolkit import CameraIntrinsics, LazyReadings, Motions, SensorTable, Stream, se3
from calib_toolkit.errors import DataError
from calib_toolkit_plugins import monocular
from calib_toolkit_plugins.image_tables import load_image
from calib_toolkit_plugins.monocular import MonocularOptions

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

SIZE = (400, 240)
K = np.array([[300.0, 0, 199.5], [0, 300.0, 119.5], [0, 0, 1]])
CAMERA = CameraIntrinsics(K, size=SIZE)
WIDE = CameraIntrinsics(K, np.array([-0.25, 0.06, 0.001, -0.001, 0.0]), SIZE)
# walls of a street 14 m wide and 90 m long, in world axes x forward, y left, z up; the vehicle is near its origin
WALLS = np.array([[-40.0, 50.0], [-7.0, 27.0], [-1.6, 8.0]])
R_vehicle_camera = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])


@cache
def texture() -> Image:
    """Noise of several sizes, 1024 x 1024, that joins at its edges."""
    rng = np.random.default_rng(7)
    total = sum(
        cv2.resize(rng.normal(0, n**-0.5, (n, n)), (1024, 1024), interpolation=cv2.INTER_CUBIC)
        for n in (16, 64, 256, 512)
    )
    return np.asarray(np.clip(128 + 300 * total, 0, 255), np.uint8)


def render(T_world_camera: Array, camera: CameraIntrinsics, seed: int) -> Image:
    """What a camera inside the street sees, with a grey value or two of noise."""
    w, h = SIZE
    pixels = np.stack(np.meshgrid(np.arange(w), np.arange(h)), axis=-1).reshape(-1, 1, 2).astype(np.float64)
    xy = cv2.undistortPoints(pixels, camera.K, camera.distortion).reshape(-1, 2)
    rays = np.column_stack([xy, np.ones(len(xy))]) @ T_world_camera[:3, :3].T
    origin = T_world_camera[:3, 3]
    with np.errstate(divide="ignore"):
        reach = (np.where(rays > 0, WALLS[:, 1], WALLS[:, 0]) - origin) / rays
    wall = np.argmin(reach, axis=1)
    X = origin + rays * reach.min(axis=1)[:, None]
    across = np.array([[1, 2], [0, 2], [0, 1]])[wall]
    uv = (np.take_along_axis(X, across, axis=1) + 13.0 * wall[:, None]) * 32.0  # pixels of texture a metre
    uv = np.asarray(uv % 1024, np.float32).reshape(h, w, 2)
    image = cv2.remap(texture(), uv, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
    noise = np.random.default_rng(seed).normal(0, 1.5, image.shape)
    return np.asarray(np.clip(image + noise, 0, 255), np.uint8)


def images(T_world_camera: Array, stamps: Array, seed: int, camera: CameraIntrinsics = CAMERA) -> Stream:
    readings = [render(T, camera, 1000 * seed + k) for k, T in enumerate(T_world_camera)]
    return Stream("cam0", "monocular", stamps, readings, camera, has_scale=False)


def drive(vec: Array, n: int = 4, camera: CameraIntrinsics = CAMERA) -> Stream:
    """n images, each ``vec`` (camera axes) after the one before."""
    poses = [se3.rigid(R_vehicle_camera, np.zeros(3))]
    for _ in range(n - 1):
        poses.append(poses[-1] @ se3.matrix(vec))
    return images(np.array(poses), 0.1 * np.arange(n), 0, camera)


def estimate(stream: Stream, **options: Any) -> Motions:
    return monocular.estimate(stream, MonocularOptions(**options))


@pytest.mark.parametrize("camera", [CAMERA, WIDE], ids=["rectified", "distorted"])
def test_motion_through_a_street(camera: CameraIntrinsics) -> None:
    vec = np.array([0.1, 0.02, 0.8, 0.004, 0.03, -0.01])
    m = estimate(drive(vec, camera=camera))
    assert len(m) == 3
    assert not m.has_scale
    truth = np.concatenate([vec[:3] / np.linalg.norm(vec[:3]), vec[3:]])
    np.testing.assert_allclose(m.vec[:, 3:], np.tile(truth[3:], (3, 1)), atol=1e-3)
    np.testing.assert_allclose(m.vec[:, :3], np.tile(truth[:3], (3, 1)), atol=0.02)
    np.testing.assert_allclose(np.linalg.norm(m.vec[:, :3], axis=1), 1.0)


def test_the_covariance_says_nothing_along_the_direction_and_ties_it_to_the_rotation() -> None:
    m = estimate(drive(np.array([0.1, 0, 0.8, 0, 0.03, 0])))
    for vec, cov in zip(m.vec, m.cov, strict=True):
        assert np.linalg.matrix_rank(cov, hermitian=True) == 5
        np.testing.assert_allclose(cov[:, :3] @ vec[:3], 0.0, atol=1e-12)
        assert np.abs(cov[:3, 3:]).max() > 0.1 * np.sqrt(cov[:3, :3].max() * cov[3:, 3:].max())


@pytest.mark.parametrize("angle", [0.0, 0.03], ids=["standing", "turning"])
def test_without_translation_the_direction_is_open_and_the_rotation_is_not(angle: float) -> None:
    m = estimate(drive(np.array([0, 0, 0, 0, angle, 0])))
    assert len(m) == 3
    np.testing.assert_allclose(m.vec[:, 4], angle, atol=5e-4)
    np.testing.assert_allclose(np.sort(np.linalg.eigvalsh(m.cov[0, :3, :3])), [0, 1, 1], atol=1e-9)
    assert np.all(np.diagonal(m.cov[:, 3:, 3:], axis1=1, axis2=2) < 2e-3**2)


def test_steps_without_features_are_left_out() -> None:
    stream = drive(np.array([0, 0, 0.8, 0, 0, 0]), n=5)
    dark = [image if k != 2 else np.zeros_like(image) for k, image in enumerate(stream.readings)]
    m = estimate(replace(stream, readings=dark))
    np.testing.assert_allclose(m.start, [0.0, 0.3])
    np.testing.assert_allclose(m.end, [0.1, 0.4])
    night = estimate(replace(stream, readings=[np.zeros_like(image) for image in dark]))
    assert len(night) == 0
    assert not night.has_scale


def test_unrelated_images_have_no_motion() -> None:
    rng = np.random.default_rng(0)
    noise = [cv2.GaussianBlur(rng.integers(0, 256, SIZE[::-1], np.uint8), (0, 0), 2) * 3 for _ in range(3)]
    assert len(estimate(Stream("cam0", "monocular", np.arange(3.0), noise, CAMERA))) == 0


def test_the_mask_is_honoured() -> None:
    """Most of the image moves with the camera, as a bonnet does: a standing scene, until it is masked."""
    stream = drive(np.array([0, 0, 0.8, 0, 0, 0]), n=3)
    readings = [np.vstack([texture()[:140, :400], image[140:]]) for image in stream.readings]
    mask = np.zeros(SIZE[::-1], np.uint8)
    mask[140:] = 1
    bare = estimate(replace(stream, readings=readings))
    assert np.all(np.linalg.eigvalsh(bare.cov[:, :3, :3])[:, -1] > 0.5)
    m = estimate(replace(stream, readings=readings, intrinsics=replace(CAMERA, mask=mask)))
    np.testing.assert_allclose(m.vec[:, :3], [[0, 0, 1]] * 2, atol=0.05)
    assert np.all(np.linalg.eigvalsh(m.cov[:, :3, :3])[:, -1] < 0.1)


def test_corners_cover_the_image_and_colour_is_fine() -> None:
    image = drive(np.zeros(6), n=1).readings[0].copy()
    image[:, :200] = (image[:, :200] / 8).astype(np.uint8)  # half of it in shade
    corners = monocular._corners(image, CAMERA, MonocularOptions())
    assert np.mean(corners[:, 0] < 200) > 0.35
    stream = drive(np.array([0, 0, 0.8, 0, 0, 0]), n=2)
    colour = replace(stream, readings=[cv2.cvtColor(i, cv2.COLOR_GRAY2BGR) for i in stream.readings])
    np.testing.assert_allclose(estimate(colour).vec, estimate(stream).vec, atol=1e-3)


def test_undistortion_is_exact_and_carries_the_noise() -> None:
    xy = np.random.default_rng(0).uniform([-0.6, -0.35], [0.6, 0.35], (50, 2))
    pixels = monocular._project(xy, WIDE)
    points, usable = monocular.normalise(pixels, WIDE, 0.5)
    assert usable.all()
    np.testing.assert_allclose(points.xy, xy, atol=1e-9)
    moved = monocular.normalise(pixels + np.array([0.5, 0.0]), WIDE, 0.5)[0].xy - points.xy
    moved_down = monocular.normalise(pixels + np.array([0.0, 0.5]), WIDE, 0.5)[0].xy - points.xy
    cov = moved[:, :, None] * moved[:, None, :] + moved_down[:, :, None] * moved_down[:, None, :]
    np.testing.assert_allclose(points.cov, cov, rtol=0.02, atol=1e-9)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"intrinsics": None}, "cam0 has no intrinsics"),
        ({"intrinsics": CameraIntrinsics(K, size=(1242, 375))}, "cam0.* 400 x 240 .* for 1242 x 375"),
        ({"intrinsics": CameraIntrinsics(K, mask=np.ones((10, 20), np.uint8))}, "cam0.* mask is 20 x 10"),
        ({"intrinsics": CameraIntrinsics(4 * K)}, "cam0.* its camera matrix"),
        ({"intrinsics": CameraIntrinsics(K * [[4], [4], [1]])}, "cam0.*principal point"),
        ({"readings": [np.zeros((240, 400))] * 2}, "cam0.*float64"),
        ({"readings": [np.zeros((240, 400, 4), np.uint8)] * 2}, r"cam0.*\(240, 400, 4\)"),
    ],
)
def test_what_can_not_be_used_is_refused_by_name(change: dict[str, Any], sentence: str) -> None:
    stream = Stream("cam0", "monocular", np.arange(2.0), [np.zeros((240, 400), np.uint8)] * 2, CAMERA)
    with pytest.raises(DataError, match=sentence):
        estimate(replace(stream, **change))


def table(folder: Path, **change: Any) -> SensorTable:
    """A rig table of three images, numbered 7 to 9."""
    (folder / "images").mkdir()
    for k in (7, 8, 9):
        cv2.imwrite(str(folder / "images" / f"left_{k:06d}.png"), np.full((240, 400), k, np.uint8))
    (folder / "times.txt").write_text("1700000000.100000001\n1700000000.2\n1700000000.3\n")
    values = {"images": "images", "times": "times.txt", "camera_matrix": K.ravel().tolist(), **change}
    return SensorTable("left", folder, {key: value for key, value in values.items() if value is not None})


def test_a_camera_in_a_rig(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "mask.png"), np.eye(240, 400, dtype=np.uint8))
    log = monocular.open_table(table(tmp_path, mask="mask.png", distortion=[-0.3, 0.1, 0, 0, 0]))
    (stream,) = log.streams.values()
    assert (stream.name, stream.kind, stream.clock, stream.has_scale) == ("left", "monocular", "left", False)
    assert log.epoch_ns == 1_700_000_000_100_000_001
    np.testing.assert_allclose(stream.stamps, [0.0, 0.099999999, 0.199999999], atol=1e-12)
    assert [int(stream.readings[k][0, 0]) for k in range(3)] == [7, 8, 9]
    lens = stream.intrinsics
    assert lens is not None
    assert lens.mask is not None
    assert lens.size == SIZE
    assert lens.mask.sum() == 240
    np.testing.assert_array_equal(lens.K, K)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"images": None}, "sensor left needs images = "),
        ({"images": "nowhere"}, "sensor left: images = 'nowhere', but there is no folder .*nowhere"),
        ({"times": None}, "sensor left needs times = "),
        ({"camera_matrix": None}, "sensor left has no camera_matrix"),
        ({"camera_matrix": [1.0, 2.0]}, "left: camera_matrix has 2 numbers"),
        ({"camera_matrix": ["a"] * 9}, "left: camera_matrix must be"),
        ({"distortion": [0.1] * 3}, "left: distortion has 3 numbers"),
        ({"mask": "images/left_000007.png", "distorsion": []}, "left has the key 'distorsion'"),
    ],
)
def test_a_rig_table_that_is_wrong_is_refused_by_name(tmp_path: Path, change: dict[str, Any], sentence: str) -> None:
    with pytest.raises(DataError, match=sentence):
        monocular.open_table(table(tmp_path, **change))


@pytest.mark.parametrize(
    ("lines", "sentence"),
    [
        ("0.1\n0.2\n", "2 stamps for 3 images numbered 7 to 9"),
        ("0.1\nhalf past\n0.3\n", "line 2: 'half past' is neither"),
        ("", "holds no rows"),
        ("7 0.1\n8 nan\n9 0.3\n", "line 2 holds no stamp"),
        ("0.1\n2011-13-26 13:02:25\n2011-11-26 13:02:26\n", "line 2: .* is not a stamp"),
        ("7 0.1\n8 0.2\n9", "line 3 is cut short; complete it, or remove it and its images"),
        ("7 0.1\n9 0.3\n", "no stamp for image 8"),
    ],
)
def test_stamps_that_do_not_fit_are_refused(tmp_path: Path, lines: str, sentence: str) -> None:
    given = table(tmp_path)
    (tmp_path / "times.txt").write_text(lines)
    with pytest.raises(DataError, match=sentence):
        monocular.open_table(given)


NUMBERED = "# all of them\n7 0.1\n8 0.2\n9 0.3\n"
DATES = "2011-09-26 13:02:25.1\n2011-09-26 13:02:25.2\n2011-09-26 13:02:25.3\n"


@pytest.mark.parametrize("lines", [NUMBERED, DATES], ids=["numbered", "dates"])
def test_stamps_may_be_numbered_or_dates(tmp_path: Path, lines: str) -> None:
    given = table(tmp_path)
    (tmp_path / "times.txt").write_text(lines)
    (stream,) = monocular.open_table(given).streams.values()
    np.testing.assert_allclose(stream.stamps, [0, 0.1, 0.2], atol=1e-9)


def test_a_truncated_image_is_named(tmp_path: Path) -> None:
    given = table(tmp_path)
    (tmp_path / "images" / "left_000008.png").write_bytes(b"")
    (stream,) = monocular.open_table(given).streams.values()
    with pytest.raises(DataError, match=r"left_000008\.png is not an image"):
        estimate(stream)


def test_a_real_street(recordings: Path) -> None:
    """KITTI-360: forward driving, two yaw rates that add up, and errors that stay small from step to step."""
    folder = recordings / "kitti360-3000" / "image_00" / "data"
    files = sorted(folder.glob("*.png"))[:13]
    camera = CameraIntrinsics(np.array([[552.554261, 0, 682.049453], [0, 552.554261, 238.769549], [0, 0, 1]]))
    stream = Stream("cam0", "monocular", 0.1 * np.arange(13), LazyReadings(load_image, files), camera)
    m = estimate(stream)
    assert len(m) == 12
    assert np.all(m.vec[:, 2] > 0.98)
    assert np.std(m.vec[:, :2]) < 0.1
    jumps = np.diff(m.vec[:, 4], 2) / np.sqrt(6)
    assert np.sqrt(np.mean(jumps**2)) < 1e-3
    skipped = estimate(replace(stream, stamps=stream.stamps[::2], readings=stream.readings[::2]))
    np.testing.assert_allclose(skipped.vec[:, 4], m.vec[::2, 4] + m.vec[1::2, 4], atol=1e-3)
