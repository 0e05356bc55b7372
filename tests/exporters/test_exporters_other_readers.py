"""What others read in the files: libraries that are not ours, or each format's documentation to the letter."""

import csv
import json
import shlex
from xml.etree import ElementTree

import numpy as np
import pykitti
import pytest
import yaml
from exported_rigs import make_rig, ordinary
from pytransform3d.transformations import transform_from_pq
from pytransform3d.urdf import UrdfTransformManager
from scipy.spatial.transform import RigidTransform, Rotation

from calib_toolkit import CameraIntrinsics, se3

WITHIN = {"rtol": 0, "atol": 1e-9}


def test_urdf_as_pytransform3d_reads_it(exporting):
    rig = ordinary("urdf")
    manager = UrdfTransformManager()
    manager.load_urdf(exporting.write(rig, "urdf").read_text())
    for a in rig.names:
        for b in rig.names:
            assert np.allclose(manager.get_transform(b, a), rig.between(a, b).T_a_b, **WITHIN)


@pytest.mark.parametrize("pitch", [np.pi / 2, -np.pi / 2, np.pi / 2 - 1e-9])
def test_urdf_where_roll_and_yaw_are_one(exporting, pitch):
    rig = make_rig(("velo", "cam0"), [[1, 2, 3, 0, 0, 0]])
    R = Rotation.from_euler("xyz", [0.3, pitch, -0.8]).as_matrix()
    rig.T_base_sensor[1, :3, :3] = R
    manager = UrdfTransformManager()
    manager.load_urdf(exporting.write(rig, "urdf").read_text())
    assert np.allclose(manager.get_transform("cam0", "velo")[:3, :3], R, **WITHIN)


def test_kalibr_as_its_documentation_has_it(exporting):
    """T_cam_imu takes IMU coordinates to the camera, T_cn_cnm1 those of the camera before; t_imu = t_cam + shift."""
    rig = ordinary("kalibr")
    with exporting.write(rig, "kalibr").open() as file:
        chain = yaml.safe_load(file)
    assert list(chain) == ["cam0", "cam1", "cam2"]  # Kalibr counts the keys
    for k in range(3):
        cam = chain[f"cam{k}"]
        assert np.allclose(cam["T_cam_imu"], rig.between(f"cam{k}", "ins").T_a_b, **WITHIN)
        assert isinstance(cam["timeshift_cam_imu"], float)
        assert abs(cam["timeshift_cam_imu"] - rig.dt_between("ins", f"cam{k}")[0]) < 1e-12
        if k:
            before = np.array(chain[f"cam{k - 1}"]["T_cam_imu"])
            assert np.allclose(np.array(cam["T_cn_cnm1"]) @ before, cam["T_cam_imu"], **WITHIN)
    assert "T_cn_cnm1" not in chain["cam0"]


def test_kitti_as_pykitti_loads_it(exporting, tmp_path):
    """Four parallel cameras beside each other, which is what pykitti takes cameras for, and any lidar and INS."""
    rng = np.random.default_rng(2)
    T_velo_cam0 = se3.matrix(rng.normal(size=6))
    shift = np.stack([se3.matrix([x, 0, 0, 0, 0, 0]) for x in (0.0, 0.54, -0.06, 0.47)])
    names = ("velo", "ins", "cam0", "cam1", "cam2", "cam3")
    rig = make_rig(names, np.concatenate([rng.normal(size=(1, 6)), se3.vector(T_velo_cam0 @ shift)]))
    K = np.array([[721.5, 0, 609.6], [0, 721.5, 172.9], [0, 0, 1]])
    intrinsics = {f"cam{k}": CameraIntrinsics(K, size=(1242, 375)) for k in range(4)}
    exporting.write(rig, "kitti", "2011_10_03", intrinsics)
    oxts = tmp_path / "2011_10_03/2011_10_03_drive_0027_sync/oxts"
    oxts.mkdir(parents=True)
    (oxts / "timestamps.txt").touch()  # without which the loader does not get to the calibration
    calib = pykitti.raw(str(tmp_path), "2011_10_03", "0027").calib
    assert np.allclose(calib.T_velo_imu, rig.between("velo", "ins").T_a_b, **WITHIN)
    for k in range(4):
        T = getattr(calib, f"T_cam{k}_velo")
        assert np.allclose(T, rig.between(f"cam{k}", "velo").T_a_b, **WITHIN)
        assert np.allclose(getattr(calib, f"K_cam{k}"), K)


