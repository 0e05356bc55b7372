"""Simulated vehicles: which sensors they carry, where, and what their clocks say."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from calib_toolkit import Calibration, CameraIntrinsics, se3
from calib_toolkit_datasets.simulation.camera import CameraModel
from calib_toolkit_datasets.simulation.ins import InsModel
from calib_toolkit_datasets.simulation.lidar import VELODYNE_16, VELODYNE_32, VELODYNE_64, VELODYNE_128, LidarModel

Array = NDArray[np.float64]
Nanoseconds = NDArray[np.int64]

START_NS = int(np.datetime64("2011-10-31T12:55:34", "ns").astype(np.int64))
"""What every clock would say, in unix nanoseconds, at the start of the drive if it were right."""
SHIFT, TURN, LATE = 0.02, np.radians(0.7), 0.01
"""How far, one sigma, the sensors of one vehicle are from where others of its kind have them; and their clocks."""
KITTI_RATE = 9.66
CAMERA_AXES = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""``R_vehicle_camera`` of a camera that looks ahead."""
RECTIFIED = CameraIntrinsics(np.array([[718.9, 0.0, 607.2], [0.0, 718.9, 185.2], [0.0, 0.0, 1.0]]), size=(1242, 375))
"""What the images of a synced drive were taken with."""


@dataclass(frozen=True)
class Mounted:
    """One sensor of a vehicle.

    kind: id of the sensor plugin that reads it. T_vehicle_sensor: (4, 4). rate: readings a second. A reading that its
    clock stamps s, in seconds since the start of the drive, was taken at true second ``s + dt + skew * s``.
    trigger: sensors that name one take their readings at the same instants.
    """

    name: str
    kind: str
    T_vehicle_sensor: Array
    model: LidarModel | CameraModel | InsModel
    rate: float
    dt: float
    skew: float = 0.0
    trigger: str = ""

    def stamps(self, seconds: float, seed: int) -> Nanoseconds:
        """What its clock says of each reading of a drive, whole nanoseconds since the start of the drive."""
        rng = generator(seed, f"clock of {self.trigger or self.name}", 0)
        true = np.arange(rng.uniform(0.0, 1 / self.rate), seconds, 1 / self.rate)
        return np.round((true - self.dt) / (1.0 + self.skew) * 1e9).astype(np.int64)

    def instants(self, stamps: Nanoseconds) -> Array:
        """True seconds of readings that its clock stamped so, (n,)."""
        clock = stamps / 1e9
        return clock + self.dt + self.skew * clock


@dataclass(frozen=True)
class Rig:
    """A vehicle. sensors: the first is the base of its calibration. drive, scene: where it is usually driven."""

    sensors: tuple[Mounted, ...]
    drive: str
    scene: str

    def sensor(self, name: str) -> Mounted:
        """The sensor of that name."""
        return next(s for s in self.sensors if s.name == name)


def generator(seed: int, name: str, number: int) -> np.random.Generator:
    """The source of chance of one reading of one sensor: the same in whatever order readings are made."""
    return np.random.default_rng([seed, number, *name.encode()])


def truth(rig: Rig, t_ref: float) -> Calibration:
    """Where the sensors are and what their clocks say, exactly. t_ref: stamp of the start of the drive, seconds."""
    base, n = rig.sensors[0], len(rig.sensors)
    return Calibration(
        base.name,
        tuple(s.name for s in rig.sensors),
        np.array([se3.relative(base.T_vehicle_sensor, s.T_vehicle_sensor) for s in rig.sensors]),
        np.array([(s.dt - base.dt) / (1 + base.skew) for s in rig.sensors]),
        np.zeros((7 * n, 7 * n)),
        np.array([not isinstance(s.model, CameraModel) for s in rig.sensors]),
        np.ones((n, 7), dtype=bool),
        clock_skew=np.array([(1 + s.skew) / (1 + base.skew) - 1 for s in rig.sensors]),
        t_ref=t_ref,
    )


