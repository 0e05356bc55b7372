"""Overlays and coloured clouds of a scene: a red board before a blue wall, as a lidar and a camera see it."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from calib_toolkit import CameraIntrinsics, DataError, Motions, Pair, Scan, Stream, Transform, se3
from calib_toolkit_plugins.metrics import clouds, pictures

Array = NDArray[np.float64]

WIDTH, HEIGHT, FOCAL = 320, 160, 160.0
K = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])
BOARD, WALL = 8.0, 20.0
SIZE = np.array([1.5, 1.0])
"""Half the board's width and height."""
SPEED = 2.0
R_LIDAR_CAMERA = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
T_LIDAR_CAMERA = se3.rigid(R_LIDAR_CAMERA, [0.2, 0.1, -0.1])
TURNED = se3.rigid(se3.exp_so3([0, 0, np.radians(2)]) @ R_LIDAR_CAMERA, [0.2, 0.2, -0.1])
RED, BLUE = (200, 40, 30), (20, 60, 180)


def seen(rays: Array, origin: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Where rays (n, 3) from a place in the world end, and which end on the board."""
    board = origin + rays * ((BOARD - origin[0]) / rays[:, :1])
    hit = np.all(np.abs(board[:, 1:]) < SIZE, axis=1)
    return np.where(hit[:, None], board, origin + rays * ((WALL - origin[0]) / rays[:, :1])), hit


def scan(place: Array) -> Scan:
    azimuth, elevation = np.meshgrid(np.radians(np.arange(-50, 50, 0.4)), np.radians(np.arange(-20, 20, 0.8)))
    a, e = azimuth.ravel(), elevation.ravel()
    points, hit = seen(np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], 1), place)
    return Scan((points - place).astype(np.float32), intensity=np.where(hit, 0.9, 0.1).astype(np.float32))


def image(place: Array) -> NDArray[np.uint8]:
    u, v = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    rays = np.stack([(u - K[0, 2]) / FOCAL, (v - K[1, 2]) / FOCAL, np.ones(u.shape)], -1).reshape(-1, 3)
    _, hit = seen(rays @ R_LIDAR_CAMERA.T, place + T_LIDAR_CAMERA[:3, 3])
    return np.where(hit[:, None], RED[::-1], BLUE[::-1]).astype(np.uint8).reshape(HEIGHT, WIDTH, 3)


@pytest.fixture(scope="module")
def pair() -> Pair:
    """Two moments, a second apart, of a drive towards the board."""
    stamps = np.array([0.0, 1.0])
    places = [np.array([SPEED * t, 0.0, 0.0]) for t in stamps]
    vec = np.tile([SPEED * 0.5, 0, 0, 0, 0, 0], (6, 1))
    start = np.arange(-1.0, 2.0, 0.5)
    motion = Motions(start, start + 0.5, vec, np.tile(1e-6 * np.eye(6), (6, 1, 1)))
    lidar = Stream("roof", "velodyne", stamps, [scan(p) for p in places])
    camera = Stream("front", "monocular", stamps, [image(p) for p in places], CameraIntrinsics(K), has_scale=False)
    prior = Transform("roof", "front", TURNED, np.diag(np.repeat([0.1, 0.02], 3) ** 2))
    return Pair(lidar, camera, motion, motion, 0.0, np.array([[0, 0], [1, 1]]), prior)


def outline(depth: float) -> Array:
    """The board's left, top, right and bottom in the image, pixels; depth: from the camera's place."""
    x, y, _ = T_LIDAR_CAMERA[[1, 2, 0], 3]
    left, right = (K[0, 2] - FOCAL * (s * SIZE[0] - x) / depth for s in (1, -1))
    top, bottom = (K[1, 2] - FOCAL * (s * SIZE[1] - y) / depth for s in (1, -1))
    return np.array([left, top, right, bottom])


def test_outlines_are_drawn_where_the_image_has_them(pair: Pair) -> None:
    moment = pictures.laid(pair, 0)
    assert moment is not None
    uv, shown = pictures.visible_edges(moment, T_LIDAR_CAMERA)
    assert np.all(moment.points[0][shown, 0] < WALL - 1)  # the board before the wall, not the wall beside it
    spacing = FOCAL * np.radians(0.8)
    expected = outline(BOARD - T_LIDAR_CAMERA[0, 3])
    found = np.concatenate([uv.min(axis=0), uv.max(axis=0)])
    inside = (found - expected) * [1, 1, -1, -1]
    assert np.all(inside > -0.5)
    assert np.all(inside < spacing + 0.5)
    beside = np.minimum(*(np.abs(uv - expected[k : k + 2]) for k in (0, 2))).min(axis=1)
    assert beside.max() < 2 * spacing + 0.5  # nothing in the middle of the board


def test_a_turned_pose_draws_them_beside(pair: Pair) -> None:
    moment = pictures.laid(pair, 0)
    assert moment is not None
    right, shown = pictures.visible_edges(moment, T_LIDAR_CAMERA)
    turned, same = pictures.visible_edges(moment, TURNED)
    assert np.array_equal(shown, same)
    by_turn, by_shift = FOCAL * np.radians(2), FOCAL * 0.1 / BOARD
    assert np.mean(turned - right, axis=0) == pytest.approx([by_turn + by_shift, 0], abs=1)


def test_what_is_behind_the_board_is_not_drawn(pair: Pair) -> None:
    moment = pictures.laid(pair, 0)
    assert moment is not None
    aside = T_LIDAR_CAMERA.copy()
    aside[1, 3] += 1.5  # from there the board hides a part of the wall that the lidar sees
    uv, shown = pictures.visible(moment, aside)
    everything = np.isfinite(moment.pixels(aside[None])[0, 0]).sum()
    assert len(shown) < everything
    on_wall = moment.points[0][shown, 0] > WALL - 1
    board = moment.pixels(aside[None])[0].T[moment.points[0][:, 0] < WALL - 1]
    deep = np.all((uv > board.min(axis=0) + 5) & (uv < board.max(axis=0) - 5), axis=1)
    assert deep.any()
    assert not np.any(on_wall & deep)


def test_points_move_with_the_lidar_to_the_image(pair: Pair) -> None:
    """An image half a second after its scan shows the board nearer by the way driven."""
    late = replace(pair, dt_a_b=0.4)
    moments = [pictures.laid(p, 0) for p in (pair, late)]
    now, then = (m.points[0].mean(axis=0) for m in moments if m is not None)
    assert now - then == pytest.approx([SPEED * 0.4, 0, 0], abs=1e-4)


def test_a_picture_of_each_moment(pair: Pair, tmp_path: Path) -> None:
    import cv2

    files = pictures.overlay(pair, {"before": TURNED, "after": T_LIDAR_CAMERA}, tmp_path / "overlay")
    assert [f.name for f in files] == ["roof-front-0.png", "roof-front-1.png"]
    for file in files:
        drawn = cv2.imread(str(file))
        assert drawn.shape[1] == pictures.WIDTH
        colourful = np.ptp(drawn.astype(int), axis=2) > 60
        assert 0.01 < colourful.mean() < 0.5
        assert file.stat().st_size < 2_000_000


@pytest.mark.parametrize("hidden", ["intensity", "view", "motion"])
def test_it_draws_what_there_is(pair: Pair, tmp_path: Path, hidden: str) -> None:
    """A lidar without intensity, a pose that looks the other way, a pose whose position is not known."""
    scans = [replace(s, intensity=None) if hidden == "intensity" else s for s in pair.a.readings]
    T = T_LIDAR_CAMERA.copy()
    if hidden == "view":
        T = T @ se3.matrix([0, 0, 0, 0, np.pi, 0])
    if hidden == "motion":
        T[:3, 3] = np.nan
    one = replace(pair, a=replace(pair.a, readings=scans))[:1]
    assert len(pictures.overlay(one, {"motion alone": T, "refined": T_LIDAR_CAMERA}, tmp_path)) == 1


def test_the_part_enlarged_is_where_poses_differ(pair: Pair) -> None:
    moment = pictures.laid(pair, 0)
    assert moment is not None
    left, top, width, height = pictures.telling_part(moment, TURNED, T_LIDAR_CAMERA)
    uv, _ = pictures.visible_edges(moment, T_LIDAR_CAMERA)
    inside = np.all((uv >= [left, top]) & (uv < [left + width, top + height]), axis=1)
    assert inside.mean() > 0.5
    assert left + width <= WIDTH
    assert top + height <= HEIGHT


def test_the_difference_in_words() -> None:
    said = pictures.differences({"before": TURNED, "after": T_LIDAR_CAMERA})
    assert said == "; after is 10.0 cm and 2.00° from before"
    assert pictures.differences({"published": TURNED}) == ""


def test_a_cloud_has_the_colours_of_what_it_shows(pair: Pair, tmp_path: Path) -> None:
    import open3d as o3d

    file = tmp_path / "cloud" / "roof-front.ply"
    clouds.coloured_cloud(pair, T_LIDAR_CAMERA, file)
    assert b"binary_little_endian" in file.read_bytes()[:200]
    cloud = o3d.t.io.read_point_cloud(str(file))
    points, colours = cloud.point.positions.numpy(), cloud.point.colors.numpy()
    # both scans lie on the same board and wall, in the lidar's frame at the first image
    on_board = np.abs(points[:, 0] - BOARD) < 0.01
    assert np.all(on_board | (np.abs(points[:, 0] - WALL) < 0.01))
    assert np.mean(np.all(colours[on_board] == RED, axis=1)) > 0.97
    assert np.mean(np.all(colours[~on_board] == BLUE, axis=1)) > 0.97


def test_a_cloud_is_of_scans_that_follow_each_other(pair: Pair) -> None:
    stamps = np.arange(0.0, 10.0, 0.1)
    lidar = replace(pair.a, stamps=stamps, readings=stamps)
    camera = replace(pair.b, stamps=stamps[::2] - 0.2, readings=stamps[::2])
    rows = np.array([[5, 2], [50, 25], [95, 47]])
    drive = replace(pair, a=lidar, b=camera, dt_a_b=0.2, selected=rows)
    close = clouds.consecutive(drive)
    assert close.selected[:, 0].tolist() == list(range(40, 60))
    assert np.abs(close.selected[:, 1] - close.selected[:, 0] / 2).max() <= 0.5
    assert clouds.consecutive(drive[2:]).selected[-1, 0] == 99
    assert clouds.consecutive(pair).selected.tolist() == [[0, 0], [1, 1]]


def test_a_recording(pair: Pair, tmp_path: Path) -> None:
    pytest.importorskip("rerun")
    file = tmp_path / "roof-front.rrd"
    clouds.recording(pair, T_LIDAR_CAMERA, file)
    assert file.read_bytes()[:3] == b"RRF"
    assert file.stat().st_size > 20_000


def test_without_rerun_it_says_how_to_get_it(pair: Pair, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(DataError, match=r"pip install calib-toolkit\[viz\]"):
        clouds.recording(pair, T_LIDAR_CAMERA, tmp_path / "roof-front.rrd")


def test_refusals_name_the_sensors(pair: Pair, tmp_path: Path) -> None:
    apart = replace(pair, dt_a_b=30.0)
    assert isinstance(pair.motion_a, Motions)
    unmoved = replace(pair, motion_a=pair.motion_a[:0])
    for broken in (apart, unmoved, pair[:0]):
        with pytest.raises(DataError, match=r"roof and front: none of \d selected readings"):
            pictures.overlay(broken, {"after": T_LIDAR_CAMERA}, tmp_path)
        with pytest.raises(DataError, match=r"roof and front: none of \d selected readings"):
            clouds.coloured_cloud(broken, T_LIDAR_CAMERA, tmp_path / "cloud.ply")
    with pytest.raises(DataError, match="roof and front: no pose"):
        pictures.overlay(pair, {}, tmp_path)
    with pytest.raises(DataError, match=r"must end in \.ply"):
        clouds.coloured_cloud(pair, T_LIDAR_CAMERA, tmp_path / "cloud.txt")
    camera = replace(pair.b, intrinsics=None)
    with pytest.raises(DataError, match="front has no intrinsics"):
        pictures.overlay(replace(pair, b=camera), {"after": T_LIDAR_CAMERA}, tmp_path)
