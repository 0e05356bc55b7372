"""Images that metrics compare: held as they were taken, straight when they are looked at."""

import cv2
import numpy as np
import pytest

from calib_toolkit import CameraIntrinsics, DataError, Stream
from calib_toolkit_plugins.metrics.images import grey_images

H, W = 60, 80
K = np.array([[70.0, 0, 41], [0, 72.0, 29], [0, 0, 1]])
BENT = np.array([-0.3, 0.1, 1e-3, -2e-3, 0.0])


def camera(lens: CameraIntrinsics | None, colour: bool = True) -> Stream:
    shape = (H, W, 3) if colour else (H, W)
    images = np.random.default_rng(1).integers(0, 256, (3, *shape)).astype(np.uint8)
    return Stream("cam0", "monocular", np.arange(3.0), list(images), lens, has_scale=False)


def test_colour_images_are_held_in_a_byte_a_pixel_and_straightened_as_opencv_does() -> None:
    stream = camera(CameraIntrinsics(K, BENT, (W, H)))
    held, straight = grey_images(stream, [1, 2])
    assert [v.nbytes for v in held] == [H * W] * 2
    grey = cv2.cvtColor(stream.readings[2], cv2.COLOR_BGR2GRAY)
    found, wanted = straight(held[1]), cv2.undistort(grey.astype(np.float32) / 255, K, BENT)
    assert found.dtype == np.float32
    assert np.abs(found - wanted)[straight.usable].max() < 0.02
    assert np.abs(found - grey / 255).max() > 0.5
    np.testing.assert_array_equal(straight.K, K)


def test_without_distortion_an_image_is_as_it_was_taken() -> None:
    stream = camera(CameraIntrinsics(K, size=(W, H)), colour=False)
    (held,), straight = grey_images(stream, [0])
    np.testing.assert_array_equal(straight(held), stream.readings[0].astype(np.float32) / 255)
    assert straight.usable.all()


@pytest.mark.parametrize("distortion", [np.zeros(0), BENT], ids=["straight", "bent"])
def test_a_mask_is_straightened_with_the_image(distortion: np.ndarray) -> None:
    mask = np.ones((H, W), np.uint8)
    mask[40:] = 0
    usable = grey_images(camera(CameraIntrinsics(K, distortion, (W, H), mask)), [0])[1].usable
    assert usable[20:36, 20:60].all()
    assert not usable[44:].any()


def test_all_images_of_a_camera_share_one_straightener() -> None:
    one, again, other = (CameraIntrinsics(K.copy(), BENT * s, (W, H)) for s in (1.0, 1.0, 0.5))
    first = grey_images(camera(one), [0])[1]
    assert grey_images(camera(again), [2])[1] is first
    assert grey_images(camera(other), [0])[1] is not first


def test_a_camera_without_intrinsics_is_named() -> None:
    with pytest.raises(DataError, match="cam0 has no intrinsics"):
        grey_images(camera(None), [0])
