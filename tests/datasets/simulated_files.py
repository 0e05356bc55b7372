"""Simulated drives of two seconds on disk, without casting rays."""

import hashlib
from dataclasses import replace

import cv2
import numpy as np

from calib_toolkit import Scan
from calib_toolkit_datasets.simulation import rigs
from calib_toolkit_datasets.simulation.lidar import LidarModel
from calib_toolkit_datasets.simulation.writing import Wish

SECONDS = 2.0


def wish(rig="kitti", **other):
    usual = rigs.RIGS[rig](3)
    return replace(
        Wish(rig, SECONDS, 3, usual.drive, usual.scene, "extract" if rig == "kitti" else "folders"), **other
    )


def quick_reading(wish, sensor, instant, k, layout):
    """Instead of casting rays: a scan of few points that tell the instant, or a black image."""
    if isinstance(sensor.model, LidarModel):
        angle = np.linspace(-3.1, 3.1, 50, dtype=np.float32)
        points = np.column_stack([10 * np.cos(angle), 10 * np.sin(angle), np.full(50, instant, np.float32)])
        return layout.scan(Scan(points, intensity=np.full(50, 0.25, np.float32)))
    width, height = sensor.model.intrinsics.size
    image = np.zeros((height, width, 3) if sensor.model.colour else (height, width), np.uint8)
    return cv2.imencode(".png", image)[1].tobytes()


def hashes(folder):
    files = sorted(f for f in folder.rglob("*") if f.is_file())
    return {str(f.relative_to(folder)): hashlib.sha256(f.read_bytes()).hexdigest() for f in files}
