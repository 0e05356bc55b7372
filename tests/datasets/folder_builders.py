"""Small recordings in the layouts of folders: KITTI's odometry benchmark, EuRoC, TUM and plain ones."""

from contextlib import suppress
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from calib_toolkit import DataError, Log, open_log, se3
from calib_toolkit.plugins import registry

PLUGINS = registry()
START = 1_403_636_579_763_555_584
STEP = 100_000_000
TR = np.array([[0.0, -1, 0, 0.01], [0, 0, -1, -0.06], [1, 0, 0, -0.33]])
P = [np.array([[700.0, 0, 600, -700.0 * b], [0, 700, 180, 0], [0, 0, 1, 0]]) for b in (0, 0.54, -0.06, 0.48)]


def opened(path: Path) -> Log:
    """A recording, by whichever reader knows it."""
    return open_log(path, plugins=PLUGINS)


def said(log: Log) -> str:
    """Every note of a log and of its streams, one a line."""
    return "\n".join([*log.notes, *(n for s in log.streams.values() for n in s.notes)])


def drive(n: int) -> np.ndarray:
    """(n, 4, 4) poses along a bend."""
    k = np.arange(n) / 10
    turns = Rotation.from_euler("ZYX", np.column_stack([0.3 * np.sin(k), 0.02 * np.cos(k), 0.01 * k])).as_matrix()
    return se3.rigid(turns, np.column_stack([5 * k, np.sin(k), 0.1 * k]))


def image(file: Path, k: int, size=(64, 48)) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(file), np.random.default_rng(k).integers(0, 255, size[::-1]).astype(np.uint8))


def kitti_odometry(root: Path, n: int = 12) -> Path:
    """Sequence 07 with scans, cameras 0 and 2 and poses; returns its folder."""
    home = root / "sequences/07"
    (home / "velodyne").mkdir(parents=True)
    rng = np.random.default_rng(0)
    for k in range(n):
        rng.uniform(-20, 20, (30, 4)).astype("<f4").tofile(home / f"velodyne/{k:06d}.bin")
        for i in (0, 2):
            image(home / f"image_{i}/{k:06d}.png", k)
    (home / "times.txt").write_text("".join(f"{0.1 * k:.6e}\n" for k in range(n)))
    lines = [f"P{i}: {' '.join(f'{x:.12e}' for x in p.ravel())}" for i, p in enumerate(P)]
    (home / "calib.txt").write_text("\n".join([*lines, f"Tr: {' '.join(map(str, TR.ravel()))}"]) + "\n")
    (root / "poses").mkdir()
    (root / "poses/07.txt").write_text(kitti_poses(drive(n)))
    return home


def kitti_poses(T: np.ndarray) -> str:
    return "".join(" ".join(f"{x:.9e}" for x in pose[:3].ravel()) + "\n" for pose in T)


CAMERA_YAML = """#Default sensor yaml file
sensor_type: camera
comment: VI-Sensor cam0 (MT9M034)
T_BS:
  cols: 4
  rows: 4
  data: [0.0, -1.0, 0.0, -0.02,
         1.0, 0.0, 0.0, -0.06,
         0.0, 0.0, 1.0, 0.01,
         0.0, 0.0, 0.0, 1.0]
rate_hz: 20
resolution: [64, 48]
camera_model: pinhole
intrinsics: [45.8, 45.7, 36.7, 24.8] #fu, fv, cu, cv
distortion_model: radial-tangential
distortion_coefficients: [-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05]
"""
IMU_YAML = """sensor_type: imu
T_BS:
  cols: 4
  rows: 4
  data: [1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0]
rate_hz: 200
"""


def euroc(root: Path, n: int = 30) -> Path:
    """Two cameras, an Imu at 200 Hz, a tracker of positions, one of poses, and the estimated state."""
    home, ns = root / "mav0", [START + k * STEP for k in range(n)]
    for camera in ("cam0", "cam1"):
        for k, t in enumerate(ns):
            image(home / camera / f"data/{t}.png", k)
        table(home / camera, "#timestamp [ns],filename", [f"{t},{t}.png" for t in ns], CAMERA_YAML)
    quick = [START + k * 5_000_000 for k in range(20 * (n - 1))]
    rates = [f"{t},0.0,0.0,{0.2 + 0.01 * (k % 2)},0.1,0.2,{9.8 + 0.3 * (k % 3)}" for k, t in enumerate(quick)]
    table(home / "imu0", "#timestamp [ns],w_RS_S_x [rad s^-1],...", rates, IMU_YAML)
    T = drive(n)
    q = Rotation.from_matrix(T[:, :3, :3]).as_quat(scalar_first=True)
    poses = [",".join(map(repr, [t, *x.tolist()])) for t, x in zip(ns, np.hstack([T[:, :3, 3], q]), strict=True)]
    table(home / "vicon0", "#timestamp, p_RS_R_x [m], ...", poses, IMU_YAML)
    table(home / "state_groundtruth_estimate0", "#timestamp, ...", [p + ",0" * 9 for p in poses], IMU_YAML)
    positions = [",".join(map(repr, [t, *x.tolist()])) for t, x in zip(ns, T[:, :3, 3], strict=True)]
    table(home / "leica0", "#timestamp [ns], p_RS_R_x [m], ...", positions, IMU_YAML)
    return root


