"""Tables and files as nuScenes publishes them: one lidar, two cameras and a radar, a pose for each reading."""

import json

import cv2
import numpy as np

START_US = 1_532_402_927_647_951
BEAMS, TURNS = 32, 20
SIZE = (24, 16)
K = [[20.0, 0.0, 12.0], [0.0, 20.0, 8.0], [0.0, 0.0, 1.0]]
MOUNTS = {
    "LIDAR_TOP": ([0.94, 0.0, 1.84], [np.sqrt(0.5), 0.0, 0.0, -np.sqrt(0.5)]),
    "CAM_FRONT": ([1.7, 0.01, 1.51], [0.5, -0.5, 0.5, -0.5]),
    "CAM_BACK": ([0.02, 0.0, 1.57], [0.5, -0.5, -0.5, 0.5]),
    "RADAR_FRONT": ([3.4, 0.0, 0.5], [1.0, 0.0, 0.0, 0.0]),
}
PERIOD_US = {"LIDAR_TOP": 50_000, "CAM_FRONT": 83_333, "CAM_BACK": 83_333, "RADAR_FRONT": 76_000}


def sweep(rng, columns=TURNS):
    """(n, 5) float32: every firing of all beams in order, as published."""
    points = rng.uniform(-30, 30, (columns * BEAMS, 3))
    return np.column_stack([points, rng.integers(0, 255, len(points)), np.tile(np.arange(BEAMS), columns)]).astype(
        "<f4"
    )


def tables(seconds=2.0, scenes=("scene-0061",)):
    """Rows of each table; files are named in sample_data."""
    made = {name: [] for name in ("log", "scene", "sample", "sample_data", "ego_pose", "calibrated_sensor", "sensor")}
    for channel, (t, q) in MOUNTS.items():
        modality = {"L": "lidar", "C": "camera", "R": "radar"}[channel[0]]
        made["sensor"].append({"token": f"sensor{channel}", "channel": channel, "modality": modality})
        made["calibrated_sensor"].append(
            {
                "token": f"calibrated{channel}",
                "sensor_token": f"sensor{channel}",
                "translation": t,
                "rotation": q,
                "camera_intrinsic": K if modality == "camera" else [],
            }
        )
    for number, scene in enumerate(scenes):
        start = START_US + number * 100_000_000
        made["log"].append({"token": f"log{scene}", "logfile": "n015", "vehicle": "n015", "location": "here"})
        made["scene"].append({"token": scene[::-1], "log_token": f"log{scene}", "name": scene, "nbr_samples": 1})
        made["sample"].append({"token": f"{scene}sample", "timestamp": start, "scene_token": scene[::-1]})
        for channel, period in PERIOD_US.items():
            for k, us in enumerate(range(start, start + int(seconds * 1e6), period)):
                token = f"{channel}{us}"
                ending = {"L": "pcd.bin", "C": "jpg", "R": "pcd"}[channel[0]]
                angle = 0.3 * (us - start) / 1e6
                made["ego_pose"].append(
                    {
                        "token": token,
                        "timestamp": us,
                        "rotation": [np.cos(angle / 2), 0.0, 0.0, np.sin(angle / 2)],
                        "translation": [400.0 + 10 * (us - start) / 1e6, 1180.0, 0.0],
                    }
                )
                made["sample_data"].append(
                    {
                        "token": token,
                        "sample_token": f"{scene}sample",
                        "ego_pose_token": token,
                        "calibrated_sensor_token": f"calibrated{channel}",
                        "timestamp": us,
                        "fileformat": ending[:3],
                        "is_key_frame": k == 0,
                        "height": SIZE[1] if channel[0] == "C" else 0,
                        "width": SIZE[0] if channel[0] == "C" else 0,
                        "filename": f"{'samples' if k == 0 else 'sweeps'}/{channel}/n015__{channel}__{us}.{ending}",
                        "prev": "",
                        "next": "",
                    }
                )
    return made


def write(root, made, version="v1.0-mini", files=True):
    """The folder of a recording."""
    rng = np.random.default_rng(3)
    (root / version).mkdir(parents=True, exist_ok=True)
    for name, rows in made.items():
        (root / version / f"{name}.json").write_text(json.dumps(rows, indent=0))
    for row in made["sample_data"] if files else ():
        file = root / row["filename"]
        file.parent.mkdir(parents=True, exist_ok=True)
        if file.suffix == ".jpg":
            cv2.imwrite(str(file), rng.integers(0, 255, (SIZE[1], SIZE[0], 3)).astype(np.uint8))
        else:
            file.write_bytes(sweep(rng).tobytes())
    return root