def kitti(seed: int) -> Rig:
    """A car like KITTI's: 64 beams, two grey and two colour cameras in a row, and an INS of 100 Hz.

    The scanner triggers the cameras; the stamps of the two colour ones are some milliseconds off.
    """
    rng = generator(seed, "kitti", 0)
    velo_clock, camera_clock = rng.normal(0.015, LATE), rng.normal(-0.03, LATE)
    velo = replace(VELODYNE_64, rate=KITTI_RATE)
    row = _pose(rng, (1.03, 0.0, 1.65), camera=True)
    cameras = []
    for k, (left, late) in enumerate([(0.0, 0.0), (-0.54, 0.0), (0.06, 0.00614), (-0.48, 0.0067)]):
        T = row @ se3.matrix([-left, *rng.normal(0, 0.004, 2), *rng.normal(0, np.radians(0.4), 3)])
        lens = CameraModel(_lens(rng, 880.0, (1242, 375), (-0.37, 0.2, 0.001, 0.001, -0.07)), colour=k > 1)
        cameras.append(Mounted(f"cam{k}", "monocular", T, lens, KITTI_RATE, camera_clock + late, trigger="velo"))
    ins = _pose(rng, (-0.05, 0.32, 0.93), yaw=0.8)
    return Rig(
        (
            Mounted("velo", "velodyne", _pose(rng, (0.76, 0.0, 1.73)), velo, velo.rate, velo_clock),
            *cameras,
            Mounted("ins", "gps_ins", ins, InsModel(), 100.0, rng.normal(-0.045, LATE)),
        ),
        "street",
        "street",
    )


def shrimp(seed: int) -> Rig:
    """A small robot like the Shrimp: 64 beams, a ladybug of five level heads and one that looks up, and an INS."""
    rng = generator(seed, "shrimp", 0)
    velo, ladybug = replace(VELODYNE_64, rate=6.2), _pose(rng, (0.0, 0.0, 1.45))
    clock = rng.normal(0.06, LATE)
    heads = []
    for k in range(6):
        yaw = -2 * np.pi / 5 * k
        level = se3.rigid(CAMERA_AXES, [0.04, 0.0, 0.0])
        around = se3.matrix([0.0, 0.0, 0.0, 0.0, 0.0, yaw]) if k < 5 else se3.matrix([0, 0, 0.04, 0, -np.pi / 2, 0])
        lens = CameraModel(_lens(rng, 367.0, (616, 808), (-0.08, 0.008, 0.0, 0.0, 0.0)))
        T = ladybug @ around @ level @ se3.matrix(rng.normal(0, [0.002] * 3 + [np.radians(0.3)] * 3))
        heads.append(Mounted(f"ladybug{k}", "ladybug", T, lens, 5.2, clock, trigger="ladybug"))
    ins = replace(InsModel(), sigma=(0.02, 0.02, 0.03, 5e-4, 5e-4, 1.5e-3))
    return Rig(
        (
            Mounted("velo", "velodyne", _pose(rng, (0.05, 0.0, 1.1)), velo, velo.rate, rng.normal(-0.02, LATE)),
            Mounted("ins", "gps_ins", _pose(rng, (0.0, 0.0, 0.45), yaw=-178.4), ins, 50.0, rng.normal(0.0, LATE)),
            *heads,
        ),
        "court",
        "court",
    )


def fleet_car(seed: int) -> Rig:
    """A car of a fleet: a lidar on the roof and one at each front corner, six cameras around it, and an INS.

    The clock of the rear camera runs 20 parts in a million fast or slow.
    """
    rng = generator(seed, "fleet-car", 0)
    roof = _pose(rng, (1.2, 0.0, 2.05))
    left, right = (_pose(rng, (3.6, side * 0.85, 0.75), yaw=side * 45.0, pitch=8.0) for side in (1, -1))
    sensors = [
        Mounted("lidar", "velodyne", roof, VELODYNE_128, VELODYNE_128.rate, rng.normal(0.0, LATE)),
        Mounted("lidar_left", "velodyne", left, VELODYNE_32, VELODYNE_32.rate, rng.normal(0.02, LATE)),
        Mounted("lidar_right", "velodyne", right, VELODYNE_16, VELODYNE_16.rate, rng.normal(-0.03, LATE)),
        Mounted("ins", "gps_ins", _pose(rng, (0.2, 0.1, 0.6)), InsModel(), 100.0, rng.normal(-0.05, LATE)),
    ]
    around = {
        "front": 0.0,
        "front_left": 60.0,
        "front_right": -60.0,
        "rear_left": 120.0,
        "rear_right": -120.0,
        "rear": 180.0,
    }
    for name, yaw in around.items():
        ahead, aside = np.cos(np.radians(yaw)), np.sin(np.radians(yaw))
        T = _pose(rng, (1.2 + 0.7 * ahead, 0.6 * aside, 1.85), yaw=yaw, pitch=4.0, camera=True)
        lens = CameraModel(_lens(rng, 572.0, (960, 600), (-0.15, 0.03, 0.0, 0.0, 0.0)))
        skew = float(rng.choice([-20e-6, 20e-6])) if name == "rear" else 0.0
        clock = rng.normal(0.04, LATE)
        sensors.append(Mounted(f"cam_{name}", "monocular", T, lens, 10.0, clock, skew, trigger="cameras"))
    return Rig(tuple(sensors), "street", "street")


