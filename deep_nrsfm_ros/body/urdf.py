# SPDX-License-Identifier: Apache-2.0
"""The URDF of an object with a kinematic tree, and the capsules that draw a URDF.

Each angle is a revolute joint with its name; the links between the angles of one joint have the
names of the angles, and the last link has the name of the joint, which is that of its frame.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from html import escape
from typing import Any, NamedTuple
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from deep_nrsfm_ros.body.kinematic_tree import KinematicTree
from deep_nrsfm_ros.nrsfm.geometry import rotation_from_vector

Floats = NDArray[Any]

THICKNESS = 0.12
"""Radius of the bones, relative to the median length of the bones."""
_LIMIT = 3.1416  # of angles, radians: they are measured, not commanded
_COLOUR = "0.2 0.6 1.0 1.0"
_MAX_JOINTS = 10_000


class Capsule(NamedTuple):
    """A cylinder with half spheres at its ends, or a sphere where both ends are one point.

    Attributes:
        link: name of the link that it belongs to.
        start: (3,) one end of the axis, in the axes and unit of the URDF's root link.
        end: (3,) the other end.
        radius: of cylinder and half spheres.
    """

    link: str
    start: Floats
    end: Floats
    radius: float


def rep155_name(identity: str) -> Callable[[str], str]:
    """Return the function from names of a tree to those of REP-155 for a body: `l_elbow_<id>`."""

    def rename(name: str) -> str:
        side, _, part = name.partition("_")
        short = f"{side[0]}_{part}" if side in ("left", "right") and part else name
        return f"{short}_{identity}"

    return rename


def urdf(
    tree: KinematicTree,
    offsets: Floats,
    name: str = "object",
    rename: Callable[[str], str] = str,
) -> str:
    """Return the URDF of an object as text.

    Args:
        tree: of its layout.
        offsets: (j, 3) as `KinematicTree.offsets` returns them, in metres: the lengths of its
            bones.
        name: of the robot in the URDF.
        rename: from names of joints and angles to those in the URDF, as `rep155_name` gives it.
    """
    lengths = np.linalg.norm(offsets[1:], axis=1)
    bones = lengths[lengths > 0]
    radius = THICKNESS * float(np.median(bones)) if bones.size else 0.01
    visuals: dict[int, list[str]] = {i: [] for i in range(len(tree))}
    for i, parent in enumerate(tree.parents):
        if parent >= 0 and np.linalg.norm(offsets[i]) > 1e-6:
            visuals[parent] += _bone(offsets[i], radius)
    lines = ['<?xml version="1.0"?>', f"<robot name={_quoted(name)}>"]
    for i, joint in enumerate(tree.joints):
        link = rename(joint.name)
        if tree.parents[i] >= 0:
            above, xyz = rename(tree.names[tree.parents[i]]), _numbers(offsets[i])
            columns = [a for a, owner in enumerate(tree.angle_joints) if owner == i]
            for column in columns:
                angle, last = rename(tree.angle_names[column]), column == columns[-1]
                child = link if last else angle
                if not last:
                    lines.append(f"  <link name={_quoted(child)}/>")
                lines += _joint(angle, above, child, xyz, tree.angle_axes[column])
                above, xyz = child, "0 0 0"
            if not columns:
                lines += _joint(link, above, link, xyz, None)
        lines.append(f"  <link name={_quoted(link)}>")
        lines += [*visuals[i], "  </link>"]
    return "\n".join([*lines, "</robot>", ""])


_SPACES = {ord(space): f"&#{ord(space)};" for space in "\t\n\r"}  # else read as blanks


def _quoted(text: str) -> str:
    """Return the value of an attribute in XML.

    It stands for xml.sax.saxutils.quoteattr, which imports a web client and delays the start.
    """
    return f'"{escape(text).translate(_SPACES)}"'


def _numbers(values: Any) -> str:
    """Return numbers as URDF has them."""
    return " ".join(f"{value + 0.0:.5g}" for value in values)


def _joint(name: str, parent: str, child: str, xyz: str, axis: Floats | None) -> list[str]:
    """Return the lines of a joint about an axis, or of a fixed one."""
    kind = '"fixed"' if axis is None else '"revolute"'
    lines = [
        f"  <joint name={_quoted(name)} type={kind}>",
        f"    <parent link={_quoted(parent)}/>",
        f"    <child link={_quoted(child)}/>",
        f'    <origin xyz="{xyz}" rpy="0 0 0"/>',
    ]
    if axis is not None:
        lines.append(f'    <axis xyz="{_numbers(axis)}"/>')
        lines.append(
            f'    <limit lower="-{_LIMIT}" upper="{_LIMIT}" effort="1000" velocity="100"/>'
        )
    return [*lines, "  </joint>"]


def _bone(end: Floats, radius: float) -> list[str]:
    """Return the visuals of a bone from the origin to `end`: a cylinder and a sphere at its end."""
    length = float(np.linalg.norm(end))
    x, y, z = (end / length).tolist()
    rpy = _numbers((0.0, math.acos(max(-1.0, min(1.0, z))), math.atan2(y, x)))
    cylinder = f'<cylinder length="{length:.5g}" radius="{radius:.4g}"/>'
    shapes = ((cylinder, end / 2, rpy), (f'<sphere radius="{radius:.4g}"/>', end, "0 0 0"))
    return [
        f'    <visual><origin xyz="{_numbers(at)}" rpy="{turned}"/><geometry>{shape}</geometry>'
        f'<material name="bone"><color rgba="{_COLOUR}"/></material></visual>'
        for shape, at, turned in shapes
    ]


class _UrdfJoint(NamedTuple):
    """A joint of a parsed URDF: names of its links, transform at angle 0, axis."""

    name: str
    parent: str
    child: str
    origin: Floats  # (4, 4)
    axis: Floats | None


class UrdfDrawing:
    """The capsules of a URDF that has cylinders and spheres, in any pose.

    Attributes:
        root: name of the root link.
        angle_names: names of the joints that turn, in the order of the file.
    """

    def __init__(self, text: str) -> None:
        """Parse a URDF.

        Raises:
            ValueError: the text is no URDF of a single tree.
        """
        if "<!DOCTYPE" in text or "<!ENTITY" in text:  # entities may grow without bound
            raise ValueError("a URDF with a document type is not read")
        try:
            robot = ElementTree.fromstring(text)
        except ElementTree.ParseError as error:
            raise ValueError(f"text is no URDF: {error}") from error
        links = {link.get("name", ""): link for link in robot.findall("link")}
        joints = [_parse_joint(joint) for joint in robot.findall("joint")]
        roots = set(links) - {joint.child for joint in joints}
        if len(roots) != 1 or len(joints) > _MAX_JOINTS:
            raise ValueError(f"a URDF has one root link; this one has {len(roots)}")
        (self.root,) = roots
        self.angle_names = tuple(joint.name for joint in joints if joint.axis is not None)
        self._joints = _sorted(joints, self.root)
        self._shapes = {name: _parse_visuals(link) for name, link in links.items()}

    def frames(self, angles: Mapping[str, float]) -> dict[str, Floats]:
        """Return the transform (4, 4) from each link to the root link.

        Args:
            angles: name of a joint -> angle in radians; 0 for others.
        """
        frames = {self.root: np.eye(4)}
        for joint in self._joints:
            frame = frames[joint.parent] @ joint.origin
            if joint.axis is not None:
                turn = np.eye(4)
                turn[:3, :3] = rotation_from_vector(angles.get(joint.name, 0.0) * joint.axis)
                frame = frame @ turn
            frames[joint.child] = frame
        return frames

    def capsules(self, angles: Mapping[str, float]) -> list[Capsule]:
        """Return the capsules in the root link's axes; arguments as in `frames`."""
        frames = self.frames(angles)
        return [
            Capsule(link, (frames[link] @ ends)[:3, 0], (frames[link] @ ends)[:3, 1], radius)
            for link, shapes in self._shapes.items()
            for ends, radius in shapes
        ]


