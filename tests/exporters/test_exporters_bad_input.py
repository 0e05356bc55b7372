"""Files that are damaged, hostile or of another kind: one sentence that names the file and what is wrong."""

import json
import re

import numpy as np
import pytest
import yaml
from exported_rigs import FORMATS, make_rig, ordinary

from calib_toolkit import DataError

CAM0 = "cam0: {T_cam_imu: %s}\n"
EYE = "[[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]"
TF = (
    "transforms: [{header: {frame_id: %s}, child_frame_id: %s, "
    "transform: {translation: {x: 0, y: 0, z: 0}, rotation: {x: 0, y: 0, z: 0, w: %s}}}]\n"
)
LINK = '<joint name="j%s" type="%s"><parent link="%s"/><child link="%s"/>%s</joint>'
KIT = "sensor_kit_base_link: {velo: {x: 0, y: 0, z: %s, roll: 0, pitch: 0, yaw: 0}}\n"
REFERENCE = '{"image_prefix": "%s", "ref_sensor": true}'


def robot(*joints):
    return f"<robot name='r'>{''.join(LINK % (k, *j) for k, j in enumerate(joints))}</robot>"


def rig_json(**changed):
    camera = {"image_prefix": "b/", "cam_from_rig_rotation": [1, 0, 0, 0], "cam_from_rig_translation": [0, 0, 1]}
    return json.dumps([{"cameras": [{"image_prefix": "a/", "ref_sensor": True}, {**camera, **changed}]}])


FRAME = {"file_path": "a.png", "transform_matrix": np.eye(4).tolist()}


def frames(T=None, **changed):
    """transforms.json of one frame, keys of it or beside it changed."""
    frame = FRAME if T is None else {**FRAME, "transform_matrix": T.tolist()}
    frame = {**frame, **{k: v for k, v in changed.items() if k in FRAME}}
    return json.dumps({"frames": [frame], **{k: v for k, v in changed.items() if k not in FRAME}})


