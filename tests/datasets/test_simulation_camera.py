"""Simulated cameras: geometry, light, noise and texture, in a world of a few boxes whose rays are solved exactly."""

from dataclasses import dataclass

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from calib_toolkit import CameraIntrinsics, DataError, se3
from calib_toolkit_datasets.simulation.camera import (
    ELECTRONS,
    GAMMA,
    READ_NOISE,
    CameraModel,
    Daylight,
    daylight,
    render,
)
from calib_toolkit_datasets.simulation.materials import SHADES
from calib_toolkit_datasets.simulation.surfaces import MATERIALS, Hits
from calib_toolkit_datasets.simulation.texture import GREY, albedo, reflectance
from calib_toolkit_datasets.simulation.vehicle import GRID, TruePath

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

SIZE = (240, 160)
K = np.array([[200.0, 0.0, 119.0], [0.0, 205.0, 81.0], [0.0, 0.0, 1.0]])
BENT = np.array([-0.2, 0.05, 0.002, -0.001, 0.0])
T_VEHICLE_CAMERA = se3.rigid([[0, 0, 1], [-1, 0, 0], [0, -1, 0]], [0.5, 0.1, 1.6])
GROUND = ((-500.0, -500.0, -1.0), (500.0, 500.0, 0.0), "marking")
TALL = ((12.0, -2.0, 0.0), (16.0, 3.0, 4.0), "rubber")
WALL = ((9.0, -40.0, 0.0), (10.0, 40.0, 30.0), "brick")


@dataclass(frozen=True)
class Boxes:
    """A scene of boxes with sides along the axes: (low, high, material) each."""

    boxes: tuple[tuple[tuple[float, ...], tuple[float, ...], str], ...]

    def cast(self, origins: Array, directions: Array, stamps: Array) -> Hits:
        n = len(origins)
        nearest, normal, material = np.full(n, np.inf), np.zeros((n, 3)), np.zeros(n, np.uint8)
        inverse = 1 / np.where(directions == 0, 1e-12, directions)
        for low, high, name in self.boxes:
            first, second = (low - origins) * inverse, (high - origins) * inverse
            into, out = np.minimum(first, second), np.maximum(first, second).min(axis=1)
            axis, distance = into.argmax(axis=1), into.max(axis=1)
            met = (distance > 0) & (distance < out) & (distance < nearest)
            nearest[met], material[met], normal[met] = distance[met], MATERIALS.index(name), 0
            normal[met, axis[met]] = -np.sign(directions[met, axis[met]])
        position = origins + directions * np.where(np.isfinite(nearest), nearest, 0)[:, None]
        f = np.float32
        return Hits(
            nearest.astype(f), position.astype(f), normal.astype(f), normal.astype(f), material, np.zeros(n, f)
        )


def drive(velocity: tuple[float, float, float] = (0.0, 0.0, 0.0), turn: float = 0.0) -> TruePath:
    """A path through the origin at second 0. velocity: m/s; turn: rad/s."""
    stamps = np.arange(-1.0, 1.0, GRID)
    vec = np.zeros((len(stamps), 6))
    vec[:, :3], vec[:, 5] = stamps[:, None] * velocity, turn * stamps
    return TruePath(stamps, se3.matrix(vec))


def camera(distortion: Array = BENT, colour: bool = False, readout: float = 0.0) -> CameraModel:
    return CameraModel(CameraIntrinsics(K, distortion, SIZE), colour, readout)


def shoot(model: CameraModel, *boxes: object, path: TruePath | None = None, k: int = 0, stamp: float = 0.0) -> Image:
    rng = np.random.default_rng([7, k])
    return render(model, Boxes(boxes), path or drive(), T_VEHICLE_CAMERA, stamp, LIGHT, rng)  # type: ignore[arg-type]


LIGHT = Daylight(np.array([-0.6, 0.48, 0.64], np.float32), np.zeros(2, np.float32))


def test_same_seed_same_bytes_in_any_order() -> None:
    model = camera(colour=True)
    first = [shoot(model, GROUND, TALL, k=k) for k in (0, 1)]
    second = [shoot(camera(colour=True), GROUND, TALL, k=k) for k in (1, 0)]
    assert np.array_equal(first[0], second[1])
    assert np.array_equal(first[1], second[0])
    assert not np.array_equal(first[0], first[1])
    assert first[0].shape == (160, 240, 3)
    assert first[0].dtype == np.uint8


