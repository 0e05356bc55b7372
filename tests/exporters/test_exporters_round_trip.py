"""Every format, out and back in: the same transforms, the same direction, the same clocks, the same names."""

from dataclasses import replace

import numpy as np
import pytest
from exported_rigs import ENDING, FORMATS, SENSORS, make_rig, ordinary, same
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st

from calib_toolkit import CameraIntrinsics, DataError, se3

CALM = settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
LENGTHS = st.one_of(st.floats(-50, 50), st.sampled_from([0.0, 1e-12, -1e-7, 999.0]))
ANGLES = st.one_of(st.floats(-np.pi, np.pi), st.sampled_from([0.0, np.pi, -np.pi / 2, np.pi / 2, 1e-9]))
POSES = st.tuples(LENGTHS, LENGTHS, LENGTHS, st.tuples(ANGLES, ANGLES, ANGLES))
SECONDS = st.floats(-10, 10)
AWKWARD = ["cam 1", "no", "1e5", "<a&b>", "a,b", '"', "'", "#x", "a: b", "$(x)", "/velo", "cam/1", "~", "ü", "a--b"]
NAMES = st.one_of(st.text(max_size=12), st.sampled_from(AWKWARD))


def turned(pose):
    """(4, 4) of a position and roll, pitch, yaw, among them the pitches where roll and yaw are one."""
    x, y, z, (roll, pitch, yaw) = pose
    R = se3.exp_so3([0, 0, yaw]) @ se3.exp_so3([0, pitch, 0]) @ se3.exp_so3([roll, 0, 0])
    return se3.rigid(R, [x, y, z])


@pytest.mark.parametrize("format_id", FORMATS)
@CALM
@given(data=st.data())
def test_read_back_every_format_gives_the_same_rig(exporting, format_id, data):
    names = SENSORS[format_id]
    n = len(names) - 1
    T = np.stack([np.eye(4), *(turned(p) for p in data.draw(st.lists(POSES, min_size=n, max_size=n)))])
    dt, skew = (np.array(data.draw(st.lists(SECONDS, min_size=n, max_size=n))) for _ in range(2))
    drifts = data.draw(st.booleans())
    rig = replace(make_rig(names, np.zeros((n, 6)), dt, skew * 1e-5 * drifts, 12.5), T_base_sensor=T)
    back = exporting.read(exporting.write(rig, format_id), format_id)
    assert same(rig, back)
    stamp = 100.0
    for name in names:
        assert back.determined[back.index(name)].all()
        assert abs(rig.dt_at(names[0], name, stamp) - back.dt_at(names[0], name, stamp)) < 1e-9


@pytest.mark.parametrize("format_id", FORMATS)
@CALM
@given(name=NAMES)
def test_a_name_comes_back_or_is_refused(exporting, format_id, name):
    names = (*SENSORS[format_id][:-1], name)
    assume(name not in names[:-1])
    rig = make_rig(names, np.random.default_rng(1).normal(size=(len(names) - 1, 6)), np.zeros(len(names) - 1))
    if format_id in ("kalibr", "colmap"):
        rig = replace(rig, has_scale=np.array([n == "ins" for n in names]))
    refused, path = "", None
    try:
        path = exporting.write(rig, format_id)
    except DataError as e:
        refused = str(e)
    assert len(refused) < 400
    assert repr(name) in refused or name in refused if path is None else same(rig, exporting.read(path, format_id))


@pytest.mark.parametrize("format_id", FORMATS)
def test_what_was_written_is_recognised_by_itself_alone(exporting, installed, format_id):
    path = exporting.write(ordinary(format_id), format_id)
    assert [e.id for e in installed.exporters.values() if e.matches(path)] == [format_id]
    assert installed.exporter_of(path).id == format_id


@pytest.mark.parametrize("format_id", FORMATS)
def test_the_same_rig_gives_the_same_files(exporting, format_id):
    path = exporting.write(ordinary(format_id), format_id)
    files = [f for f in exporting.folder.rglob("*") if f.is_file()]
    before = {f: f.read_bytes() for f in files}
    exporting.write(ordinary(format_id), format_id)
    assert {f: f.read_bytes() for f in files} == before
    assert path.exists()


@pytest.mark.parametrize("format_id", FORMATS)
def test_each_file_says_which_way_its_transforms_go_and_where_the_clocks_are(exporting, format_id):
    path = exporting.write(ordinary(format_id), format_id)
    texts = {f.name: f.read_text() for f in exporting.folder.rglob("*") if f.is_file()}
    for name, text in texts.items():
        assert "written by calib-toolkit" in text, name
        if "clocks" not in name:
            assert " maps points of " in text, name
    main = "".join(texts[f] for f in texts if ("clocks" not in f and path.stem[:3] in f) or "calib_" in f)
    assert ("clocks.yaml" in main) != (format_id in ("csv", "yaml"))
    assert "added to" in "".join(texts.values())


@pytest.mark.parametrize("format_id", FORMATS)
def test_an_unknown_clock_stays_unknown(exporting, format_id):
    names = SENSORS[format_id]
    rig = make_rig(names, np.random.default_rng(3).normal(size=(len(names) - 1, 6)))
    back = exporting.read(exporting.write(rig, format_id), format_id)
    others = [i for i, n in enumerate(back.names) if n != back.base]
    assert not back.determined[others, 6].any()
    assert back.determined[:, :6].all()


