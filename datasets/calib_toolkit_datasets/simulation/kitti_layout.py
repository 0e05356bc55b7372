"""A simulated drive as KITTI raw lays one out: numbered files in a folder for each sensor, and their stamps beside.

Geiger et al., "Vision meets robotics", IJRR 2013. The extrinsics of scanner and INS are left out, as if nobody knew.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from calib_toolkit import Fix, Scan, se3
from calib_toolkit_datasets.simulation.camera import CameraModel
from calib_toolkit_datasets.simulation.lidar import LidarModel
from calib_toolkit_datasets.simulation.rigs import START_NS, Mounted, Nanoseconds, Rig, synced
from calib_toolkit_datasets.simulation.vehicle import GRID, TruePath

Array = NDArray[np.float64]

VELOCITY_SIGMA = 0.02
OXTS = """\
lat: latitude (degrees)
lon: longitude (degrees)
alt: altitude (m)
roll: roll (rad), 0 is level, positive is left side up
pitch: pitch (rad), 0 is level, positive is front down
yaw: heading (rad), 0 is east, positive is counter-clockwise
vn: velocity towards north (m/s)
ve: velocity towards east (m/s)
vf: velocity forward, along the ground (m/s)
vl: velocity to the left, along the ground (m/s)
vu: velocity upward (m/s)
ax, ay, az: acceleration along the sensor's own axes (m/s^2)
af, al, au: acceleration forward, left and up (m/s^2)
wx, wy, wz: turn rate about the sensor's own axes (rad/s)
wf, wl, wu: turn rate about forward, left and up (rad/s)
pos_accuracy: one sigma of the position (m)
vel_accuracy: one sigma of the velocity (m/s)
navstat numsats posmode velmode orimode: state of the receiver
"""


@dataclass(frozen=True)
class KittiLayout:
    """The folder of one drive, beside its calibration. seed: its number. part: extract or sync (rectified images)."""

    seed: int
    part: str

    @property
    def drive(self) -> str:
        """The drive's folder, named as KITTI does; no drive of KITTI has this date."""
        day = str(np.datetime64(START_NS, "ns").astype("M8[D]")).replace("-", "_")
        return f"{day}_drive_{self.seed:04d}_{self.part}"

    def reading(self, sensor: Mounted, k: int) -> str:
        """Path of reading k."""
        suffix = {"velodyne": ".bin", "monocular": ".png", "gps_ins": ".txt"}[sensor.kind]
        return f"{self.drive}/{_folder(sensor)}/data/{k:010d}{suffix}"

    def scan(self, scan: Scan) -> bytes:
        """A ``.bin``: float32 x, y, z and intensity in hundredths, as KITTI has it."""
        assert scan.intensity is not None
        return np.column_stack([scan.points, np.round(scan.intensity, 2)]).astype("<f4").tobytes()

    def fixes(self, sensor: Mounted, fixes: list[Fix], ns: Nanoseconds, path: TruePath) -> dict[str, str]:
        """One file of 30 numbers for each fix."""
        lines = _oxts_lines(fixes, path, sensor, sensor.instants(ns))
        return {self.reading(sensor, k): f"{line}\n" for k, line in enumerate(lines)}

    def texts(self, rig: Rig, stamps: Mapping[str, Nanoseconds]) -> dict[str, str]:
        """What lies beside the readings, by path: stamps, the cameras' calibration, and what the columns are."""
        files = {"calib_cam_to_cam.txt": _camera_calibration(rig)}
        for sensor in rig.sensors:
            beside = _stamp_files(sensor, stamps[sensor.name])
            files |= {f"{self.drive}/{_folder(sensor)}/{name}": text for name, text in beside.items()}
        return files

    def rig_toml(self, rig: Rig) -> str:
        """A table for each sensor, which names this drive."""
        return "\n".join(f'[sensors.{s.name}]\nlog = "{self.drive}"\nsensor = "{s.name}"\n' for s in rig.sensors)


def _folder(sensor: Mounted) -> str:
    if isinstance(sensor.model, CameraModel):
        return f"image_{int(sensor.name.removeprefix('cam')):02d}"
    return "velodyne_points" if isinstance(sensor.model, LidarModel) else "oxts"


