"""Logs of Argoverse 2: cameras and the vehicle's poses, and why its lidar is none."""

import sys

import cv2
import numpy as np
import pytest

from calib_toolkit import DataError

START_NS = 315_966_265_259_836_000
CAMERAS = {"ring_front_center": (12, 16), "stereo_front_left": (16, 12)}  # width, height
MOUNTS = {
    "ring_front_center": ([0.5, -0.5, 0.5, -0.5], [1.63, 0.0, 1.43]),
    "stereo_front_left": ([0.5, -0.5, 0.5, -0.5], [1.62, 0.25, 1.22]),
    "up_lidar": ([1.0, 0.0, 0.0, 0.0], [1.35, 0.0, 1.64]),
    "down_lidar": ([0.0, -1.0, 0.0, 0.0], [1.36, 0.0, 1.57]),
}
pyarrow = pytest.importorskip("pyarrow")


def feather(file, columns):
    from pyarrow import feather as f

    file.parent.mkdir(parents=True, exist_ok=True)
    f.write_feather(pyarrow.table(columns), str(file))


def poses(n=60):
    """Columns of poses at the stamps of all sensors: two cameras and a lidar, some a nanosecond apart."""
    ns = np.sort(np.concatenate([START_NS + k * 50_000_000 + np.array([0, 1, 12_500_000]) for k in range(n // 3)]))
    angle = (ns - START_NS) / 1e9 * 0.2
    zero = np.zeros(len(ns))
    q = {"qw": np.cos(angle / 2), "qx": zero, "qy": zero, "qz": np.sin(angle / 2)}
    return {"timestamp_ns": ns, **q, "tx_m": 747.0 + (ns - START_NS) / 1e8, "ty_m": zero + 1275, "tz_m": zero - 24}


def mounts():
    q, t = (np.array([m[i] for m in MOUNTS.values()]) for i in (0, 1))
    named = {f"q{axis}": q[:, i] for i, axis in enumerate("wxyz")}
    return {"sensor_name": list(MOUNTS), **named, **{f"t{axis}_m": t[:, i] for i, axis in enumerate("xyz")}}


def lenses():
    size = np.array(list(CAMERAS.values()))
    f = {"fx_px": [20.0, 21.0], "fy_px": [20.0, 21.0], "cx_px": size[:, 0] / 2, "cy_px": size[:, 1] / 2}
    k = {"k1": [-0.3, -0.3], "k2": [-0.2, -0.1], "k3": [0.3, 0.2]}
    return {"sensor_name": list(CAMERAS), **f, **k, "height_px": size[:, 1], "width_px": size[:, 0]}


def made(root, lidar=True):
    rng = np.random.default_rng(2)
    feather(root / "city_SE3_egovehicle.feather", poses())
    feather(root / "calibration/egovehicle_SE3_sensor.feather", mounts())
    feather(root / "calibration/intrinsics.feather", lenses())
    for name, (w, h) in CAMERAS.items():
        folder = root / "sensors/cameras" / name
        folder.mkdir(parents=True)
        for k in range(20):
            image = rng.integers(0, 255, (h, w, 3)).astype(np.uint8)
            cv2.imwrite(str(folder / f"{START_NS + k * 50_000_000}.jpg"), image)
    if lidar:
        feather(root / f"sensors/lidar/{START_NS}.feather", {"x": [1.0], "offset_ns": [0]})
    return root


def test_a_log_is_its_cameras_and_the_vehicles_poses(tmp_path, opened):
    log = opened(made(tmp_path))
    assert {n: (s.kind, len(s), s.has_scale) for n, s in log.streams.items()} == {
        "ring_front_center": ("monocular", 20, False),
        "stereo_front_left": ("monocular", 20, False),
        "ego": ("odometry", 20, True),
    }
    assert log.epoch_ns == START_NS
    camera = log.streams["ring_front_center"]
    assert round(camera.stamps[3] * 1e9) == 150_000_000
    np.testing.assert_array_equal(camera.intrinsics.K, [[20, 0, 6], [0, 20, 8], [0, 0, 1]])
    assert camera.intrinsics.size == (12, 16)
    assert camera.readings[4].shape == (16, 12, 3)
    assert camera.notes == ()


def test_images_are_undistorted_so_their_lens_has_no_distortion(tmp_path, opened):
    assert opened(made(tmp_path)).streams["stereo_front_left"].intrinsics.distortion.size == 0


def test_poses_a_nanosecond_apart_are_not_steps(tmp_path, opened):
    ego = opened(made(tmp_path)).streams["ego"]
    assert np.diff(ego.stamps).min() >= 0.045
    pose = ego.readings[7].T_world_sensor
    assert pose[0, 3] == pytest.approx(747 + 10 * ego.stamps[7])
    assert np.arctan2(pose[1, 0], pose[0, 0]) == pytest.approx(0.2 * ego.stamps[7])


def test_the_merged_lidar_is_refused_and_that_is_said(tmp_path, opened):
    log = opened(made(tmp_path))
    assert log.notes[0].startswith("lidar is left out: its sweeps are those of two scanners together")
    with pytest.raises(DataError, match=r"no sensor named 'lidar' \(its sweeps are those of two"):
        log.select(["lidar"])
    assert opened(made(tmp_path / "without", lidar=False)).notes == ()


def test_what_is_published_of_the_cameras_is_the_reference(tmp_path, opened):
    """A camera looks along its z, which is the vehicle's x."""
    reference = opened(made(tmp_path)).reference
    assert (reference.base, reference.names) == ("ego", ("ego", "ring_front_center", "stereo_front_left"))
    np.testing.assert_allclose(
        reference.between("ego", "stereo_front_left").T_a_b @ [0, 0, 5, 1], [6.62, 0.25, 1.22, 1], atol=1e-12
    )


def test_parts_may_be_missing(tmp_path, opened):
    root = made(tmp_path)
    (root / "calibration/intrinsics.feather").unlink()
    (root / "calibration/egovehicle_SE3_sensor.feather").unlink()
    log = opened(root)
    assert log.reference is None
    assert "has no intrinsics" in log.streams["ring_front_center"].notes[0]
    feather(root / "calibration/egovehicle_SE3_sensor.feather", mounts())
    (root / "city_SE3_egovehicle.feather").unlink()
    log = opened(root)
    assert list(log.streams) == ["ring_front_center", "stereo_front_left"]
    assert "city_SE3_egovehicle.feather is missing" in log.notes[0]


def test_without_pyarrow_it_says_how_to_get_it(tmp_path, opened, monkeypatch):
    root = made(tmp_path)
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(DataError, match=r"takes pyarrow; pip install 'calib-toolkit\[argoverse\]'"):
        opened(root)


@pytest.mark.parametrize(
    ("file", "content", "change", "said"),
    [
        ("city_SE3_egovehicle", poses, {"qw": None}, "must have one column 'qw', and has timestamp_ns, qx"),
        ("city_SE3_egovehicle", poses, {"qw": np.full(60, 2.0)}, "qw qx qy qz is not of length one"),
        ("city_SE3_egovehicle", poses, {"qw": np.full(60, np.nan)}, "'qw' holds what is not finite"),
        ("city_SE3_egovehicle", poses, {"qw": ["x"] * 60}, "'qw' must be numbers in every row"),
        ("city_SE3_egovehicle", poses, {"tx_m": [None] + [1.0] * 59}, "'tx_m' must be numbers in every row"),
        ("city_SE3_egovehicle", poses, {"timestamp_ns": np.arange(60) * 0.1}, "'timestamp_ns' must be numbers"),
        ("city_SE3_egovehicle", poses, {"timestamp_ns": np.arange(60) - 3}, "must be nanoseconds of a clock"),
        (
            "city_SE3_egovehicle",
            poses,
            {"timestamp_ns": np.full(60, 2**63 + 5, "u8")},
            "must be nanoseconds of a clock",
        ),
        ("city_SE3_egovehicle", poses, {"tx_m": np.full(60, 1e300)}, "a translation leads nowhere on earth"),
        ("calibration/intrinsics", lenses, {"fx_px": [0.0, 1.0]}, "a camera matrix or a size of images is none"),
        ("calibration/intrinsics", lenses, {"width_px": [2.5, 3.0]}, "a camera matrix or a size of images is none"),
        ("calibration/intrinsics", lenses, {"sensor_name": ["a", "a"]}, "has a sensor twice"),
        ("calibration/intrinsics", lenses, {"sensor_name": [1, 2]}, "'sensor_name' must be texts"),
        ("calibration/egovehicle_SE3_sensor", mounts, {"qx": np.ones(4)}, "is not of length one"),
    ],
)
def test_tables_that_can_not_be_right_are_named(tmp_path, opened, file, content, change, said):
    root = made(tmp_path)
    columns = {k: v for k, v in {**content(), **change}.items() if v is not None}
    feather(root / f"{file}.feather", columns)
    with pytest.raises(DataError, match=said) as e:
        opened(root)
    assert f"{file}.feather" in str(e.value)


def test_images_not_called_by_stamps_are_left_out_and_those_of_another_unit_refused(tmp_path, opened):
    root = made(tmp_path)
    folder = root / "sensors/cameras/ring_front_center"
    first = folder / f"{START_NS}.jpg"
    first.rename(folder / "first.jpg")
    stream = opened(root).streams["ring_front_center"]
    assert len(stream) == 19
    assert stream.notes == ("ring_front_center: 1 of 20 images are not called by a stamp of their own",)
    (folder / "first.jpg").rename(folder / "9999999999999999999.jpg")
    with pytest.raises(DataError, match="beyond any clock"):
        opened(root)
    (folder / "9999999999999999999.jpg").unlink()
    folder.rename(folder.with_name("a,b"))
    with pytest.raises(DataError, match="a,b can not be a camera's name"):
        opened(root)


@pytest.mark.parametrize("count", [60, pytest.param(1000, marks=pytest.mark.long)])
def test_damaged_tables_are_refused_or_change_values_only(tmp_path, opened, count):
    """Bytes changed or cut at random: a sentence, or the same sensors. Feather has no checksums."""
    root, rng, refused = made(tmp_path), np.random.default_rng(count), 0
    files = sorted(root.rglob("*.feather"))[:3]
    whole = {f: f.read_bytes() for f in files}
    for _ in range(count):
        file = files[rng.integers(3)]
        file.write_bytes(mutated(whole[file], rng))
        try:
            log = opened(root)
            assert set(log.streams) == {"ring_front_center", "stereo_front_left", "ego"}
            for stream in log.streams.values():
                assert np.isfinite(stream.stamps).all()
        except DataError:
            refused += 1
        file.write_bytes(whole[file])
    assert count // 4 < refused < count


def mutated(raw, rng):
    raw = bytearray(raw)
    if rng.random() < 0.3:
        return bytes(raw[: rng.integers(len(raw))])
    for _ in range(rng.integers(1, 8)):
        at = int(rng.integers(len(raw) - 8))
        if rng.random() < 0.5:
            raw[at] ^= 1 << int(rng.integers(8))
        else:
            raw[at : at + 4] = bytes(rng.choice([b"\xff" * 4, bytes(4), b"\x00\x00\x00\x80", b"\x7f" * 4]))
    return bytes(raw)
