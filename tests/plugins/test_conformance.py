"""Every built-in sensor is held to the same laws as a stranger's."""

import pickle
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from calib_toolkit import CameraIntrinsics, Fix, MotionReading, Motions, PoseReading, Scan, Stream, Trajectory, se3
from calib_toolkit.testing import SensorCase, checks, parametrize_with_sensor_checks
from calib_toolkit_plugins import gps_ins, ladybug, monocular, odometry, velodyne

Array = NDArray[np.float64]

(ODOMETRY,) = odometry.calib_register_sensors()
(GPS_INS,) = gps_ins.calib_register_sensors()
(VELODYNE,) = velodyne.calib_register_sensors()
(MONOCULAR,) = monocular.calib_register_sensors()
(LADYBUG,) = ladybug.calib_register_sensors()
SIGMA = np.array([0.02, 0.01, 0.03, 1e-3, 2e-3, 5e-4])


def noisy_motions(T_world_sensor: Array, seed: int) -> Array:
    vec = se3.vector(se3.relative(T_world_sensor[:-1], T_world_sensor[1:]))
    return vec + SIGMA * np.random.default_rng(seed).standard_normal(vec.shape)


def stated_motions(T_world_sensor: Array, stamps: Array, seed: int) -> Stream:
    vec = noisy_motions(T_world_sensor, seed)
    readings = [MotionReading(None), *(MotionReading(v, np.diag(SIGMA**2)) for v in vec)]
    return Stream("slam", "odometry", stamps, readings)


def unscaled_motions(T_world_sensor: Array, stamps: Array, seed: int) -> Stream:
    stream = stated_motions(T_world_sensor, stamps, seed)
    return Stream("mono", "odometry", stamps, stream.readings, has_scale=False)


def poses_with_covariance(T_world_sensor: Array, stamps: Array, seed: int) -> Stream:
    noise = SIGMA * np.random.default_rng(seed).standard_normal((len(stamps), 6))
    T = T_world_sensor.copy()
    T[:, :3, :3] = se3.exp_so3(noise[:, 3:]) @ T[:, :3, :3]
    T[:, :3, 3] += noise[:, :3]
    return Stream("slam", "odometry", stamps, [PoseReading(pose, np.diag(SIGMA**2)) for pose in T])


def poses_alone(T_world_sensor: Array, stamps: Array, seed: int) -> Stream:
    T = [T_world_sensor[0]]
    for step in se3.matrix(noisy_motions(T_world_sensor, seed)):
        T.append(T[-1] @ step)
    readings = [PoseReading(pose) for pose in T]
    return Stream("slam", "odometry", stamps, readings, options={"motion_sigma": tuple(SIGMA)})


def fixes(T_world_sensor: Array, stamps: Array, seed: int) -> Stream:
    """An INS near 49 degrees north, on drives short enough to be flat."""
    rng = np.random.default_rng(seed)
    sigma_position, sigma_rpy = np.array([0.05, 0.05, 0.1]), np.array([2e-4, 2e-4, 5e-4])
    east, north, up = (T_world_sensor[:, :3, 3] + sigma_position * rng.standard_normal((len(stamps), 3))).T
    rpy = Rotation.from_matrix(T_world_sensor[:, :3, :3]).as_euler("ZYX")[:, ::-1]
    rpy = rpy + sigma_rpy * rng.standard_normal(rpy.shape)
    lat0, lon0, alt0 = 0.855, 0.147, 110.0
    e2 = gps_ins.FLATTENING * (2 - gps_ins.FLATTENING)
    w = np.sqrt(1 - e2 * np.sin(lat0) ** 2)
    lat = lat0 + north / (gps_ins.SEMI_MAJOR_AXIS * (1 - e2) / w**3 + alt0)
    lon = lon0 + east / ((gps_ins.SEMI_MAJOR_AXIS / w + alt0) * np.cos(lat0))
    rows = np.stack([lat, lon, alt0 + up, *rpy.T], axis=1).tolist()
    return Stream("ins", "gps_ins", stamps, [Fix(*row, sigma_position, sigma_rpy) for row in rows])


test_odometry = parametrize_with_sensor_checks(
    [
        SensorCase(ODOMETRY, stated_motions, name="motions"),
        SensorCase(ODOMETRY, unscaled_motions, name="motions-without-scale"),
        SensorCase(ODOMETRY, poses_with_covariance, name="poses-with-covariance"),
        SensorCase(ODOMETRY, poses_alone, name="poses"),
    ]
)

