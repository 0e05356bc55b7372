"""Bags made by hand: one message of each type, and a small drive of them in every storage."""

import numpy as np

from calib_toolkit import ReadContext
from calib_toolkit_datasets.bags import log as bags
from calib_toolkit_datasets.bags.messages import encode, types

START, STEP = 1_700_000_000 * 10**9, 100_000_000
STORAGES = ["rosbag1", "sqlite", "mcap"]
PACKED = [
    *((s, None) for s in STORAGES),
    ("rosbag1", "bz2"),
    ("rosbag1", "lz4"),
    ("sqlite", "zstd"),
    ("mcap", "zstd"),
]


class Messages:
    """Standard messages of ROS 1 (``ros1``) or ROS 2 (``cdr``)."""

    def __init__(self, encoding):
        self.encoding, self.store = encoding, types(encoding)

    def make(self, kind, *values):
        package, name = kind.split("/")
        return self.store.types[f"{package}/msg/{name}"](*values)

    def header(self, ns, frame=""):
        stamp = self.make("builtin_interfaces/Time", ns // 10**9, ns % 10**9)
        return self.make("std_msgs/Header", *((0,) if self.encoding == "ros1" else ()), stamp, frame)

    def cloud(self, ns, table, frame="velo", big=False, step=None, row=None, height=1, data=None):
        table = table.astype(table.dtype.newbyteorder(">")) if big else table
        numbers = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}
        fields = [
            self.make("sensor_msgs/PointField", n, table.dtype.fields[n][1], numbers[table.dtype[n].str[1:]], 1)
            for n in table.dtype.names
        ]
        size, width = table.dtype.itemsize, len(table) // height
        raw = np.frombuffer(table.tobytes(), np.uint8) if data is None else data
        return self.make(
            "sensor_msgs/PointCloud2",
            *(self.header(ns, frame), height, width, fields, big, step or size, row or size * width, raw, True),
        )

    def image(self, ns, pixels, encoding, frame="cam0", big=False, step=None):
        h, w = pixels.shape[:2]
        raw = np.frombuffer(pixels.tobytes(), np.uint8)
        step = step or raw.size // h
        return self.make("sensor_msgs/Image", self.header(ns, frame), h, w, encoding, int(big), step, raw)

    def compressed(self, ns, raw, style="jpeg", frame="cam0"):
        raw = np.frombuffer(raw, np.uint8)
        return self.make("sensor_msgs/CompressedImage", self.header(ns, frame), style, raw)

    def info(self, ns, K, D=(), model="plumb_bob", size=(64, 48), frame="cam0", binning=0):
        roi = self.make("sensor_msgs/RegionOfInterest", 0, 0, 0, 0, False)
        P = np.column_stack([K, np.zeros(3)]).ravel()
        D = np.array(D, float)
        return self.make(
            "sensor_msgs/CameraInfo",
            *(self.header(ns, frame), size[1], size[0], model, D, np.ravel(K).astype(float), np.eye(3).ravel(), P),
            *(binning, binning, roi),
        )

    def fix(self, ns, lat, lon, alt, sigma=(0.02, 0.02, 0.05), status=0, frame="ins"):
        covariance = np.diag(np.square(sigma)).ravel().astype(float)
        made = self.make("sensor_msgs/NavSatStatus", status, 1)
        return self.make("sensor_msgs/NavSatFix", self.header(ns, frame), made, lat, lon, alt, covariance, 2)

    def imu(self, ns, quaternion=None, rate=(0.0, 0.0, 0.0), acceleration=(0.0, 0.0, 0.0), frame="ins"):
        vector, unknown = (lambda v: self.make("geometry_msgs/Vector3", *map(float, v))), np.zeros(9)
        stated = np.array([-1.0, *np.zeros(8)]) if quaternion is None else np.diag([1e-6] * 3).ravel()
        q = self.make("geometry_msgs/Quaternion", *map(float, quaternion if quaternion is not None else (0, 0, 0, 0)))
        return self.make(
            "sensor_msgs/Imu", self.header(ns, frame), q, stated, vector(rate), unknown, vector(acceleration), unknown
        )

    def pose(self, ns, t, quaternion=(0.0, 0.0, 0.0, 1.0), cov=None, child="base"):
        point = self.make("geometry_msgs/Point", *map(float, t))
        pose = self.make("geometry_msgs/Pose", point, self.make("geometry_msgs/Quaternion", *map(float, quaternion)))
        zero, vector = np.zeros(36), (lambda: self.make("geometry_msgs/Vector3", 0.0, 0.0, 0.0))
        return self.make(
            "nav_msgs/Odometry",
            *(self.header(ns, "world"), child),
            self.make("geometry_msgs/PoseWithCovariance", pose, zero if cov is None else np.ravel(cov).astype(float)),
            self.make(
                "geometry_msgs/TwistWithCovariance", self.make("geometry_msgs/Twist", vector(), vector()), zero
            ),
        )

    def transform(self, parent, child, t, quaternion=(0.0, 0.0, 0.0, 1.0)):
        moved = self.make(
            "geometry_msgs/Transform",
            self.make("geometry_msgs/Vector3", *map(float, t)),
            self.make("geometry_msgs/Quaternion", *map(float, quaternion)),
        )
        return self.make("geometry_msgs/TransformStamped", self.header(START, parent), child, moved)

    def frames(self, *transforms):
        return self.make("tf2_msgs/TFMessage", list(transforms))