def table(folder: Path, titles: str, rows: list[str], description: str) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "data.csv").write_text("\n".join([titles, *rows]) + "\n")
    (folder / "sensor.yaml").write_text(description)


def tum(root: Path, n: int = 12) -> Path:
    """Colour and depth images at 30 Hz and poses at 100 Hz."""
    root.mkdir()
    stamps = [f"{1305031102.175304 + k / 30:.6f}" for k in range(n)]
    for part in ("rgb", "depth"):
        for k, s in enumerate(stamps):
            image(root / f"{part}/{s}.png", k, (640, 480))
        rows = "".join(f"{s} {part}/{s}.png\n" for s in stamps)
        (root / f"{part}.txt").write_text(f"# {part} images\n# timestamp filename\n{rows}")
    (root / "groundtruth.txt").write_text("# ground truth trajectory\n" + tum_poses(drive(3 * n), 1305031102.0, 0.01))
    (root / "accelerometer.txt").write_text("# timestamp ax ay az\n1305031102.1 0 0 9.8\n")
    return root


def tum_poses(T: np.ndarray, start: float, step: float) -> str:
    q = Rotation.from_matrix(T[:, :3, :3]).as_quat()
    rows = np.column_stack([start + step * np.arange(len(T)), T[:, :3, 3], q])
    return "".join(f"{r[0]:.6f} {' '.join(f'{x:.9f}' for x in r[1:])}\n" for r in rows)


def mutated(raw: bytes, rng: np.random.Generator) -> bytes:
    """Bytes cut short, with a part gone, or with some of them others."""
    data = bytearray(raw)
    kind, length = rng.integers(4), len(raw)
    if kind == 0:
        return bytes(data[: rng.integers(length)])
    if kind == 1:
        at = rng.integers(length)
        del data[at : at + rng.integers(1, 64)]
        return bytes(data)
    for _ in range(rng.integers(1, 8)):
        at = int(rng.integers(max(length - 4, 1)))
        if kind == 2:
            data[at] ^= 1 << int(rng.integers(8))
        else:
            words = [b"\xff" * 4, bytes(4), b"nan ", b"-1e9", b",,,,", b"\n\n  ", b"!!a ", b"../.", b"9999"]
            data[at : at + 4] = words[rng.integers(len(words))]
    return bytes(data)


def read_all(path: Path, plugins) -> None:
    """Everything that a drive says; refusals of single readings are as good."""
    log = open_log(path, plugins=plugins)
    for stream in log.streams.values():
        assert np.all(np.diff(stream.stamps) > 0)
        for k in range(len(stream)):
            with suppress(DataError):
                check(stream.readings[k])


def check(reading) -> None:
    """No reading holds what is not a number, unless that is what its type says."""
    for field in ("points", "T_world_sensor", "vec"):
        value = getattr(reading, field, None)
        assert value is None or np.isfinite(value).all(), field


def damaged(path: Path, plugins, count: int, seed: int = 0) -> tuple[int, int]:
    """How often a recording with one damaged file opened, and how often it was refused; nothing else may happen."""
    rng, refused = np.random.default_rng(seed), 0
    files = sorted(f for f in path.parent.rglob("*") if f.is_file())
    for _ in range(count):
        file = files[rng.integers(len(files))]
        raw = file.read_bytes()
        try:
            file.write_bytes(mutated(raw, rng))
            read_all(path, plugins)
        except DataError:
            refused += 1
        finally:
            file.write_bytes(raw)
    return count - refused, refused


CAMERA_INFO = """image_width: 64
image_height: 48
camera_name: cam
camera_matrix:
  rows: 3
  cols: 3
  data: [50.0, 0.0, 32.0, 0.0, 50.5, 24.0, 0.0, 0.0, 1.0]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [-0.2, 0.05, 0.001, -0.001, 0.0]
"""


