"""The worked point of docs/exports.md: its numbers are what exporters write, and do what the page says."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from exported_rigs import FORMATS, make_rig
from scipy.spatial.transform import Rotation

from calib_toolkit import se3

PAGE = (Path(__file__).parents[2] / "docs/exports.md").read_text()
R_VELO_CAM0 = [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]
POINT_CAM0, POINT_VELO = np.array([0, 0, 4.0]), np.array([4.5, 0.1, -0.2])


def row(format_id):
    """The numbers of a format by key, in the second table of the page."""
    section = PAGE.split("## A point in each")[1]
    line = re.search(rf"^\| `{format_id}` \| `(.*?)` \|", section, re.MULTILINE)[1]
    found, key = {}, ""
    for word in re.findall(r"[^\s,/]+", line):
        if re.match(r"[A-Za-z]", word):
            key = word
            found[key] = []
        else:
            found[key].append(float(word))
    return found


def rig():
    made = make_rig(("velo", "cam0"), np.zeros((1, 6)), [-0.03])
    made.T_base_sensor[1] = se3.rigid(R_VELO_CAM0, [0.5, 0.1, -0.2])
    return made


def numbers(text):
    return [float(x) for x in re.findall(r"-?\d+\.\d+(?:e-?\d+)?", text)]


def test_the_rig_of_the_page_is_as_it_says():
    assert np.allclose((rig().T_base_sensor[1] @ [*POINT_CAM0, 1])[:3], POINT_VELO)
    assert "(0, 0, 4) in its optical frame, is at (4.5, 0.1, -0.2) in velo" in PAGE
    assert abs(100.030 + rig().dt_base_sensor[1] - 100.000) < 1e-12


@pytest.mark.parametrize("format_id", ["ros2", "nuscenes", "yaml", "csv", "urdf"])
def test_a_pose_in_the_base_maps_the_point_to_velo(format_id):
    said = row(format_id)
    if format_id == "urdf":
        t, R = said["xyz"], Rotation.from_euler("xyz", said["rpy"])
    elif format_id == "csv":
        t, R = [said[k][0] for k in "xyz"], Rotation.from_quat([said[f"q{k}"][0] for k in "xyzw"])
    else:
        t, q = said["translation"], said.get("rotation") or said["quaternion_xyzw"]
        R = Rotation.from_quat([*q[1:], q[0]] if format_id == "nuscenes" else q)
    assert np.allclose(R.apply(POINT_CAM0) + t, POINT_VELO)


def test_poses_the_other_way_map_the_point_to_the_camera():
    T = np.reshape(row("kalibr")["T_cam_imu"], (4, 4))
    assert np.allclose(T @ [*POINT_VELO, 1], [*POINT_CAM0, 1])
    assert row("kalibr")["timeshift_cam_imu"] == [-0.03]
    said = row("kitti")
    assert np.allclose(np.reshape(said["R"], (3, 3)) @ POINT_VELO + said["T"], POINT_CAM0)


def test_the_camera_of_a_nerf_looks_along_minus_z():
    T = np.reshape(row("nerf")["transform_matrix"], (4, 4))
    assert np.allclose(T @ [0, 0, -4, 1], [*POINT_VELO, 1])
    assert "maps (0, 0, -4), where y is up and z backward, to (4.5, 0.1, -0.2)" in PAGE


def test_the_body_of_the_camera_in_autoware_looks_along_x():
    said = row("autoware")
    R = Rotation.from_euler("xyz", [said[k][0] for k in ("roll", "pitch", "yaw")])
    assert np.allclose(R.apply([4, 0, 0]) + [said[k][0] for k in "xyz"], POINT_VELO)


@pytest.mark.parametrize("format_id", [f for f in FORMATS if f != "colmap"])
def test_exporters_write_the_numbers_of_the_page(exporting, format_id):
    path = exporting.write(rig(), format_id)
    text = (path / "calib_velo_to_cam.txt" if path.is_dir() else path).read_text()
    text = "\n".join(line for line in text.splitlines() if not re.match(r"\s*(#|<!--|convention)", line))
    for key, values in row(format_id).items():
        if format_id != "csv":
            *_, place = re.finditer(rf'\b{key}"?[:=]', text)
            found = numbers(text[place.start() :])[: len(values)]
        else:
            titles, _, cells = (line.split(",") for line in text.strip().splitlines())
            found = [float(cells[titles.index(key)])]
        assert np.allclose(found, values, atol=1e-12), key


def test_colmap_writes_the_numbers_of_the_page(exporting):
    made = make_rig(("cam0", "cam1"), [[0.5, 0, 0, 0, 0, 0]])
    said = re.search(r"`cam_from_rig_rotation ([^`,]*), cam_from_rig_translation ([^`]*)`", PAGE)
    q, t = ([float(x) for x in part.split()] for part in said.groups())
    (config,) = json.loads(exporting.write(made, "colmap").read_text())
    assert np.allclose(config["cameras"][1]["cam_from_rig_rotation"], q)
    assert np.allclose(config["cameras"][1]["cam_from_rig_translation"], t)
    assert np.allclose(Rotation.from_quat([*q[1:], q[0]]).apply(POINT_CAM0) + t, [-0.5, 0, 4])


def test_the_table_names_every_installed_format(installed):
    table = PAGE.split("## The formats")[1].split("## A point")[0]
    assert set(re.findall(r"^\| `(\w+)` \|", table, re.MULTILINE)) == set(installed.exporters)