test_gps_ins = parametrize_with_sensor_checks([SensorCase(GPS_INS, fixes)])

ROOM = np.array([[-25.0, -20.0, -1.8], [55.0, 30.0, 8.0]])
"""Two corners of a hall that a lidar or a camera drives through; metres."""


def rays_to_walls(T_world_sensor: Array, rays: Array) -> tuple[Array, Array, Array]:
    """Distance along each unit ray (n, 3) of the sensor, the axis (n,) across the wall it meets, where (n, 3)."""
    directions = rays @ T_world_sensor[:3, :3].T
    position = T_world_sensor[:3, 3]
    with np.errstate(divide="ignore"):
        reach = np.abs(np.where(directions > 0, ROOM[1], ROOM[0]) - position) / np.abs(directions)
    axis = np.argmin(reach, axis=1)
    distance = reach[np.arange(len(rays)), axis]
    return distance, axis, position + distance[:, None] * directions


def scans(T_world_sensor: Array, stamps: Array, seed: int) -> Stream:
    rng = np.random.default_rng(seed)
    elevation, azimuth = np.meshgrid(np.deg2rad(np.linspace(-24, 8, 24)), np.deg2rad(np.arange(0, 360, 0.5)))
    level = np.cos(elevation)
    rays = np.stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)], axis=-1).reshape(-1, 3)
    readings = []
    for T in T_world_sensor:
        distance = rays_to_walls(T, rays)[0] + 0.05 * rng.standard_normal(len(rays))
        readings.append(Scan((distance[:, None] * rays).astype(np.float32)))
    return Stream("velo", "velodyne", stamps, readings)