def test_kitti_projects_a_point_of_any_camera_as_its_development_kit_does(exporting, camera):
    """P_rect R_rect_00 T_cam0_velo X, against turning the point into the camera and then by R_rect."""
    rig = ordinary("kitti")
    folder = exporting.write(rig, "kitti", intrinsics={"cam0": camera, "cam1": camera})
    velo, cams = (pykitti.utils.read_calib_file(folder / f"calib_{n}.txt") for n in ("velo_to_cam", "cam_to_cam"))
    point = np.array([4.0, -1.0, 0.7, 1.0])
    T_cam0_velo = pykitti.utils.transform_from_rot_trans(velo["R"], velo["T"])
    seen = cams["P_rect_01"].reshape(3, 4) @ (T_cam0_velo @ point)
    in_cam1 = cams["R_rect_01"].reshape(3, 3) @ (rig.between("cam1", "velo").T_a_b @ point)[:3]
    assert np.allclose(seen, camera.K @ in_cam1)
    assert np.allclose(
        cams["R_01"].reshape(3, 3) @ np.ones(3) + cams["T_01"], (rig.between("cam1", "cam0").T_a_b @ np.ones(4))[:3]
    )


def test_ros_as_tf_has_it(exporting):
    """A transform takes points of the child to the parent; the launch file says the same as the YAML."""
    rig = ordinary("ros2")
    path = exporting.write(rig, "ros2")
    messages = yaml.safe_load(path.read_text())["transforms"]
    assert {m["child_frame_id"] for m in messages} == {"ins", "cam0", "cam1"}
    for m in messages:
        t, q = m["transform"]["translation"], m["transform"]["rotation"]
        T = transform_from_pq([t["x"], t["y"], t["z"], q["w"], q["x"], q["y"], q["z"]])
        assert np.allclose(T, rig.between(m["header"]["frame_id"], m["child_frame_id"]).T_a_b, **WITHIN)
    nodes = ElementTree.fromstring(path.with_suffix(".launch.xml").read_text()).findall("node")
    assert len(nodes) == 3
    for node in nodes:
        assert (node.get("pkg"), node.get("exec")) == ("tf2_ros", "static_transform_publisher")
        words = shlex.split(node.get("args"))
        args = dict(zip(words[::2], words[1::2], strict=True))
        T = transform_from_pq([float(args[f"--{k}"]) for k in ("x", "y", "z", "qw", "qx", "qy", "qz")])
        assert np.allclose(T, rig.between(args["--frame-id"], args["--child-frame-id"]).T_a_b, **WITHIN)


def test_nuscenes_as_its_devkit_uses_it(exporting, camera):
    """Points of a sensor: rotate by the quaternion (w x y z), then add the translation; that is the ego frame."""
    rig = ordinary("nuscenes")
    path = exporting.write(rig, "nuscenes", "calibrated_sensor", {"cam0": camera})
    channels = {s["token"]: s for s in json.loads(path.with_name("sensor.json").read_text())}
    rows = json.loads(path.read_text())
    assert len({r["token"] for r in rows}) == len(rows) == 4
    point = np.array([1.0, 2.0, 3.0])
    for row in rows:
        sensor = channels[row["sensor_token"]]
        w, x, y, z = row["rotation"]
        there = Rotation.from_quat([x, y, z, w]).apply(point) + row["translation"]
        assert np.allclose(there, (rig.between("velo", sensor["channel"]).T_a_b @ [*point, 1])[:3], **WITHIN)
        assert (sensor["modality"] == "camera") == sensor["channel"].startswith("cam")
    (matrix,) = [r["camera_intrinsic"] for r in rows if channels[r["sensor_token"]]["channel"] == "cam0"]
    assert np.array_equal(matrix, camera.K)


def test_colmap_as_its_documentation_has_it(exporting):
    """x_cam = cam_from_rig x_rig, the rig's frame being the reference camera's; a pixel's centre is at 0.5."""
    rig = ordinary("colmap")
    lens = CameraIntrinsics(
        np.array([[700.0, 0, 319.5], [0, 710, 239.5], [0, 0, 1]]), np.array([0.1, 0.2, 0.01, 0.02])
    )
    (config,) = json.loads(exporting.write(rig, "colmap", intrinsics={"cam1": lens}).read_text())
    first, *others = config["cameras"]
    assert first == {"image_prefix": "cam0/", "ref_sensor": True}
    for camera in others:
        w, x, y, z = camera["cam_from_rig_rotation"]
        T = RigidTransform.from_components(camera["cam_from_rig_translation"], Rotation.from_quat([x, y, z, w]))
        name = camera["image_prefix"].rstrip("/")
        assert np.allclose(T.as_matrix(), rig.between(name, "cam0").T_a_b, **WITHIN)
    assert others[0]["camera_model_name"] == "OPENCV"
    assert others[0]["camera_params"] == [700.0, 710.0, 320.0, 240.0, 0.1, 0.2, 0.01, 0.02]


