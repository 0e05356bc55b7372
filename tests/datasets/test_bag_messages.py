"""Messages of the common drivers, decoded: points with their times, images, cameras, poses, fixes."""

import cv2
import numpy as np
import pytest
from bag_builders import START, Messages, points, write

from calib_toolkit import DataError, ReadContext
from calib_toolkit_datasets.bags import log as bags

SWEEP = 100_000_000
TIMES = np.linspace(0.0, 0.0995, 50)


def opened(path):
    opens = bags.open_bag1 if path.is_file() else bags.open_bag2
    return opens(path, ReadContext({}, lambda _: None))


def clouds(path, storage="rosbag1", columns=None, **layout):
    rng, m = np.random.default_rng(1), Messages("ros1" if storage == "rosbag1" else "cdr")
    tables = [points(rng, **(columns(START + k * SWEEP) if columns else {})) for k in range(3)]
    write(
        path,
        storage,
        [("/velo/points", START + k * SWEEP, m.cloud(START + k * SWEEP, t, **layout)) for k, t in enumerate(tables)],
    )
    return tables


@pytest.mark.parametrize(
    ("field", "values", "shift"),
    [
        ("time", lambda ns: TIMES.astype("f4"), 0.0),  # Velodyne: seconds from the stamp
        ("time", lambda ns: (TIMES - 0.0995).astype("f4"), -0.0995),  # the same, the stamp at the end
        ("t", lambda ns: np.round(TIMES * 1e9).astype("u4"), 0.0),  # Ouster: nanoseconds
        ("offset_time", lambda ns: np.round(TIMES * 1e9).astype("u4"), 0.0),  # Livox
        ("timestamp", lambda ns: ns / 1e9 + TIMES, 0.0),  # Hesai, RoboSense: unix seconds
        ("timestamp", lambda ns: np.float64(ns) + TIMES * 1e9, 0.0),  # Livox: unix nanoseconds
        ("time_stamp", lambda ns: np.round(TIMES * 1e6).astype("u4"), 0.0),  # microseconds
    ],
)
def test_the_time_of_each_point(tmp_path, field, values, shift):
    clouds(tmp_path / "a.bag", columns=lambda ns: {field: values(ns), "ring": np.arange(50, dtype="u2")})
    stream = opened(tmp_path / "a.bag").streams["velo"]
    assert stream.notes == ()
    scan = stream.readings[1]
    np.testing.assert_allclose(scan.times, TIMES + shift, atol=1e-6)
    assert scan.ring.tolist() == list(range(50))


def test_times_of_another_clock_begin_at_the_stamp_and_that_is_said(tmp_path):
    clouds(tmp_path / "a.bag", columns=lambda ns: {"timestamp": ns / 1e9 + 37.0 + TIMES})
    stream = opened(tmp_path / "a.bag").streams["velo"]
    assert "+37.0 s" in stream.notes[0]
    assert "another clock" in stream.notes[0]
    np.testing.assert_allclose(stream.readings[0].times, TIMES, atol=1e-6)


def test_times_in_no_unit_are_left_out_and_that_is_said(tmp_path):
    clouds(tmp_path / "a.bag", columns=lambda ns: {"t": np.full(50, 3, dtype="u4")})
    stream = opened(tmp_path / "a.bag").streams["velo"]
    assert "no unit of time" in stream.notes[0]
    assert stream.readings[0].times is None


@pytest.mark.parametrize("storage", ["rosbag1", "sqlite", "mcap"])
@pytest.mark.parametrize("big", [False, True])
def test_points_whatever_the_order_of_bytes(tmp_path, storage, big):
    tables = clouds(tmp_path / "a", storage, lambda ns: {"intensity": np.arange(50, dtype="f4")}, big=big)
    scan = opened(tmp_path / "a").streams["velo"].readings[2]
    np.testing.assert_array_equal(scan.points, np.stack([tables[2][c] for c in "xyz"], axis=1))
    assert scan.intensity.tolist() == list(range(50))


def test_rows_with_padding_and_points_that_are_not_numbers(tmp_path):
    rng, m = np.random.default_rng(2), Messages("ros1")
    table = points(rng, 6)
    table["y"][4] = np.nan
    rows = table.reshape(2, 3)
    data = np.concatenate([np.frombuffer(r.tobytes() + b"\xff" * 8, np.uint8) for r in rows])
    message = m.cloud(START, table, height=2, row=3 * 12 + 8, data=data)
    write(
        tmp_path / "a.bag", "rosbag1", [("/p", START, message), ("/p", START + SWEEP, m.cloud(START + SWEEP, table))]
    )
    scan = opened(tmp_path / "a.bag").streams["p"].readings[0]
    np.testing.assert_array_equal(scan.points[:, 0], np.delete(table["x"], 4))


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"row": 7}, "rows of 7 bytes"),
        ({"step": 4}, "lies beyond the point"),
        ({"data": np.zeros(10, np.uint8)}, "holds 10 bytes"),
    ],
)
def test_a_layout_that_does_not_fit_is_refused(tmp_path, wrong, said):
    m, rng = Messages("cdr"), np.random.default_rng(0)
    good, bad = points(rng), points(rng)
    rows = [m.cloud(START + k * SWEEP, good) for k in range(3)]
    rows[0] = m.cloud(START, bad, **wrong)
    write(tmp_path / "a", "sqlite", [("/p", START + k * SWEEP, r) for k, r in enumerate(rows)])
    with pytest.raises(DataError, match=said):
        opened(tmp_path / "a").streams["p"].readings[0]


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
        ns = START + k * SWEEP
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