def compact(seed: int) -> Rig:
    """A car that is quick to simulate: 64 beams, one grey camera of 640 x 320 pixels and an INS of 100 Hz."""
    rng = generator(seed, "compact", 0)
    camera = CameraModel(_lens(rng, 400.0, (640, 320), (-0.2, 0.05, 0.0, 0.0, 0.0)), colour=False)
    clocks, lidar = rng.normal([0.01, 0.04, -0.05], LATE), replace(VELODYNE_64, columns=1000)
    return Rig(
        (
            Mounted("velo", "velodyne", _pose(rng, (0.9, 0.0, 1.8)), lidar, lidar.rate, clocks[0]),
            Mounted("cam0", "monocular", _pose(rng, (1.3, 0.1, 1.5), camera=True), camera, 10.0, clocks[1]),
            Mounted("ins", "gps_ins", _pose(rng, (-0.1, 0.25, 0.8)), InsModel(), 100.0, clocks[2]),
        ),
        "street",
        "street",
    )


RIGS: dict[str, Callable[[int], Rig]] = {
    "kitti": kitti,
    "shrimp": shrimp,
    "fleet-car": fleet_car,
    "compact": compact,
}
"""Each makes one vehicle of its kind: every seed another."""


def synced(rig: Rig) -> Rig:
    """The same vehicle as KITTI's synced drives show it: one clock, ten frames a second, images rectified.

    The rectified cameras share the axes of the first and stand on its x axis.
    """
    first = next((s.T_vehicle_sensor for s in rig.sensors if isinstance(s.model, CameraModel)), np.eye(4))
    sensors = []
    for s in rig.sensors:
        model, T = s.model, s.T_vehicle_sensor
        if isinstance(model, CameraModel):
            model = replace(model, intrinsics=RECTIFIED)
            T = first @ se3.matrix([se3.relative(first, T)[0, 3], 0, 0, 0, 0, 0])
        elif isinstance(model, LidarModel):
            model = replace(model, rate=10.0)
        sensors.append(replace(s, T_vehicle_sensor=T, model=model, rate=10.0, dt=0.0, skew=0.0, trigger="frame"))
    return replace(rig, sensors=tuple(sensors))


def _pose(
    rng: np.random.Generator, at: Sequence[float], yaw: float = 0.0, pitch: float = 0.0, camera: bool = False
) -> Array:
    """``T_vehicle_sensor`` close to a place in metres and a heading in degrees (pitch: looking down)."""
    R = Rotation.from_euler("ZY", [yaw, pitch], degrees=True).as_matrix()
    off = se3.exp_so3(rng.normal(0.0, TURN, 3))
    return se3.rigid(off @ R @ (CAMERA_AXES if camera else np.eye(3)), np.array(at) + rng.normal(0.0, SHIFT, 3))


def _lens(
    rng: np.random.Generator, focal: float, size: tuple[int, int], distortion: Sequence[float]
) -> CameraIntrinsics:
    """Intrinsics within a per cent of those given, in pixels."""
    f = focal * rng.normal(1.0, 0.005, 2)
    centre = (np.array(size) - 1) / 2 + rng.normal(0.0, 5.0, 2)
    K = np.array([[f[0], 0.0, centre[0]], [0.0, f[1], centre[1]], [0.0, 0.0, 1.0]])
    return CameraIntrinsics(K, np.array(distortion) * rng.normal(1.0, 0.01, 5), size)