@pytest.mark.parametrize("format_id", [f for f in FORMATS if f not in ("csv", "yaml", "kalibr")])
def test_without_the_side_file_clocks_are_not_known(exporting, format_id):
    path = exporting.write(ordinary(format_id), format_id)
    (clocks,) = exporting.folder.rglob("*clocks.yaml")
    clocks.unlink()
    back = exporting.read(path, format_id)
    assert back.determined[:, 6].sum() == 1
    assert same(ordinary(format_id), back)


@pytest.mark.parametrize("format_id", ["csv", "yaml"])
def test_plain_formats_keep_sigmas_and_what_is_not_known(exporting, format_id):
    rig = ordinary(format_id)
    known = rig.determined.copy()
    known[1, 2] = known[2, 4] = known[3, 6] = False
    sigma = np.linspace(0.01, 0.2, 28)
    sigma[:7] = 0
    rig = replace(rig, covariance=np.diag(sigma**2), determined=known)
    back = exporting.read(exporting.write(rig, format_id), format_id)
    known[2, 3:6] = False  # a quaternion is there or not
    assert np.array_equal(back.determined, known)
    assert np.allclose(back.sigma[known], rig.sigma[known])
    assert np.array_equal(back.has_scale, rig.has_scale)
    assert "null" in exporting.write(rig, "yaml").read_text()


@pytest.mark.parametrize("format_id", [f for f in FORMATS if f not in ("csv", "yaml")])
def test_a_pose_that_is_not_known_is_refused(exporting, format_id):
    rig = ordinary(format_id)
    known = rig.determined.copy()
    known[1, 2] = False
    with pytest.raises(DataError, match=f"did not determine z of {rig.names[1]}, which {format_id} can not say"):
        exporting.write(replace(rig, determined=known), format_id)
    assert list(exporting.folder.iterdir()) == []


@pytest.mark.parametrize("format_id", FORMATS)
def test_one_sensor_alone_is_refused(exporting, format_id):
    with pytest.raises(DataError, match="alone has no pose"):
        exporting.write(make_rig(("cam0",), np.zeros((0, 6))), format_id)


@pytest.mark.parametrize("format_id", ["kalibr", "kitti", "nerf", "nuscenes", "colmap", "yaml"])
def test_intrinsics_go_where_there_is_a_place_for_them(exporting, format_id, camera):
    path = exporting.write(ordinary(format_id), format_id, intrinsics={"cam0": camera})
    text = (path / "calib_cam_to_cam.txt" if path.is_dir() else path).read_text()
    assert "700.0" in text
    assert same(ordinary(format_id), exporting.read(path, format_id))


@pytest.mark.parametrize("format_id", ["kalibr", "kitti", "nerf", "nuscenes", "colmap"])
def test_a_lens_that_a_format_can_not_hold_is_refused(exporting, format_id):
    wide = CameraIntrinsics(np.diag([700.0, 700.0, 1.0]), np.array([0.1, 0.2, 0, 0, 0.3, 0.1, 0.1, 0.1, 0.1]))
    with pytest.raises(DataError, match="cam0"):
        exporting.write(ordinary(format_id), format_id, intrinsics={"cam0": wide})


@pytest.mark.parametrize(
    ("format_id", "names", "sentence"),
    [
        ("kitti", ("velo", "lidar"), "none called lidar"),
        ("kitti", ("velo", "cam1"), "cam0, which is missing"),
        ("kitti", ("ins", "cam0"), "ties ins to velo"),
        ("kalibr", ("velo", "ins", "cam0"), "--sensors ins,cam0"),
        ("kalibr", ("velo", "ins"), "velo, ins are no cameras"),
        ("colmap", ("velo", "cam0", "cam1"), "--sensors cam0,cam1"),
        ("nerf", ("velo", "ins"), "none of velo, ins is a camera"),
        ("autoware", ("velo", "sensor_kit_base_link"), "make it the base"),
        ("nuscenes", ("velo", "ego"), "make it the base"),
    ],
)
def test_a_rig_that_a_format_can_not_hold_is_refused(exporting, format_id, names, sentence):
    with pytest.raises(DataError, match=sentence):
        exporting.write(make_rig(names, np.ones((len(names) - 1, 6))), format_id)


@pytest.mark.parametrize(
    ("format_id", "names"),
    [
        ("kitti", ("velo", "ins")),
        ("kitti", ("cam0", "cam3")),
        ("kitti", ("ins", "velo")),
        ("kitti", ("cam0", "velo", "ins")),
        ("kalibr", ("cam0", "cam1")),
        ("kalibr", ("cam1", "ins", "cam0")),
        ("autoware", ("sensor_kit_base_link", "velo", "cam0")),
        ("autoware", ("cam0", "velo")),
        ("nerf", ("cam0", "velo")),
        ("nerf", ("cam1", "cam0")),
        ("nerf", ("world", "cam0", "ins")),
        ("nuscenes", ("ego", "CAM_FRONT", "LIDAR_TOP")),
        ("nuscenes", ("cam0", "velo")),
    ],
)
def test_parts_of_rigs(exporting, format_id, names):
    rig = make_rig(names, np.random.default_rng(5).normal(size=(len(names) - 1, 6)), np.full(len(names) - 1, 0.02))
    back = exporting.read(exporting.write(rig, format_id), format_id)
    assert same(rig, back)
    assert all(abs(rig.dt_between(names[0], n)[0] - back.dt_between(names[0], n)[0]) < 1e-12 for n in names)
    assert ENDING.get(format_id) is not None or format_id in ("kalibr", "autoware")