BAD = {
    "no matrix": ("kalibr", CAM0 % "[1, 2, 3]", "T_cam_imu of cam0 is no list of four rows"),
    "short row": ("kalibr", CAM0 % "[[1, 0], [0], [], []]", "a list of 4 numbers belongs"),
    "not a rotation": ("kalibr", CAM0 % EYE.replace("[0, 1, 0, 0]", "[0, 2, 0, 0]"), "is not a rotation"),
    "left-handed": ("kalibr", CAM0 % EYE.replace("[0, 0, 1, 0]", "[0, 0, -1, 0]"), "left-handed"),
    "transposed": ("kalibr", CAM0 % EYE.replace("[0, 0, 0, 1]", "[5, 0, 0, 1]"), "is the matrix transposed"),
    "a gap": ("kalibr", "cam0: {}\ncam2: {}\n", "without a gap"),
    "no pose": ("kalibr", CAM0 % EYE + "cam1: {}\n", "cam1 has neither T_cam_imu nor T_cn_cnm1"),
    "one camera": ("kalibr", "cam0: {rostopic: a}\n", "holds no pose"),
    "contradiction": (
        "kalibr",
        f"cam0: {{T_cam_imu: {EYE}}}\ncam1: {{T_cam_imu: {EYE}, T_cn_cnm1: {EYE.replace('0, 0]', '0, 1]', 1)}}}\n",
        "T_cam_imu and T_cn_cnm1 of cam1 contradict each other",
    ),
    "nan": ("kalibr", CAM0 % EYE.replace("[1,", "[.nan,"), "nan, which is no number of a rig"),
    "infinite": ("kalibr", CAM0 % EYE.replace("0, 0]", "0, .inf]"), "inf, which is no number"),
    "millimetres and more": ("kalibr", CAM0 % EYE.replace("0, 0]", "0, 1e+9]"), "no number of a rig"),
    "a yes": ("kalibr", CAM0 % EYE.replace("0, 0]", "0, yes]"), "True, which is no number"),
    "a tag": ("kalibr", "cam0: !!python/object/apply:os.system ['touch %s']\n", "not plain YAML"),
    "a key twice": ("kalibr", CAM0 % EYE + CAM0 % EYE, "a key twice"),
    "a merge": ("kalibr", f"cam0: &a {{T_cam_imu: {EYE}}}\ncam1: {{<<: *a}}\n", "merges tables"),
    "two parents": ("ros2", (TF % ("a", "b", 1)) + "---\n" + (TF % ("c", "b", 1)), "the frame b two parents"),
    "a circle": ("ros2", (TF % ("a", "b", 1)) + "---\n" + (TF % ("b", "a", 1)), "round in circles"),
    "torn apart": ("ros2", (TF % ("a", "b", 1)) + "---\n" + (TF % ("c", "d", 1)), "nothing ties a to c"),
    "not unit": ("ros2", TF % ("a", "b", 0.9), "length 0.9, not 1"),
    "no frame": ("ros2", TF % ("''", "b", 1), "frame_id of b is ''"),
    "no rotation": ("ros2", "[{header: {frame_id: a}, child_frame_id: b, transform: {}}]", "no translation"),
    "no list": ("ros2", "transforms: 3\n", "transforms is not a list"),
    "a word": ("ros2", "hello\n", "has no child_frame_id"),
    "cut xml": ("urdf", robot(("fixed", "a", "b", ""))[:-9], "not whole XML"),
    "no robot": ("urdf", "<rabbit/>", "<rabbit>, and not a <robot>"),
    "xacro": ("urdf", '<robot xmlns:xacro="x"><xacro:a/></robot>', "xacro rig"),
    "entities": ("urdf", '<!DOCTYPE r [<!ENTITY a "b">]><robot/>', "defines entities"),
    "only wheels": ("urdf", robot(("continuous", "a", "b", "")), "holds no transform"),
    "no child": ("urdf", robot(("fixed", "a", "", "")), "the child of joint j0 is ''"),
    "two numbers": ("urdf", robot(("fixed", "a", "b", '<origin xyz="1 2"/>')), "xyz of b is [1.0, 2.0]"),
    "words": ("urdf", robot(("fixed", "a", "b", '<origin rpy="pi 0 0"/>')), "rpy of b is 'pi 0 0'"),
    "no yaw": ("autoware", "a: {b: {x: 0, y: 0, z: 0, roll: 0, pitch: 0}}\n", "b has no yaw"),
    "no table": ("autoware", "a: 3\n", "no table of frames"),
    "a string": ("autoware", KIT % "up", "z of velo is 'up'"),
    "no json": ("colmap", "[{", "is not JSON"),
    "constants": ("colmap", rig_json().replace("[0, 0, 1]", "[0, 0, NaN]"), "NaN is no number"),
    "two rigs": ("colmap", "[{}, {}]", "no list of one rig"),
    "two references": ("colmap", f'[{{"cameras": [{REFERENCE}, {REFERENCE}]}}]' % ("a", "b"), "2 reference cameras"),
    "short quaternion": ("colmap", rig_json(cam_from_rig_rotation=[1, 0, 0]), "a list of 4 numbers"),
    "twice": ("colmap", rig_json(image_prefix="a/"), "camera a twice"),
    "no frames": ("nerf", '{"frames": 3}', "frames is not a list of tables"),
    "no list of numbers": ("nerf", frames(transform_matrix=[[1]]), "transform_matrix of a is no list of four rows"),
    "mirrored": ("nerf", frames(np.diag([-1.0, 1, 1, 1])), "left-handed"),
    "enlarged": ("nerf", frames(np.diag([2.0, 2, 2, 1])), "transform_matrix of a is not a rotation"),
    "no metres": ("nerf", frames(applied_scale=0.1), "its lengths are not metres"),
    "one image twice": ("nerf", frames(frames=[FRAME, FRAME]), "the sensor a twice"),
    "no image": ("nerf", frames(file_path=7), "the sensor of a frame is 7"),
    "no such base": ("nerf", frames(base="b"), "its base b is not there"),
    "a base away": ("nerf", frames(base="a"), "its base a is not there, or not at the origin"),
    "one table": ("nuscenes", "[]", "names them, is missing"),
    "other titles": ("csv", "sensor,base,x,y,z\nvelo,velo,0,0,0\n", "must have the titles"),
    "open quote": ("csv", '"a\n', "no table of comma-separated values"),
    "empty": ("csv", "", "no table of comma-separated values"),
    "no base": ("yaml", "sensors: {}\n", "has no base"),
}  # fmt: skip
ENDINGS = {"urdf": "rig.urdf", "colmap": "rig.json", "nerf": "rig.json", "nuscenes": "rig.json", "csv": "rig.csv"}