def test_nerf_as_rays_are_cast_through_it(exporting):
    """A pixel's ray is ((u - cx) / fl_x, -(v - cy) / fl_y, -1) turned by transform_matrix, from its last column."""
    rig = ordinary("nerf")
    lens = CameraIntrinsics(np.array([[700.0, 0, 319.5], [0, 710, 239.5], [0, 0, 1]]), np.array([0.1]), (640, 480))
    content = json.loads(exporting.write(rig, "nerf", intrinsics={"cam0": lens, "cam1": lens}).read_text())
    assert content["camera_model"] == "OPENCV"
    assert [f["file_path"] for f in content["frames"]] == ["cam0.png", "cam1.png"]
    for frame in content["frames"]:
        name, T = frame["sensor"], np.array(frame["transform_matrix"])
        assert [frame[k] for k in ("fl_x", "fl_y", "cx", "cy", "w", "h")] == [700, 710, 320, 240, 640, 480]
        assert [frame[k] for k in ("k1", "k2", "p1", "p2")] == [0.1, 0, 0, 0]
        u, v = 100.0, 50.0  # OpenCV's, whose first pixel is centred at 0
        ray = T[:3, :3] @ [(u + 0.5 - frame["cx"]) / frame["fl_x"], -(v + 0.5 - frame["cy"]) / frame["fl_y"], -1.0]
        point = [*(T[:3, 3] + 7.0 * ray), 1.0]
        seen = lens.K @ (rig.between(name, "velo").T_a_b @ point)[:3]
        assert np.allclose(seen, 7.0 * np.array([u, v, 1.0]))
        assert "k3" not in frame
    (velo, ins) = content["other_sensors"]
    assert np.allclose(ins["T_base_sensor"], rig.between("velo", "ins").T_a_b, **WITHIN)
    assert np.array_equal(velo["T_base_sensor"], np.eye(4))


def test_a_nerf_says_who_does_not_read_its_last_coefficient(exporting):
    lens = CameraIntrinsics(np.diag([700.0, 700, 1]), np.array([0.1, 0.2, 0.01, 0.02, 0.3]))
    content = json.loads(exporting.write(ordinary("nerf"), "nerf", intrinsics={"cam1": lens}).read_text())
    assert [content["frames"][1][k] for k in ("k1", "k2", "p1", "p2", "k3")] == [0.1, 0.2, 0.01, 0.02, 0.3]
    assert "instant-ngp does not read k3" in content["comment"]


def test_a_nerf_of_another_program(exporting, tmp_path):
    """Frames by their images, in a world that no sensor is in."""
    flip = np.diag([1.0, -1, -1, 1])
    T = se3.matrix(np.random.default_rng(8).normal(size=(2, 6)))
    images = ("images/left.jpg", "./images/right.jpg")
    frames = [
        {"file_path": f, "transform_matrix": (t @ flip).round(8).tolist()} for f, t in zip(images, T, strict=True)
    ]
    (tmp_path / "transforms.json").write_text(json.dumps({"fl_x": 700, "frames": frames, "applied_scale": 1}))
    rig = exporting.read(tmp_path / "transforms.json", "nerf")
    assert rig.names == ("world", "images/left", "images/right")
    assert not rig.has_scale[1:].any()
    assert np.allclose(rig.between("images/left", "images/right").T_a_b, np.linalg.inv(T[0]) @ T[1], atol=1e-6)


def test_autoware_as_its_description_puts_frames_together(exporting):
    """base to body by xyz and rpy about fixed axes, body to optical frame by rpy = -pi/2 0 -pi/2."""
    rig = ordinary("autoware")
    kit = yaml.safe_load(exporting.write(rig, "autoware").read_text())["sensor_kit_base_link"]
    assert list(kit) == ["velo", "ins", "cam0/camera_link", "cam1/camera_link"]
    assert set(kit["velo"].values()) == {0.0}
    for key, v in kit.items():
        R = Rotation.from_euler("xyz", [v["roll"], v["pitch"], v["yaw"]]).as_matrix()
        T = se3.rigid(R, [v["x"], v["y"], v["z"]])
        name = key.removesuffix("/camera_link")
        if name != key:
            T = T @ se3.rigid(Rotation.from_euler("xyz", [-np.pi / 2, 0, -np.pi / 2]).as_matrix(), [0, 0, 0])
        assert np.allclose(T, rig.between("velo", name).T_a_b, **WITHIN)