def write(path, storage, messages, compression=None, arrived=None):
    """A bag of ``(topic, ns, message)``; storage: rosbag1, sqlite or mcap (a folder)."""
    from rosbags.rosbag1 import Writer as Writer1
    from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

    encoding = "ros1" if storage == "rosbag1" else "cdr"
    if storage == "rosbag1":
        writer = Writer1(path)
        if compression:
            writer.set_compression(getattr(Writer1.CompressionFormat, compression.upper()))
    else:
        plugin = StoragePlugin.MCAP if storage == "mcap" else StoragePlugin.SQLITE3
        writer = Writer(path, version=9, storage_plugin=plugin)
        if compression:
            mode = CompressionMode.STORAGE if storage == "mcap" else CompressionMode.MESSAGE
            writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer as bag:
        connections = {}
        for topic, ns, message in messages:
            if topic not in connections:
                connections[topic] = bag.add_connection(topic, message.__msgtype__, typestore=types(encoding))
            bag.write(connections[topic], arrived(ns) if arrived else ns, encode(message, encoding))
    return path


def points(rng, n=50, **columns):
    """A table of x, y, z and other columns by name."""
    kinds = [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), *((k, v.dtype.str) for k, v in columns.items())]
    table = np.zeros(n, dtype=kinds)
    for name in "xyz":
        table[name] = rng.uniform(-20, 20, n)
    for name, values in columns.items():
        table[name] = values
    return table


def drive(encoding, n=8, size=40):
    """Messages of n sweeps of so many points, and of a camera, an INS and an odometry beside them."""
    m, rows, rng = Messages(encoding), [], np.random.default_rng(4)
    K = np.array([[60.0, 0, 8], [0, 60, 6], [0, 0, 1]])
    rows.append(("/tf_static", START, m.frames(m.transform("velo", "cam0", (1, 0, 0)))))
    for k in range(n):
        ns = START + k * STEP
        pixels = rng.integers(0, 255, (12, 16, 3)).astype(np.uint8)
        rows += [
            ("/velo/points", ns, m.cloud(ns, points(rng, size, time=np.linspace(0, 0.09, size, dtype="f4")))),
            ("/cam0/image_raw", ns + 7, m.image(ns + 7, pixels, "bgr8")),
            ("/cam0/camera_info", ns + 7, m.info(ns + 7, K, size=(16, 12))),
            ("/ins/fix", ns, m.fix(ns, 49 + 1e-5 * k, 8.4, 100.0)),
            ("/ins/imu", ns, m.imu(ns, (0, 0, 0.1, np.sqrt(0.99)))),
            ("/odom", ns, m.pose(ns, (k, 0, 0))),
        ]
    return rows


def made(path, storage, compression=None, n=8, size=40):
    """A bag of a drive."""
    return write(path, storage, drive("ros1" if storage == "rosbag1" else "cdr", n, size), compression)


def plain(folder):
    """The file in a ROS 2 bag's folder."""
    (file,) = [f for f in folder.iterdir() if f.suffix in (".db3", ".mcap")]
    return file


def opened(path):
    """What is read of a bag, a ROS 1 bag if it is a file."""
    opens = bags.open_bag1 if path.is_file() else bags.open_bag2
    return opens(path, ReadContext({}, lambda _: None))