def test_odometry_with_and_without_covariance_of_its_own(tmp_path):
    m, cov = Messages("cdr"), np.diag([0.01] * 3 + [1e-4] * 3)
    rows = []
    for k in range(5):
        ns, t = START + k * SWEEP, (k, 0, 0)
        rows += [("/a/odom", ns, m.pose(ns, t, cov=cov)), ("/b/odom", ns, m.pose(ns, t, cov=cov * (1 + k)))]
    log = opened(write(tmp_path / "a", "mcap", rows))
    np.testing.assert_array_equal(log.streams["a"].readings[3].cov, cov)
    assert log.streams["b"].readings[3].cov is None
    assert log.streams["a"].readings[3].T_world_sensor[0, 3] == 3.0


def test_a_fix_takes_its_attitude_from_the_imu_around_it(tmp_path):
    m, rows = Messages("cdr"), []
    for k in range(4):
        ns = START + k * SWEEP
        rows.append(("/ins/fix", ns, m.fix(ns, 49.0, 8.4 + 1e-5 * k, 110.0)))
    for k in range(-1, 40):
        ns, yaw = START + k * SWEEP // 10 + 5_000_000, 0.01 * k + 0.005
        rows.append(("/ins/imu", ns, m.imu(ns, (0, 0, np.sin(yaw / 2), np.cos(yaw / 2)))))
    stream = opened(write(tmp_path / "a", "sqlite", rows)).streams["ins"]
    assert (stream.kind, stream.notes) == ("gps_ins", ())
    fix = stream.readings[2]
    assert fix.yaw == pytest.approx(0.2, abs=1e-9)
    assert (np.degrees(fix.lat), np.degrees(fix.lon), fix.alt) == pytest.approx((49.0, 8.4 + 2e-5, 110.0), abs=1e-12)
    np.testing.assert_allclose([*fix.sigma_position, *fix.sigma_rpy], [0.02, 0.02, 0.05, 1e-3, 1e-3, 1e-3])


def test_messages_without_a_fix_are_left_out(tmp_path):
    m, rows = Messages("cdr"), []
    for k in range(5):
        ns = START + k * SWEEP
        rows.append(("/fix", ns, m.fix(ns, 49 + 1e-5 * k, 8, 0, status=-(k == 2))))
        rows.append(("/imu", ns, m.imu(ns, quaternion=(0.0, 0.0, 0.6, 0.8))))
    stream = opened(write(tmp_path / "a", "sqlite", rows)).streams["fix"]
    assert len(stream) == 4
    assert "1 of 5 messages have no fix" in stream.notes[0]


def test_positions_alone_have_no_attitude_and_it_is_said(tmp_path):
    m = Messages("cdr")
    rows = [("/fix", START + k * SWEEP, m.fix(START + k * SWEEP, 49.0 + 1e-5 * k, 8.4, 110.0)) for k in range(5)]
    rows += [("/odom", START + k * SWEEP, m.pose(START + k * SWEEP, (k, 0, 0))) for k in range(5)]
    log = opened(write(tmp_path / "a", "sqlite", rows))
    assert set(log.streams) == {"fix", "odom"}
    stream = log.streams["fix"]
    assert stream.kind == "gps_ins"
    assert all(np.isnan([f.roll, f.pitch, f.yaw]).all() for f in stream.readings)
    np.testing.assert_allclose(np.degrees([f.lat for f in stream.readings]), 49.0 + 1e-5 * np.arange(5))
    assert any("positions alone" in note for note in stream.notes)


def test_an_imu_alone_turns_and_does_not_travel(tmp_path):
    m, rng, rows = Messages("cdr"), np.random.default_rng(0), []
    bias = np.array([0.01, -0.02, 0.005])
    for k in range(1000):
        ns, moving = START + k * 10_000_000, k >= 500
        rate = bias + np.array([0, 0, 0.3]) * moving
        shake = rng.normal([0, 0, 9.8], 0.5 if moving else 0.01)
        rows.append(("/imu", ns, m.imu(ns, rate=rate, acceleration=shake)))
    stream = opened(write(tmp_path / "a", "sqlite", rows)).streams["imu"]
    assert not stream.has_scale
    assert stream.period == pytest.approx(0.05)
    turns = np.array([r.vec[3:] for r in stream.readings[1:]])
    np.testing.assert_allclose(turns[:90], 0.0, atol=1e-9)
    np.testing.assert_allclose(turns[110:], np.tile([0, 0, 0.015], (len(turns) - 110, 1)), atol=1e-9)


def test_static_transforms_become_the_reference(tmp_path):
    m, half = Messages("ros1"), np.sqrt(0.5)
    rows = [
        (
            "/tf_static",
            START,
            m.frames(
                m.transform("base", "velo", (1, 0, 2)), m.transform("base", "cam", (2, 0, 1), (0, 0, half, half))
            ),
        )
    ]
    for k in range(3):
        ns = START + k * SWEEP
        rows += [
            ("/velo/points", ns, m.cloud(ns, points(np.random.default_rng(k)))),
            ("/cam0/image_raw", ns, m.image(ns, PIXELS, "bgr8", frame="cam")),
        ]
    log = opened(write(tmp_path / "a.bag", "rosbag1", rows))
    T = log.reference.between("velo", "cam0").T_a_b
    np.testing.assert_allclose(T[:3, 3], [1, 0, -1], atol=1e-12)
    np.testing.assert_allclose(T[:3, 0], [0, 1, 0], atol=1e-12)
    renamed = log.select(["lidar=/velo/points", "eye=cam0"])
    assert list(renamed.streams) == ["lidar", "eye"]
    np.testing.assert_array_equal(renamed.reference.between("lidar", "eye").T_a_b, T)
