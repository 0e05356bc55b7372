"""URDF: one link for each sensor, named like it, on fixed joints."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any
from xml.etree import ElementTree
from xml.sax.saxutils import quoteattr

from calib_toolkit import Calibration, CameraIntrinsics, Exporter, hookimpl
from calib_toolkit.errors import DataError
from calib_toolkit_plugins.exporters import clocks, files, poses


@hookimpl
def calib_register_exporters() -> list[Exporter]:
    """The ``urdf`` exporter."""
    loses = "sigmas, which sensors are cameras"
    return [Exporter("urdf", write, read, "XML with a <robot>", matches, loses)]


def matches(path: Path) -> bool:
    """Whether a file is XML of a robot."""
    return "<robot" in files.head(path)


def write(c: Calibration, path: Path, intrinsics: Mapping[str, CameraIntrinsics]) -> None:
    """A robot whose root is the base; clock offsets beside it."""
    sentences = [
        f"A rig, {files.WRITTEN}.",
        f"The origin of a joint maps points of its child to its parent: {poses.direction(c)}.",
        "Metres and radians; rpy turn about fixed axes, Rz(yaw) Ry(pitch) Rx(roll).",
        "The link of a camera is its optical frame (x right, y down, z ahead).",
        clocks.sentence(path),
    ]
    lines = ['<?xml version="1.0" encoding="utf-8"?>']
    lines += [f"<!-- {s.replace('--', '- -')} -->" for s in sentences]
    lines += ['<robot name="rig">', *(f"  <link name={quoteattr(n)}/>" for n in c.names)]
    for name, T in zip(c.names, c.T_base_sensor, strict=True):
        if name != c.base:
            xyz, rpy = (" ".join(map(repr, numbers)) for numbers in (T[:3, 3].tolist(), poses.to_rpy(T)))
            lines += [
                f'  <joint name={quoteattr(f"{c.base}_to_{name}")} type="fixed">',
                f"    <parent link={quoteattr(c.base)}/>",
                f"    <child link={quoteattr(name)}/>",
                f'    <origin xyz="{xyz}" rpy="{rpy}"/>',
                "  </joint>",
            ]
    path.write_text("\n".join([*lines, "</robot>", ""]), encoding="utf-8")
    clocks.write(c, path)


def read(path: Path) -> Calibration:
    """Every link that hangs on the root by fixed joints, in the root. Raises DataError."""
    robot = _robot(path)
    joints = [j for j in robot.findall("joint") if j.find("parent") is not None or j.find("child") is not None]
    ends = [(_link(path, joint, "parent"), _link(path, joint, "child")) for joint in joints]
    fixed = {child: joint for joint, (_, child) in zip(joints, ends, strict=True) if joint.get("type") == "fixed"}
    # what hangs on a joint that moves has no one place, nor has what hangs on that
    moving = {child for _, child in ends if child not in fixed}
    while more := {child for parent, child in ends if parent in moving} - moving:
        moving |= more
    edges = [
        (parent, child, _origin(path, child, joint))
        for joint, (parent, child) in zip(joints, ends, strict=True)
        if child not in moving
    ]
    return clocks.read(poses.from_tree(path, edges), path)


def _robot(file: Path) -> Any:
    content = files.text(file)
    if "<!DOCTYPE" in content or "<!ENTITY" in content:
        raise DataError(f"{file} defines entities, which a URDF has no use for; remove its DOCTYPE")
    if "xmlns:xacro" in content and "<xacro:" in content:
        raise DataError(f"{file} is a xacro; turn it into a URDF first: xacro {file.name} > rig.urdf")
    try:
        robot = ElementTree.fromstring(content.encode())
    except (ElementTree.ParseError, ValueError, LookupError) as e:
        raise DataError(f"{file} is not whole XML ({e}); correct it or fetch it again") from e
    if robot.tag != "robot":
        raise DataError(f"{file} holds <{robot.tag}>, and not a <robot>; name a URDF")
    return robot


def _link(file: Path, joint: Any, end: str) -> str:
    found = joint.find(end)
    what = f"the {end} of joint {joint.get('name')}"
    return files.name(file, what, None if found is None else found.get("link"))


def _origin(file: Path, child: str, joint: Any) -> poses.Array:
    """An origin, or a part of it, that is not there is zero."""
    origin = joint.find("origin")
    given = {} if origin is None else origin.attrib
    xyz, rpy = (_three(file, f"{key} of {child}", given.get(key, "0 0 0")) for key in ("xyz", "rpy"))
    return poses.from_rpy(xyz, rpy)


def _three(file: Path, what: str, words: str) -> list[float]:
    try:
        values: Any = [float(w) for w in words.split()]
    except ValueError:
        values = words
    return files.numbers(file, what, values, 3)