def test_a_camera_at_rest_sees_only_noise_change_and_as_much_as_stated() -> None:
    a, b = (shoot(camera(), GROUND, WALL, k=k).astype(float) for k in (0, 1))
    light_a, light_b = ((image / 255) ** GAMMA for image in (a, b))
    light_b *= light_a.mean() / light_b.mean()  # each picture is exposed by itself
    mean = (light_a + light_b) / 2
    inside = (mean > 0.02) & (mean < 0.9)
    electrons = ELECTRONS * mean[inside]
    quantised = (ELECTRONS * GAMMA * mean[inside] ** (1 - 1 / GAMMA) / 255) ** 2 / 12
    z = ELECTRONS * (light_a - light_b)[inside] / np.sqrt(2 * (electrons + READ_NOISE**2 + quantised))
    assert inside.mean() > 0.5
    assert abs(z.std() - 1) < 0.05
    assert abs(z.mean()) < 0.05


BOARD = tuple(
    ((12.0, y, z), (12.5, y + 1.2, z + 1.2), "rubber" if (i + k) % 2 else "marking")
    for i, y in enumerate(np.arange(-6.0, 6.0, 1.2).tolist())
    for k, z in enumerate(np.arange(-2.0, 5.0, 1.2).tolist())
)
"""A wall of dark and bright squares across the whole picture."""


@pytest.mark.parametrize("distortion", [np.zeros(0), BENT])
@pytest.mark.parametrize("readout", [0.0, 0.06])
def test_corners_are_where_opencv_projects_them(distortion: Array, readout: float) -> None:
    model, path, stamp = camera(distortion, readout=readout), drive((6.0, 5.0, 0.0), turn=0.4), 0.1
    image = shoot(model, *BOARD, path=path, stamp=stamp)
    corners = np.array([high[:2] + low[2:] for low, high, _ in BOARD if -5 < low[1] < 4 and -1 < low[2] < 4])
    corners[:, 0] = 12.0

    def project(instants: Array) -> Array:
        T_camera_world = se3.invert(path.at(instants) @ T_VEHICLE_CAMERA)
        points = np.einsum("nij,nj->ni", T_camera_world[:, :3, :3], corners) + T_camera_world[:, :3, 3]
        return np.asarray(cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, distortion)[0]).reshape(-1, 2)

    middle = expected = project(np.full(len(corners), stamp))
    for _ in range(10):
        expected = project(stamp + readout * ((expected[:, 1] + 0.5) / SIZE[1] - 0.5))
    inside = np.all((expected > 8) & (expected < np.array(SIZE) - 9), axis=1)
    criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 50, 0.001)
    start = np.ascontiguousarray(expected[inside].reshape(-1, 1, 2), np.float32)
    found = cv2.cornerSubPix(image, start, (5, 5), (-1, -1), criteria).reshape(-1, 2)
    error = found - expected[inside]
    assert inside.sum() >= 15
    assert np.linalg.norm(error, axis=1).max() < 0.5
    assert error.std(axis=0).max() < 0.2
    assert np.abs(error.mean(axis=0)).max() < 0.08
    if readout:
        # or the test would not notice the shutter
        assert np.linalg.norm(found - middle[inside], axis=1).max() > 1.0


def test_texture_is_fixed_to_the_surface() -> None:
    near, far = drive(), drive((0.9, 0.4, 0.0), turn=0.05)
    model = camera(np.zeros(0))
    a, b = (shoot(model, WALL, path=path, stamp=0.9, k=k) for k, path in enumerate((near, far)))
    corners = np.array([[9.0, -2.0, 0.5], [9.0, 2.0, 0.5], [9.0, 2.0, 3.0], [9.0, -2.0, 3.0]])
    seen = []
    for path in (near, far):
        T = se3.invert(path.at(np.array([0.9]))[0] @ T_VEHICLE_CAMERA)
        points = corners @ T[:3, :3].T + T[:3, 3]
        seen.append((points @ K.T)[:, :2] / points[:, 2:])
    H = cv2.getPerspectiveTransform(seen[1].astype(np.float32), seen[0].astype(np.float32))
    warped = cv2.warpPerspective(b, H, SIZE)
    window = np.s_[50:120, 60:180]
    assert np.corrcoef(a[window].ravel(), warped[window].ravel())[0, 1] > 0.9
    assert np.corrcoef(a[window].ravel(), b[window].ravel())[0, 1] < 0.5


@pytest.mark.parametrize("boxes", [(GROUND,), ((GROUND[0], GROUND[1], "rubber"), (*WALL[:2], "rubber")), ()])
def test_exposure_follows_the_scene(boxes: tuple[object, ...]) -> None:
    assert 80 < shoot(camera(), *boxes).mean() < 125