def test_a_camera_that_looks_ahead_is_upright_in_autoware(exporting):
    rig = make_rig(("velo", "cam0"), np.zeros((1, 6)))
    rig.T_base_sensor[1, :3, :3] = [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]  # its x is right, y down, z ahead
    kit = yaml.safe_load(exporting.write(rig, "autoware").read_text())["sensor_kit_base_link"]
    assert np.allclose(list(kit["cam0/camera_link"].values()), 0.0)


@pytest.mark.parametrize("format_id", ["yaml", "csv"])
def test_plain_formats_as_the_comment_says(exporting, format_id):
    rig = ordinary(format_id)
    path = exporting.write(rig, format_id)
    if format_id == "yaml":
        sensors = yaml.safe_load(path.read_text())["sensors"]
        found = {n: (*s["translation"], *s["quaternion_xyzw"], s["dt"]) for n, s in sensors.items()}
    else:
        rows = csv.DictReader(line for line in path.read_text().splitlines() if not line.startswith("#"))
        keys = ("x", "y", "z", "qx", "qy", "qz", "qw", "dt")
        found = {row["sensor"]: [float(row[k]) for k in keys] for row in rows}
    for name, (*t, x, y, z, w, dt) in found.items():
        assert np.allclose(transform_from_pq([*t, w, x, y, z]), rig.between("velo", name).T_a_b, **WITHIN)
        assert abs(dt - rig.dt_between("velo", name)[0]) < 1e-12
    assert len(found) == 4


def test_side_files_are_plain_yaml(exporting):
    rig = ordinary("urdf")
    path = exporting.write(rig, "urdf")
    clocks = yaml.safe_load(path.with_name("rig.urdf.clocks.yaml").read_text())
    assert clocks["base"] == "velo"
    assert all(abs(s["dt"] - rig.dt_between("velo", n)[0]) < 1e-12 for n, s in clocks["sensors"].items())


def test_files_of_other_programs(exporting, tmp_path):
    """As others write them: six digits, other keys between, frames on frames, OpenCV's first line."""
    (tmp_path / "a.yaml").write_text(
        "%YAML:1.0\ncam0:\n  T_imu_cam: [[0, 0, 1, 0.1], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]]\n"
        "  cam_overlaps: [1]\n  timeshift_cam_imu: 1e-3\ncam1:\n  rostopic: /b\n"
        "  T_cn_cnm1: [[1, 0, 0, -0.5], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]\n"
    )
    chain = exporting.read(tmp_path / "a.yaml", "kalibr")
    assert chain.base == "imu0"
    assert np.allclose(chain.between("imu0", "cam1").T_a_b[:3, 3], [0.1, -0.5, 0])
    assert chain.dt_between("imu0", "cam0")[0] == 1e-3
    assert chain.determined[:, 6].tolist() == [True, True, False]
    (tmp_path / "b.yaml").write_text(
        "transforms:\n- header: {frame_id: base_link}\n  child_frame_id: kit\n  transform:\n"
        "    translation: {x: 0, y: 0, z: 2}\n    rotation: {x: 0, y: 0, z: 0.707107, w: 0.707107}\n---\n"
        "transforms:\n- header: {frame_id: kit}\n  child_frame_id: velo\n  transform:\n"
        "    translation: {x: 1, y: 0, z: 0}\n    rotation: {x: 0, y: 0, z: 0, w: 1}\n---\n"
    )
    tree = exporting.read(tmp_path / "b.yaml", "ros2")
    assert np.allclose(tree.between("base_link", "velo").T_a_b[:3, 3], [0, 1, 2], atol=1e-5)
    (tmp_path / "c.urdf").write_text(
        '<robot name="car"><link name="base"/><link name="wheel"/><link name="cap"/><link name="lidar"/>'
        '<joint name="a" type="continuous"><parent link="base"/><child link="wheel"/></joint>'
        '<joint name="b" type="fixed"><parent link="wheel"/><child link="cap"/></joint>'
        '<joint name="c" type="fixed"><parent link="base"/><child link="lidar"/><origin xyz="1 2 3"/></joint></robot>'
    )
    car = exporting.read(tmp_path / "c.urdf", "urdf")
    assert car.names == ("base", "lidar")
    assert car.between("base", "lidar").T_a_b[:3, 3].tolist() == [1, 2, 3]