def _sorted(joints: list[_UrdfJoint], root: str) -> list[_UrdfJoint]:
    """Return the joints with parents first; raise ValueError if they are no tree."""
    known, result = {root}, []
    while joints:
        ready = [joint for joint in joints if joint.parent in known]
        if not ready:
            raise ValueError(f"URDF has joint {joints[0].name!r} outside the tree")
        result += ready
        known |= {joint.child for joint in ready}
        joints = [joint for joint in joints if joint not in ready]
    return result


def _parse_joint(joint: ElementTree.Element) -> _UrdfJoint:
    """Return a joint of a URDF."""
    parent, child, axis = joint.find("parent"), joint.find("child"), joint.find("axis")
    kind = joint.get("type")
    if parent is None or child is None or kind not in ("fixed", "revolute", "continuous"):
        raise ValueError(f"URDF has joint {joint.get('name')!r} without links or of type {kind!r}")
    turns = None
    if kind != "fixed":
        turns = _vector(axis, "xyz", "1 0 0")
        turns = turns / np.linalg.norm(turns)
    names = joint.get("name", ""), parent.get("link", ""), child.get("link", "")
    return _UrdfJoint(*names, _origin(joint), turns)


def _vector(element: ElementTree.Element | None, name: str, default: str) -> Floats:
    """Return three numbers of an attribute."""
    text = default if element is None else element.get(name, default)
    values = np.array([float(word) for word in text.split()])
    if values.shape != (3,) or not np.isfinite(values).all():
        raise ValueError(f"URDF has {text[:60]!r} for {name}; it must be three numbers")
    return values


def _origin(element: ElementTree.Element) -> Floats:
    """Return the transform (4, 4) of the origin of a joint or visual."""
    origin = element.find("origin")
    roll, pitch, yaw = _vector(origin, "rpy", "0 0 0")
    x, y, z = np.eye(3)
    T = np.eye(4)
    T[:3, :3] = (
        rotation_from_vector(yaw * z)
        @ rotation_from_vector(pitch * y)
        @ rotation_from_vector(roll * x)
    )
    T[:3, 3] = _vector(origin, "xyz", "0 0 0")
    return T


def _parse_visuals(link: ElementTree.Element) -> list[tuple[Floats, float]]:
    """Return ends (4, 2) and radius of each cylinder and sphere of a link."""
    shapes = []
    for visual in link.findall("visual"):
        for shape in visual.findall("geometry/*"):
            if shape.tag in ("cylinder", "sphere"):
                half = float(shape.get("length", "0")) / 2
                ends = np.array([[0, 0, -half, 1], [0, 0, half, 1]], float).T
                shapes.append((_origin(visual) @ ends, float(shape.get("radius", "0"))))
    return shapes
