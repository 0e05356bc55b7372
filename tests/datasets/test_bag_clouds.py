"""Points of the common drivers, decoded: their times, their layout, the order of their bytes."""

import numpy as np
import pytest
from bag_builders import START, STEP, Messages, opened, points, write

from calib_toolkit import DataError

TIMES = np.linspace(0.0, 0.0995, 50)


def clouds(path, storage="rosbag1", columns=None, **layout):
    rng, m = np.random.default_rng(1), Messages("ros1" if storage == "rosbag1" else "cdr")
    tables = [points(rng, **(columns(START + k * STEP) if columns else {})) for k in range(3)]
    write(
        path,
        storage,
        [("/velo/points", START + k * STEP, m.cloud(START + k * STEP, t, **layout)) for k, t in enumerate(tables)],
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
    write(tmp_path / "a.bag", "rosbag1", [("/p", START, message), ("/p", START + STEP, m.cloud(START + STEP, table))])
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
    rows = [m.cloud(START + k * STEP, good) for k in range(3)]
    rows[0] = m.cloud(START, bad, **wrong)
    write(tmp_path / "a", "sqlite", [("/p", START + k * STEP, r) for k, r in enumerate(rows)])
    with pytest.raises(DataError, match=said):
        opened(tmp_path / "a").streams["p"].readings[0]
