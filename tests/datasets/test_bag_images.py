"""Images of the common drivers, decoded: encodings, mosaics, compressed ones, their intrinsics."""

import cv2
import numpy as np
import pytest
from bag_builders import START, STEP, Messages, opened, write

from calib_toolkit import DataError

PIXELS = np.random.default_rng(3).integers(0, 256, (48, 64, 3)).astype(np.uint8)
SMOOTH = cv2.GaussianBlur(PIXELS, (0, 0), 6)


def mosaic(bgr, pattern):
    """What a sensor with a pattern of colours sees; rggb is red, green / green, blue."""
    plane = np.zeros(bgr.shape[:2], np.uint8)
    for k, colour in enumerate(pattern):
        plane[k // 2 :: 2, k % 2 :: 2] = bgr[k // 2 :: 2, k % 2 :: 2, "bgr".index(colour)]
    return plane


def images(path, made, storage="rosbag1", info=None):
    m = Messages("ros1" if storage == "rosbag1" else "cdr")
    rows = []
    for k in range(2):
        ns = START + k * STEP
        rows.append(("/cam0/image_raw", ns, made(m, ns)))
        if info:
            rows.append(("/cam0/camera_info", ns, info(m, ns)))
    write(path, storage, rows)
    return opened(path).streams["cam0"]


@pytest.mark.parametrize(
    ("encoding", "sent", "wanted", "within"),
    [
        ("mono8", PIXELS[..., 0], PIXELS[..., 0], 0),
        ("bgr8", PIXELS, PIXELS, 0),
        ("rgb8", PIXELS[..., ::-1], PIXELS, 0),
        ("rgba8", np.dstack([PIXELS[..., ::-1], PIXELS[..., :1]]), PIXELS, 0),
        ("mono16", PIXELS[..., 0].astype("<u2") * 16 + 15, PIXELS[..., 0], 0),
        *((f"bayer_{p}8", mosaic(SMOOTH, p), SMOOTH, 14) for p in ("rggb", "bggr", "gbrg", "grbg")),
    ],
)
def test_images_in_every_encoding(tmp_path, encoding, sent, wanted, within):
    stream = images(tmp_path / "a.bag", lambda m, ns: m.image(ns, np.ascontiguousarray(sent), encoding))
    found = stream.readings[1]
    assert found.dtype == np.uint8
    inner = (slice(2, -2), slice(2, -2))
    assert np.abs(found[inner].astype(int) - wanted[inner]).max() <= within


def test_rows_of_pixels_with_padding_and_the_high_byte_first(tmp_path):
    wide = np.hstack([PIXELS[..., 0].astype(">u2") * 256, np.zeros((48, 4), ">u2")])

    def made(m, ns):
        message = m.image(ns, wide, "mono16", big=True)
        message.width = 64
        return message

    np.testing.assert_array_equal(images(tmp_path / "a.bag", made).readings[0], PIXELS[..., 0])


@pytest.mark.parametrize(("suffix", "within"), [(".png", 0), (".jpg", 12)])
def test_compressed_images(tmp_path, suffix, within):
    raw = cv2.imencode(suffix, SMOOTH)[1].tobytes()
    stream = images(tmp_path / "a.bag", lambda m, ns: m.compressed(ns, raw))
    assert np.abs(stream.readings[0].astype(int) - SMOOTH).max() <= within


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_compressed_images_cut_short_are_refused(tmp_path, suffix):
    raw = cv2.imencode(suffix, PIXELS)[1].tobytes()
    stream = images(tmp_path / "a.bag", lambda m, ns: m.compressed(ns, raw[: len(raw) // 2]))
    with pytest.raises(DataError, match="not a whole jpeg or png"):
        stream.readings[0]


def test_an_image_that_says_it_is_enormous_is_not_decoded(tmp_path):
    raw = bytearray(cv2.imencode(".png", PIXELS)[1].tobytes())
    raw[16:24] = (2**17).to_bytes(4, "big") * 2
    stream = images(tmp_path / "a.bag", lambda m, ns: m.compressed(ns, bytes(raw), "png"))
    with pytest.raises(DataError, match="not a whole"):
        stream.readings[0]


def test_an_unknown_encoding_is_a_reason_not_to_be_a_sensor(tmp_path):
    with pytest.raises(DataError, match="encoding '32FC1'"):
        images(tmp_path / "a.bag", lambda m, ns: m.image(ns, np.zeros((4, 4), "<f4"), "32FC1"))


K = np.array([[60.0, 0, 32], [0, 61.0, 24], [0, 0, 1]])


@pytest.mark.parametrize("storage", ["rosbag1", "sqlite"])
def test_intrinsics(tmp_path, storage):
    D = (-0.3, 0.1, 1e-3, 2e-3, 0.01)
    stream = images(
        tmp_path / "a", lambda m, ns: m.image(ns, PIXELS, "bgr8"), storage, lambda m, ns: m.info(ns, K, D)
    )
    np.testing.assert_array_equal(stream.intrinsics.K, K)
    np.testing.assert_array_equal(stream.intrinsics.distortion, D)
    assert stream.intrinsics.size == (64, 48)
    assert stream.notes == ()


@pytest.mark.parametrize(
    ("info", "said"),
    [
        (lambda m, ns: m.info(ns, K, (0.1,) * 4, "equidistant"), "'equidistant'"),
        (lambda m, ns: m.info(ns, K * 0), "no camera matrix"),
        (lambda m, ns: m.info(ns, K, binning=2), "binned"),
    ],
)
def test_intrinsics_that_do_not_fit_are_left_out_and_that_is_said(tmp_path, info, said):
    stream = images(tmp_path / "a.bag", lambda m, ns: m.image(ns, PIXELS, "bgr8"), info=info)
    assert stream.intrinsics is None
    assert said in stream.notes[0]