def cloud(k: int, n: int = 60) -> np.ndarray:
    """Points with all that a driver tells, as rows of a table; times are offsets from the stamp."""
    rng = np.random.default_rng(k)
    kinds = [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4"), ("ring", "<u2"), ("time", "<f4")]
    rows = np.zeros(n, dtype=kinds)
    for name in "xyz":
        rows[name] = rng.uniform(-20, 20, n)
    rows["intensity"], rows["ring"], rows["time"] = rng.random(n), rng.integers(0, 16, n), np.linspace(0, 0.1, n)
    return rows


def pcd(file: Path, rows: np.ndarray, style: str = "binary") -> None:
    names = rows.dtype.names
    letters = {"f": "F", "u": "U", "i": "I"}
    head = [
        *("# .PCD v0.7", "VERSION 0.7", f"FIELDS {' '.join(names)}"),
        f"SIZE {' '.join(str(rows.dtype[n].itemsize) for n in names)}",
        f"TYPE {' '.join(letters[rows.dtype[n].kind] for n in names)}",
        *(f"COUNT {' '.join('1' * len(names))}", f"WIDTH {len(rows)}", "HEIGHT 1", "VIEWPOINT 0 0 0 1 0 0 0"),
        *(f"POINTS {len(rows)}", f"DATA {style}"),
    ]
    body = rows.tobytes() if style == "binary" else text(rows)
    file.write_bytes("\n".join(head).encode() + b"\n" + body)


def ply(file: Path, rows: np.ndarray, style: str = "binary_little_endian") -> None:
    kinds = {"f4": "float", "f8": "double", "u2": "ushort", "u1": "uchar", "i4": "int"}
    head = ["ply", f"format {style} 1.0", "comment made by hand", f"element vertex {len(rows)}"]
    head += [f"property {kinds[rows.dtype[n].str[1:]]} {n}" for n in rows.dtype.names]
    big = rows.astype(rows.dtype.newbyteorder(">"))
    body = {"ascii": text(rows), "binary_big_endian": big.tobytes()}.get(style, rows.tobytes())
    file.write_bytes("\n".join([*head, "element face 0", "end_header"]).encode() + b"\n" + body)


def text(rows: np.ndarray) -> bytes:
    return "".join(" ".join(repr(x.item()) for x in row) + "\n" for row in rows).encode()


def las(file: Path, rows: np.ndarray) -> None:
    import laspy

    header = laspy.LasHeader(point_format=1, version="1.2")
    header.scales = np.full(3, 1e-4)
    made = laspy.LasData(header)
    made.x, made.y, made.z = (rows[c].astype(float) for c in "xyz")
    made.intensity, made.gps_time = (rows["intensity"] * 60000).astype(np.uint16), 4e5 + rows["time"].astype(float)
    made.write(file)


def folder(root: Path, n: int = 12) -> Path:
    """Clouds of every kind, a camera, a ladybug, fixes and poses, named by their stamps."""
    ns = [START + k * STEP for k in range(n)]
    (root / "top").mkdir(parents=True)
    for k, t in enumerate(ns):
        pcd(root / f"top/{t}.pcd", cloud(k), "ascii" if k % 2 else "binary")
        image(root / f"front/{t // 10**9}.{t % 10**9:09d}.png", k)
    (root / "front/camera_info.yaml").write_text(CAMERA_INFO)
    for suffix, write in ((".ply", ply), (".npy", np.save), (".las", las), (".laz", las)):
        home = root / f"lidar_{suffix[1:]}"
        home.mkdir()
        for k in range(n):
            write(home / f"{k}{suffix}", cloud(k))
        (home / "times.txt").write_text("".join(f"{t / 1e9:.6f}\n" for t in ns))
    for head in range(3):
        for k in range(n):
            image(root / f"ladybug/head{head}/{k:04d}.png", k)
        (root / f"ladybug/head{head}/camera_info.yaml").write_text(CAMERA_INFO)
    (root / "ladybug/timestamps.txt").write_text("".join(f"{t}\n" for t in ns))
    poses = tum_poses(drive(n), START / 1e9, 0.1)
    (root / "slam.txt").write_text(poses)
    rows = [w.split() for w in poses.splitlines()]
    order = [0, 7, 4, 5, 6, 1, 2, 3]
    lines = [",".join(r[i] for i in order) for r in rows]
    (root / "vo.csv").write_text("\n".join(["time,qw,qx,qy,qz,px,py,pz", *lines]) + "\n")
    titles = "stamp,lat_deg,lon_deg,alt,roll_deg,pitch_deg,yaw_deg"
    fixes = [f"{t / 1e9:.3f},49.0,{8.4 + 1e-6 * k},110.0,0.1,0.2,{90 + k}" for k, t in enumerate(ns)]
    (root / "gps.csv").write_text("\n".join([titles, *fixes]) + "\n")
    (root / "README.txt").write_text("a drive\n")
    return root
