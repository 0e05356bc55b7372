"""Recordings as folders that ``calib-toolkit evaluate`` takes: ``python docs/results/recordings.py RECORDINGS DST``.

RECORDINGS holds multi-array-calib/ and kitti-drive-0027/ (CONTRIBUTING.md). DST gets kitti/, kitti-ins/, kitti-kiss/
(the velodyne's motion from scan to map instead of scan to scan), shrimp/ and ladybug/, each a rig.toml that points
into RECORDINGS and a truth.json; nothing is copied.
"""

import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib_toolkit import se3

Array = NDArray[np.float64]
Truth = Mapping[str, tuple[Array, float | None]]
"""Of each sensor, the base first: ``T_base_sensor`` (4, 4) and ``dt_base_sensor`` in seconds, None where unknown."""

KITTI_CAMERAS = {"cam0": 0.0, "cam1": 0.0, "cam2": 6.14e-3, "cam3": 6.70e-3}
"""Offsets to camera 0's clock, seconds: the cameras are triggered together, so their stamps tell."""


def write_all(recordings: Path, out: Path) -> None:
    """Write all folders."""
    stored = recordings / "multi-array-calib"
    told = json.loads((stored / "ground_truth.json").read_text())
    pose = {name: se3.matrix(vec) for name, vec in told["kitti_2011_10_03"].items()}
    cam0_velo = se3.invert(pose["velCam1"])
    kitti: dict[str, tuple[Array, float | None]] = {
        name: (cam0_velo @ pose[f"velCam{k + 1}"], dt) for k, (name, dt) in enumerate(KITTI_CAMERAS.items())
    }
    kitti["velo"] = (cam0_velo, None)
    write(out / "kitti", _logged(stored / "kitti", ["velo", *KITTI_CAMERAS]), kitti)

    ins = _poses("ins", recordings / "kitti-drive-0027" / "ins_pose_tum.txt")
    with_ins = {**kitti, "ins": (cam0_velo @ pose["velNav"], None)}
    write(out / "kitti-ins", [*_logged(stored / "kitti", ["velo", *KITTI_CAMERAS]), ins], with_ins)
    kiss = _poses("velo", recordings / "kitti-drive-0027" / "lidar_kissicp_pose_tum.txt")
    write(out / "kitti-kiss", [kiss, ins], {name: with_ins[name] for name in ("velo", "ins")})

    shrimp = {"velo": (np.eye(4), 0.0), "ins": (se3.matrix(told["shrimp_velNav"]), None)}
    write(out / "shrimp", _logged(stored / "shrimp", list(shrimp)), shrimp)

    # how the ladybug sits on the vehicle is not known, so its cameras are a rig of their own
    body = se3.matrix(told["shrimp_ladybug_cam_to_body_6vec"])
    ladybug = {f"cam{k}": (se3.invert(body[0]) @ T, 0.0) for k, T in enumerate(body)}
    write(out / "ladybug", _logged(stored / "shrimp", list(ladybug)), ladybug)


def write(folder: Path, tables: Sequence[str], truth: Truth) -> None:
    """One folder: its rig.toml and its truth.json, in the schema of calibration.json."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "rig.toml").write_text("\n".join(tables))
    sensors: dict[str, Any] = {
        name: {"T_base_sensor": T.tolist(), "dt_base_sensor": dt} for name, (T, dt) in truth.items()
    }
    (folder / "truth.json").write_text(json.dumps({"base": next(iter(truth)), "sensors": sensors}, indent=1) + "\n")


def _poses(name: str, file: Path) -> str:
    return f'[sensors.{name}]\nkind = "odometry"\nposes = "{file}"\nformat = "tum"\n'


def _logged(log: Path, names: Sequence[str]) -> list[str]:
    return [f'[sensors.{name}]\nlog = "{log}"\nsensor = "{name}"\n' for name in names]


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit("recordings.py takes two folders: RECORDINGS, and DST for what it makes of them")
    write_all(Path(sys.argv[1]).resolve(), Path(sys.argv[2]))