def test_the_sun_casts_shadows() -> None:
    """The sun is behind the camera and to its left, so the pole's shadow falls ahead and to the right."""
    pole = ((8.0, 0.6, 0.0), (8.3, 0.9, 1.2), "metal")
    with_pole, without = (shoot(camera(np.zeros(0)), GROUND, *more).astype(float) for more in ((pole,), ()))
    T = se3.invert(T_VEHICLE_CAMERA)
    tip = np.array([8.15, 0.75, 0.0]) - LIGHT.sun / LIGHT.sun[2] * 0.9 * np.array([1, 1, 0])
    for y, ratio in ((0.0, 0.7), (1.2, 1.1)):
        x = K @ (T[:3, :3] @ (tip + np.array([0, y, 0])) + T[:3, 3])
        column, row = np.rint(x[:2] / x[2]).astype(int)
        darkened = with_pole[row, column - 1 : column + 2].mean() / without[row, column - 1 : column + 2].mean()
        assert (darkened < ratio) if y == 0 else (0.9 < darkened < ratio)


def test_grey_is_the_luminance_of_colour() -> None:
    # compared where the light is linear, up to the exposure
    colour, grey = (shoot(camera(colour=c), GROUND, WALL).astype(float) for c in (True, False))
    bright, luminance = (grey / 255) ** GAMMA, (colour / 255) ** GAMMA @ GREY
    assert grey.shape == (160, 240)
    assert np.corrcoef(bright.ravel(), luminance.ravel())[0, 1] > 0.98


def hits_on(material: str, n: int = 4000, tone: float = 0.3) -> Hits:
    """Points spread over a wall 10 m away."""
    rng = np.random.default_rng(4)
    position = (rng.random((n, 3)) * [40, 0, 40]).astype(np.float32)
    normal = np.tile(np.array([0, -1, 0], np.float32), (n, 1))
    index, tones = np.full(n, MATERIALS.index(material), np.uint8), np.full(n, tone, np.float32)
    return Hits(np.full(n, 10, np.float32), position, normal, normal, index, tones)


def test_lidar_and_camera_agree_on_most_materials_but_not_on_all() -> None:
    tones = (np.arange(SHADES) + 0.5) / SHADES
    wall = [hits_on(name, 200, tone) for name in MATERIALS if name != "sign" for tone in tones]
    seen = [float(albedo(hits, np.full(200, 0.01, np.float32), colour=False).mean()) for hits in wall]
    echoed = [float(reflectance(hits).mean()) for hits in wall]
    assert 0.4 < np.corrcoef(np.log(seen), np.log(echoed))[0, 1] < 0.95
    assert reflectance(hits_on("sign")).mean() > 1
    for name in ("brick", "leaves", "pavement"):
        hits = hits_on(name)
        detail = np.corrcoef(albedo(hits, np.full(4000, 0.01, np.float32), colour=False), reflectance(hits))[0, 1]
        assert 0.3 < detail < 0.95, name


@pytest.mark.parametrize("material", MATERIALS)
def test_texture_finer_than_a_pixel_fades_out(material: str) -> None:
    hits = hits_on(material)
    close, far = (albedo(hits, np.full(4000, pixel, np.float32)) for pixel in (0.002, 3.0))
    assert close.shape == (4000, 3)
    assert 0 < close.min() <= close.max() < 1
    assert far[:, 1].std() < 0.35 * close[:, 1].std()
    assert far[:, 1].mean() == pytest.approx(close[:, 1].mean(), rel=0.1)


def test_two_objects_of_one_material_differ() -> None:
    pixel = np.full(4000, 0.01, np.float32)
    a, b = (albedo(hits_on("brick", tone=tone), pixel, colour=False) for tone in (0.30, 0.31))
    assert np.corrcoef(a, b)[0, 1] < 0.3


def test_the_day_depends_on_the_seed() -> None:
    days = [daylight(seed) for seed in (1, 1, 2)]
    assert np.array_equal(days[0].sun, days[1].sun)
    assert not np.allclose(days[0].sun, days[2].sun, atol=0.05)
    for day in days:
        assert np.linalg.norm(day.sun) == pytest.approx(1)
        assert 0.4 < day.sun[2] < 0.9


def test_every_ray_comes_back_to_its_pixel() -> None:
    model = CameraModel(CameraIntrinsics(K, np.array([-0.35, 0.16, 0.001, 0.001, -0.03]), SIZE))
    points = model.rays.reshape(-1, 3).astype(float)
    pixels = cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, model.intrinsics.distortion)[0].reshape(-1, 2)
    expected = np.stack(np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1])), axis=2).reshape(-1, 2)
    assert np.abs(pixels - expected).max() < 0.01


def test_what_can_not_be_pictured_is_refused() -> None:
    with pytest.raises(DataError, match="size"):
        _ = CameraModel(CameraIntrinsics(K)).rays
    with pytest.raises(DataError, match="distortion"):
        _ = camera(np.array([-2.0, 0.0, 0.0, 0.0])).rays
    with pytest.raises(DataError, match=r"1\.500 s"):
        shoot(camera(), GROUND, stamp=1.5)