@pytest.mark.parametrize(("format_id", "content", "sentence"), BAD.values(), ids=BAD)
def test_bad_files_are_refused_in_one_sentence(exporting, format_id, content, sentence):
    path = exporting.folder / ENDINGS.get(format_id, "rig.yaml")
    trap = exporting.folder / "trap"
    path.write_text(content.replace("touch %s", f"touch {trap}"))
    with pytest.raises(DataError, match=re.escape(sentence)) as refused:
        exporting.read(path, format_id)
    assert str(path) in str(refused.value)
    assert "\n" not in str(refused.value)
    assert not trap.exists()


@pytest.mark.parametrize(
    "format_id", [f for f in FORMATS if f not in ("kitti", "urdf", "colmap", "nerf", "nuscenes")]
)
def test_a_file_that_was_cut_short_is_refused(exporting, format_id):
    path = exporting.write(ordinary(format_id), format_id)
    text = path.read_text()
    for part in (0.5, 0.9, 0.999):
        path.write_text(text[: int(part * len(text))])
        with pytest.raises(DataError, match="is cut short"):
            exporting.read(path, format_id)


@pytest.mark.parametrize("format_id", FORMATS)
def test_what_is_no_text_is_refused(exporting, format_id):
    path = exporting.write(ordinary(format_id), format_id)
    for file in [path] if path.is_file() else [f for f in path.iterdir() if "calib" in f.name]:
        file.write_bytes(b"\xff\x00\xfe" * 100)
    with pytest.raises(DataError, match="can not be read as text"):
        exporting.read(path, format_id)


@pytest.mark.parametrize("format_id", [f for f in FORMATS if f != "kitti"])
def test_what_is_too_large_is_refused_unread(exporting, format_id):
    path = exporting.write(ordinary(format_id), format_id)
    with path.open("ab") as file:
        file.truncate(10**9)
    with pytest.raises(DataError, match="953 MB, which no calibration has"):
        exporting.read(path, format_id)


@pytest.mark.parametrize("format_id", FORMATS)
def test_what_is_missing_or_a_folder_is_refused(exporting, format_id):
    with pytest.raises(DataError):
        exporting.read(exporting.folder / "none", format_id)
    with pytest.raises(DataError):
        exporting.read(exporting.folder, format_id)


@pytest.mark.parametrize(
    ("file", "change", "sentence"),
    [
        ("calib_velo_to_cam.txt", ("R:", "Q:"), "R is None"),
        ("calib_velo_to_cam.txt", ("R:", "R: 1"), "a list of 9 numbers"),
        ("calib_velo_to_cam.txt", ("R:", "T:"), "has T twice"),
        ("calib_velo_to_cam.txt", ("R:", "R"), "no line 'key: values'"),
        ("calib_imu_to_velo.txt", ("T: ", "T: nan "), "a list of 3 numbers"),
        ("calib_cam_to_cam.txt", ("T_00: 0.0", "T_00: 1.0"), "R_00 and T_00 are not identity"),
        ("calib_cam_to_cam.txt", ("end: end of file\n", ""), "is cut short"),
    ],
)
def test_damaged_kitti_files(exporting, file, change, sentence):
    folder = exporting.write(ordinary("kitti"), "kitti")
    content = (folder / file).read_text()
    assert change[0] in content
    (folder / file).write_text(content.replace(*change))
    with pytest.raises(DataError, match=sentence):
        exporting.read(folder, "kitti")