def images(T_world_sensor: Array, stamps: Array, seed: int) -> Stream:
    import cv2

    rng = np.random.default_rng(seed)
    cloudy = [cv2.GaussianBlur(rng.standard_normal((512, 512)), (0, 0), sigma) for sigma in (4, 12)]
    wall = sum(c / c.std() for c in cloudy).astype(np.float32)
    width, height, f = 480, 320, 300.0
    u, v = np.meshgrid(np.arange(width), np.arange(height))
    rays = np.stack([(u - width / 2) / f, (v - height / 2) / f, np.ones(u.shape)], axis=-1).reshape(-1, 3)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    readings = []
    for T in T_world_sensor:
        _, axis, point = rays_to_walls(T, rays)
        on_wall = np.where(
            (axis == 0)[:, None], point[:, 1:], np.where((axis == 1)[:, None], point[:, ::2], point[:, :2])
        )
        x, y = (16.0 * on_wall.T + 100.0 * axis).reshape(2, height, width).astype(np.float32) % 512
        grey = cv2.remap(wall, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
        noisy = 128 + 40 * grey + 1.0 * rng.standard_normal(grey.shape)
        readings.append(np.clip(noisy, 0, 255).astype(np.uint8))
    K = np.array([[f, 0, width / 2], [0, f, height / 2], [0, 0, 1]])
    lens = CameraIntrinsics(K, size=(width, height))
    return Stream("cam0", "monocular", stamps, readings, intrinsics=lens, has_scale=False)


def head_images(T_world_sensor: Array, stamps: Array, seed: int) -> Stream:
    return replace(images(T_world_sensor, stamps, seed), name="lady1", kind="ladybug")


T_VEHICLE_CAMERA = se3.rigid([[0, 0, 1], [-1, 0, 0], [0, -1, 0]], [0, 0, 0])
T_VEHICLE_HEAD = se3.matrix([0, 0, 0, 0, 0, np.deg2rad(72)]) @ T_VEHICLE_CAMERA

# the claim counts the noise of ranges and of corners, not how rings and pixels sample a wall
test_velodyne = parametrize_with_sensor_checks([SensorCase(VELODYNE, scans, readings=7, nees=(0.05, 8.0))])
test_cameras = parametrize_with_sensor_checks(
    [
        SensorCase(MONOCULAR, images, T_vehicle_sensor=T_VEHICLE_CAMERA, readings=6, nees=(0.05, 8.0)),
        SensorCase(LADYBUG, head_images, T_vehicle_sensor=T_VEHICLE_HEAD, readings=6, nees=(0.05, 8.0)),
    ]
)


def inverse(m: Motions) -> Motions:
    return replace(m, vec=se3.vector(se3.invert(se3.matrix(m.vec))))


def in_degrees(m: Motions) -> Motions:
    return replace(m, vec=m.vec * [1, 1, 1, 57.3, 57.3, 57.3])


def backwards_in_time(m: Motions) -> Motions:
    return replace(m, start=m.end, end=m.start)


def overconfident(m: Motions) -> Motions:
    return replace(m, cov=m.cov / 25)


def certain(m: Motions) -> Motions:
    return replace(m, cov=0.0 * m.cov)


def lopsided(m: Motions) -> Motions:
    return replace(m, cov=m.cov + np.triu(np.full((6, 6), 1e-5), 1))


def drifting(m: Motions) -> Motions:
    return replace(m, vec=m.vec + np.array([0.2, 0, 0, 0, 0, 0]))


def unit_but_said_to_have_scale(m: Motions) -> Motions:
    return replace(m, vec=np.hstack([m.vec[:, :3] / np.linalg.norm(m.vec[:, :3], axis=1)[:, None], m.vec[:, 3:]]))


def unseeded(m: Motions) -> Motions:
    return replace(m, vec=m.vec + np.random.default_rng().normal(0, 1e-6, m.vec.shape))


def aware_of_the_cut(m: Motions) -> Motions:
    return replace(m, vec=m.vec + 0.1 * (np.arange(len(m)) == 0)[:, None])


@pytest.mark.parametrize(
    ("fault", "check"),
    [
        (inverse, checks.forward_drive_has_the_right_sign),
        (inverse, checks.turning_drive_has_the_right_sign),
        (in_degrees, checks.turning_drive_has_the_right_sign),
        (backwards_in_time, checks.stamps_increase),
        (overconfident, checks.errors_match_the_covariance),
        (certain, checks.covariances_are_positive),
        (lopsided, checks.covariances_are_positive),
        (drifting, checks.still_rig_gives_identity),
        (unit_but_said_to_have_scale, checks.scale_free_translations_are_unit),
        (unseeded, checks.same_input_same_answer),
        (aware_of_the_cut, checks.slices_join_to_the_whole),
    ],
    ids=lambda f: f.__name__,
)
def test_the_kit_catches(fault: Callable[[Motions], Motions], check: Callable[[SensorCase], None]) -> None:
    def estimate(stream: Stream, options: odometry.OdometryOptions) -> Motions:
        motions = odometry.estimate(stream, options)
        assert isinstance(motions, Motions)
        return fault(motions)

    check(SensorCase(ODOMETRY, stated_motions))
    with pytest.raises(AssertionError):
        check(SensorCase(replace(ODOMETRY, estimate=estimate), stated_motions))


def test_the_kit_catches_a_sensor_that_writes_into_its_readings() -> None:
    def estimate(stream: Stream, options: odometry.OdometryOptions) -> Motions | Trajectory:
        stream.readings[1].vec[0] += 1.0
        return odometry.estimate(stream, options)

    with pytest.raises(AssertionError, match="changed its stream"):
        checks.inputs_are_left_alone(SensorCase(replace(ODOMETRY, estimate=estimate), stated_motions))


def test_the_kit_catches_a_sensor_that_accepts_one_reading() -> None:
    def estimate(stream: Stream, options: odometry.OdometryOptions) -> Motions:
        return Motions(np.zeros(0), np.zeros(0), np.zeros((0, 6)), np.zeros((0, 6, 6)))

    with pytest.raises(AssertionError, match="one reading was accepted"):
        checks.one_reading_is_refused(SensorCase(replace(ODOMETRY, estimate=estimate), stated_motions))


def test_the_kit_catches_a_sensor_that_can_not_be_sent_to_another_process() -> None:
    broken = replace(ODOMETRY, estimate=lambda stream, options: odometry.estimate(stream, options))
    with pytest.raises((AttributeError, pickle.PicklingError)):
        checks.survives_pickling(SensorCase(broken, stated_motions))


def test_a_check_that_does_not_apply_is_skipped_with_its_reason() -> None:
    case = SensorCase(ODOMETRY, stated_motions, skip={"survives_pickling": "it may not travel"})
    (mark,) = parametrize_with_sensor_checks([case]).pytestmark  # type: ignore[attr-defined]
    skipped = {p.id: p.marks[0].kwargs["reason"] for p in mark.args[1] if p.marks}
    assert skipped == {"odometry-survives_pickling": "it may not travel"}
