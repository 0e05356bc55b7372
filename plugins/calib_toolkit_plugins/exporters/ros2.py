"""ROS 2: static transforms, as the YAML of a ``tf2_msgs/TFMessage`` and as a launch file that publishes them."""

import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any
from xml.sax.saxutils import quoteattr

from calib_toolkit import Calibration, CameraIntrinsics, Exporter, hookimpl
from calib_toolkit.errors import DataError
from calib_toolkit_plugins.exporters import clocks, files, poses

FRAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_/.-]*")
"""What tf and the arguments of a launch file take alike."""


@hookimpl
def calib_register_exporters() -> list[Exporter]:
    """The ``ros2`` exporter."""
    looks_for = "YAML with child_frame_id, such as ros2 topic echo /tf_static prints"
    return [Exporter("ros2", write, read, looks_for, matches, "sigmas, which sensors are cameras")]


def matches(path: Path) -> bool:
    """Whether a file is YAML of stamped transforms."""
    return bool(re.search(r"^\s*(- )?child_frame_id\s*:", files.head(path), re.MULTILINE))


def write(c: Calibration, path: Path, intrinsics: Mapping[str, CameraIntrinsics]) -> None:
    """``FILE.yaml``, ``FILE.launch.xml`` and the clock offsets. Raises DataError for names that tf does not take."""
    for name in c.names:
        if not FRAME.fullmatch(name):
            raise DataError(
                f"ROS has no frame called {name!r}: letters, digits and _ / . - are allowed, and it must not begin "
                "with / . or -; rename the sensor"
            )
    transforms = [(name, c.T_base_sensor[i]) for i, name in enumerate(c.names) if name != c.base]
    sentences = [
        "Static transforms of a rig",
        "Each maps points of child_frame_id to header.frame_id, as tf has it: " + poses.direction(c) + ".",
        "Metres; quaternions x y z w; the frame of a camera is its optical one (x right, y down, z ahead).",
        clocks.sentence(path),
        "Publish with: ros2 launch ./" + path.with_suffix(".launch.xml").name,
    ]
    files.write_yaml(path, sentences, {"transforms": [_message(c.base, name, T) for name, T in transforms]})
    nodes = "".join(f"  <node pkg={quoteattr('tf2_ros')} {_node(c.base, name, T)}/>\n" for name, T in transforms)
    comment = "".join(f"  <!-- {s} -->\n" for s in [f"{sentences[0]}, {files.WRITTEN}.", *sentences[1:4]])
    launch = f"<launch>\n{comment}{nodes}</launch>\n"
    path.with_suffix(".launch.xml").write_text(launch, encoding="utf-8")
    clocks.write(c, path)


def read(path: Path) -> Calibration:
    """Every frame of a file of stamped transforms, in the one that has no parent. Raises DataError."""
    edges = [_edge(path, message) for message in _messages(path, files.load_yaml(path))]
    return clocks.read(poses.from_tree(path, edges), path)


def _message(parent: str, child: str, T: poses.Array) -> dict[str, Any]:
    return {
        "header": {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": parent},
        "child_frame_id": child,
        "transform": {
            "translation": dict(zip("xyz", T[:3, 3].tolist(), strict=True)),
            "rotation": dict(zip("xyzw", poses.quaternion_xyzw(T), strict=True)),
        },
    }


def _node(parent: str, child: str, T: poses.Array) -> str:
    numbers = zip(
        ("x", "y", "z", "qx", "qy", "qz", "qw"), [*T[:3, 3].tolist(), *poses.quaternion_xyzw(T)], strict=True
    )
    given = " ".join(f"--{key} {value!r}" for key, value in numbers)
    args = f"{given} --frame-id {parent} --child-frame-id {child}"
    name = re.sub(r"[^A-Za-z0-9_]", "_", f"tf_{parent}_{child}")
    return f"exec={quoteattr('static_transform_publisher')} name={quoteattr(name)} args={quoteattr(args)}"


def _messages(file: Path, content: Any) -> Iterator[Any]:
    """Those of one TFMessage, of many, or of a bare list."""
    for part in content if isinstance(content, list) else [content]:
        if isinstance(part, dict) and "transforms" in part:
            if not isinstance(part["transforms"], list):
                raise DataError(f"{file}: transforms is not a list; correct it")
            yield from part["transforms"]
        else:
            yield part


def _edge(file: Path, message: Any) -> poses.Edge:
    child = files.name(file, "child_frame_id", files.entry(file, "a transform", message, "child_frame_id"))
    header = files.entry(file, child, message, "header")
    parent = files.name(file, f"frame_id of {child}", files.entry(file, f"the header of {child}", header, "frame_id"))
    transform = files.entry(file, child, message, "transform")
    shift, turn = (files.entry(file, child, transform, key) for key in ("translation", "rotation"))
    t = [files.number(file, f"{k} of {child}", files.entry(file, f"translation of {child}", shift, k)) for k in "xyz"]
    q = [files.number(file, f"q{k} of {child}", files.entry(file, f"rotation of {child}", turn, k)) for k in "xyzw"]
    return parent, child, poses.from_quaternion(file, child, q, t)