def _stamp_files(sensor: Mounted, ns: Nanoseconds) -> dict[str, str]:
    files = {"timestamps.txt": _stamp_lines(ns)}
    if isinstance(sensor.model, LidarModel):
        turn = round(1e9 / sensor.model.rate)
        files["timestamps_start.txt"] = _stamp_lines(ns - turn // 2)
        files["timestamps_end.txt"] = _stamp_lines(ns - turn // 2 + turn)
    elif not isinstance(sensor.model, CameraModel):
        files["dataformat.txt"] = OXTS
    return files


def _stamp_lines(ns: Nanoseconds) -> str:
    """One date to the nanosecond a line. ns: since the start of the drive."""
    return "".join(f"{str(t).replace('T', ' ')}\n" for t in (START_NS + ns).astype("M8[ns]"))


def _oxts_lines(fixes: list[Fix], path: TruePath, sensor: Mounted, instants: Array) -> list[str]:
    """The 30 numbers of each fix; rates and accelerations are the true ones."""
    before, at, after = (path.at(instants + d) @ sensor.T_vehicle_sensor for d in (-GRID, 0.0, GRID))
    velocity = (after - before)[:, :3, 3] / (2 * GRID)
    acceleration = (after + before - 2 * at)[:, :3, 3] / GRID**2 + [0.0, 0.0, 9.81]
    rate = se3.vector(se3.relative(before, after))[:, 3:] / (2 * GRID)
    R_sensor_world = np.swapaxes(at[:, :3, :3], 1, 2)
    level = Rotation.from_euler("Z", [[-f.yaw] for f in fixes]).as_matrix()
    turned = [
        *(velocity[:, [1, 0]], np.einsum("nij,nj->ni", level, velocity)),
        *(np.einsum("nij,nj->ni", R, acceleration) for R in (R_sensor_world, level)),
        *(rate, np.einsum("nij,nj->ni", level @ at[:, :3, :3], rate)),
    ]
    poses = [[np.degrees(f.lat), np.degrees(f.lon), f.alt, f.roll, f.pitch, f.yaw] for f in fixes]
    position_sigma = np.array([f.sigma_position for f in fixes], dtype=float)
    accuracy = np.sqrt(np.mean(position_sigma**2, axis=1))
    rows = np.column_stack([poses, *turned, accuracy, np.full(len(fixes), VELOCITY_SIGMA)])
    return [" ".join([f"{x:.14g}" for x in row] + ["4 9 4 4 0"]) for row in rows]


def _camera_calibration(rig: Rig) -> str:
    """``calib_cam_to_cam.txt``: of the cameras as they are (K, D, R, T) and of their rectified images."""
    lines = ["calib_time: 31-Oct-2011 12:00:00", "corner_dist: 9.950000e-02"]
    cameras = [s for s in rig.sensors if isinstance(s.model, CameraModel)]
    rectified = {s.name: s for s in synced(rig).sensors}
    for camera in cameras:
        i, flat = _folder(camera)[-2:], rectified[camera.name]
        assert isinstance(camera.model, CameraModel)
        assert isinstance(flat.model, CameraModel)
        own, ideal = camera.model.intrinsics, flat.model.intrinsics
        T_cam_cam0 = se3.relative(camera.T_vehicle_sensor, cameras[0].T_vehicle_sensor)
        baseline = se3.relative(flat.T_vehicle_sensor, cameras[0].T_vehicle_sensor)[0, 3]
        P = np.column_stack([ideal.K, ideal.K[:, 0] * baseline])
        R_rect = se3.relative(flat.T_vehicle_sensor, camera.T_vehicle_sensor)[:3, :3]
        entries = {"S": own.size, "K": own.K, "D": own.distortion, "R": T_cam_cam0[:3, :3], "T": T_cam_cam0[:3, 3]}
        entries |= {"S_rect": ideal.size, "R_rect": R_rect, "P_rect": P}
        lines += [
            f"{key}_{i}: " + " ".join(f"{x:.12e}" for x in np.ravel(np.asarray(v, dtype=float)))
            for key, v in entries.items()
        ]
    return "\n".join(lines) + "\n"