def test_kitti_needs_what_ties_its_sensors(exporting):
    folder = exporting.write(ordinary("kitti"), "kitti")
    (folder / "calib_velo_to_cam.txt").unlink()
    with pytest.raises(DataError, match="nothing ties the cameras to velo"):
        exporting.read(folder, "kitti")


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (("base: velo", "base: lidar"), "has the clocks of lidar, ins"),
        (("  ins:", "  imu:"), "has the clocks of velo, imu"),
        (("t_ref: 0.0", "t_ref: soon"), "t_ref is 'soon'"),
        (("dt: ", "delay: "), "has no dt"),
        (("base: velo\n", ""), "has no base"),
        (("# end of file", ""), "is cut short"),
    ],
)
def test_side_files_that_do_not_fit_are_refused(exporting, change, sentence):
    path = exporting.write(ordinary("urdf"), "urdf")
    clocks = path.with_name("rig.urdf.clocks.yaml")
    content = clocks.read_text()
    assert change[0] in content
    clocks.write_text(content.replace(*change))
    with pytest.raises(DataError, match=sentence):
        exporting.read(path, "urdf")


def test_kalibr_refuses_two_tales_of_one_clock(exporting):
    path = exporting.write(ordinary("kalibr"), "kalibr")
    path.write_text(re.sub(r"(timeshift_cam_imu: )\S*", r"\g<1>0.5", path.read_text()))
    with pytest.raises(DataError, match="tell different clock offsets"):
        exporting.read(path, "kalibr")


def test_nuscenes_with_a_pose_for_each_log_is_refused(exporting):
    path = exporting.write(ordinary("nuscenes"), "nuscenes")
    rows = json.loads(path.read_text())
    path.write_text(json.dumps([*rows, {**rows[1], "translation": [0, 0, 9]}]))
    with pytest.raises(DataError, match="several poses of ins"):
        exporting.read(path, "nuscenes")
    path.write_text(json.dumps([*rows, rows[1]]))
    assert len(exporting.read(path, "nuscenes").names) == 4
    path.write_text(json.dumps([*rows, {**rows[1], "sensor_token": "other"}]))
    with pytest.raises(DataError, match="does not name"):
        exporting.read(path, "nuscenes")


@pytest.mark.parametrize(
    ("where", "value", "sentence"),
    [
        (("sensors", "velo", "translation", 0), 1.0, "velo are not zero"),
        (("sensors", "ins", "quaternion_xyzw", 0), 2.0, "not 1"),
        (("sensors", "ins", "translation"), [1.0], "no list of 3 numbers"),
        (("sensors", "ins", "sigma"), {"x": 1.0}, "without its sigma"),
        (("sensors", "ins", "sigma"), 3, "sigma of ins is no table"),
        (("sensors", "ins", "has_scale"), "maybe", "neither true nor false"),
        (("base",), "lidar", "its base lidar"),
        (("sensors",), [], "no table of sensors"),
    ],
)
def test_plain_files_that_contradict_themselves(exporting, where, value, sentence):
    path = exporting.write(ordinary("yaml"), "yaml")
    content = yaml.safe_load(path.read_text())
    place = content
    for key in where[:-1]:
        place = place[key]
    place[where[-1]] = value
    path.write_text(yaml.safe_dump(content))
    with pytest.raises(DataError, match=sentence):
        exporting.read(path, "yaml")


def test_a_table_that_lost_a_row_is_refused(exporting):
    path = exporting.write(ordinary("csv"), "csv")
    path.write_text(re.sub(r"^ins,.*\n", "", path.read_text(), flags=re.MULTILINE))
    with pytest.raises(DataError, match="has 3 rows, but its last line says 4 sensors"):
        exporting.read(path, "csv")


def test_names_that_can_not_be_printed_are_refused(exporting):
    for name in ("", " velo", "a\nb", "a\x00", "\ud800"):
        with pytest.raises(DataError, match="rename it in the calibration"):
            exporting.write(make_rig(("velo", name), np.ones((1, 6))), "yaml")
