# SPDX-License-Identifier: Apache-2.0
"""Definitions of message types: that of the bag, or where it carries none, one that is known here.

A bag carries no definitions before ROS 2 Iron, and an empty one where the recorder did not find the
package of the type. Then the installed package is used (`share/PACKAGE/msg/TYPE.msg` in the
folders of AMENT_PREFIX_PATH), or a definition of a well-known detector that comes with this one.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator
from functools import cache, lru_cache
from pathlib import Path
from typing import Any

from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

Types = dict[str, Any]
"""Name of a type, e.g. "std_msgs/msg/Header", to its fields, as rosbags has them."""

_HEADER = "std_msgs/msg/Header"

DETECTORS = {
    # yolo_ros 4.6
    "yolo_msgs/msg/Point2D": "float64 x\nfloat64 y",
    "yolo_msgs/msg/Vector2": "float64 x\nfloat64 y",
    "yolo_msgs/msg/Pose2D": "yolo_msgs/Point2D position\nfloat64 theta",
    "yolo_msgs/msg/BoundingBox2D": "yolo_msgs/Pose2D center\nyolo_msgs/Vector2 size",
    "yolo_msgs/msg/BoundingBox3D": (
        "geometry_msgs/Pose center\ngeometry_msgs/Vector3 size\nstring frame_id"
    ),
    "yolo_msgs/msg/Mask": "int32 height\nint32 width\nyolo_msgs/Point2D[] data",
    "yolo_msgs/msg/KeyPoint2D": "int32 id\nyolo_msgs/Point2D point\nfloat64 score",
    "yolo_msgs/msg/KeyPoint2DArray": "yolo_msgs/KeyPoint2D[] data",
    "yolo_msgs/msg/KeyPoint3D": "int32 id\ngeometry_msgs/Point point\nfloat64 score",
    "yolo_msgs/msg/KeyPoint3DArray": "yolo_msgs/KeyPoint3D[] data\nstring frame_id",
    "yolo_msgs/msg/Detection": (
        "int32 class_id\nstring class_name\nfloat64 score\nstring id\n"
        "yolo_msgs/BoundingBox2D bbox\nyolo_msgs/BoundingBox3D bbox3d\nyolo_msgs/Mask mask\n"
        "yolo_msgs/KeyPoint2DArray keypoints\nyolo_msgs/KeyPoint3DArray keypoints3d"
    ),
    "yolo_msgs/msg/DetectionArray": "std_msgs/Header header\nyolo_msgs/Detection[] detections",
    # hri_msgs (REP-155); its constants take no bytes
    "hri_msgs/msg/NormalizedPointOfInterest2D": "float32 x\nfloat32 y\nfloat32 c",
    "hri_msgs/msg/Skeleton2D": (
        "std_msgs/Header header\nhri_msgs/NormalizedPointOfInterest2D[18] skeleton"
    ),
}
"""Definitions of detectors whose messages are read without a field mapping."""

_IDL = "=" * 80 + "\nIDL: "  # before each definition in .idl format


@cache
def ros2_types() -> Typestore:
    """Return the types of ROS 2 itself.

    They are made at the first call, since they take 0.2 s and a node that opens no bag needs none.
    """
    return get_typestore(Stores.ROS2_JAZZY)


class DefinitionError(ValueError):
    """The definition of a type is unknown, or is not the recorded one."""


def find_types(name: str, text: str, type_hash: str) -> tuple[Typestore, str]:
    """Return a store with the definition of a type, by which its messages are decoded.

    The second result says where the definition is from in words; "" for that of the bag, and for
    one that the hash proves to be the recorded one.

    Args:
        name: of the type, e.g. "yolo_msgs/msg/DetectionArray".
        text: the definition in the bag, in .msg or .idl format; "" if there is none.
        type_hash: hash of the recorded definition (RIHS01); "" if unknown.

    Raises:
        DefinitionError: the bag's definition is unreadable and no other one is known, or all that
            are known have another hash.
    """
    problem = "does not carry the definition of"
    if text:
        try:
            return _of_bag(name, text, os.environ.get("AMENT_PREFIX_PATH", "")), ""
        except Exception as error:  # a damaged definition fails in many ways
            problem = f"has no readable definition ({error!r}) of"
    differing = ""
    origins = (
        ("of ROS 2 Jazzy", _of_ros2),
        ("that is installed", _installed),
        ("that comes with this package", _shipped),
    )
    for origin, find in origins:
        try:
            store = _store(name, find)
        except Exception:  # an installed file fails in many ways; try the next origin
            continue
        if type_hash and store.hash_rihs01(name) != type_hash:
            differing = differing or origin
            continue
        return store, "" if type_hash else origin
    kind, package = name.replace("/msg/", "/"), name.split("/")[0]
    if differing:
        raise DefinitionError(
            f"{problem} {kind}, and the definition {differing} is not the recorded one: its hash "
            f"differs; source the version of {package} with which it was recorded"
        )
    raise DefinitionError(
        f"{problem} {kind}, and {package} is not installed here: source a workspace with "
        f"{package} (AMENT_PREFIX_PATH)"
    )


@lru_cache(maxsize=16)
def _of_bag(name: str, text: str, prefixes: str) -> Typestore:
    """Return a store with the definition of a bag; raise any exception.

    The store is kept, since parsing takes some 25 ms and many bags have the same definition. What
    the definition lacks may come from packages installed in the folders `prefixes`.
    """
    return _store(name, lambda wanted: _parse(text, name))


def ros1_types(name: str, text: str) -> Typestore:
    """Return a store with a type of a ROS 1 bag, which converts its messages by `ros1_to_cdr`.

    Its header is that of ROS 2, which has no `seq`: rosbags leaves that out.

    Raises:
        DefinitionError: the definition in the bag is unreadable.
    """
    try:
        types = _parse(text, name)
        if name != _HEADER:
            types.pop(_HEADER, None)
        return _store(name, lambda wanted: types)
    except Exception as error:  # a damaged definition fails in many ways
        raise DefinitionError(f"has no readable definition ({error!r}) of {name}") from None


def _store(name: str, find: Callable[[str], Types]) -> Typestore:
    """Return a store with a type and all that it consists of; raise any exception if one lacks."""
    types: Types = {}
    missing = {name}
    while missing:
        wanted = missing.pop()
        for source in (find, _of_ros2, _installed, _shipped):
            found = source(wanted)
            if wanted in found:
                types = found | types
                break
            if wanted == name:
                raise ValueError("it defines other types")
        else:
            raise ValueError(f"{wanted} is not defined")
        missing = {part for each in types.values() for part in _parts(each)} - types.keys()
    store = get_typestore(Stores.EMPTY)
    store.register(types)
    return store


def _parts(definition: Any) -> Iterator[str]:
    """Yield the names of the types of the fields of a definition."""
    for _, (node, detail) in definition[1]:
        if node.name in ("ARRAY", "SEQUENCE"):
            node, detail = detail[0]
        if node.name == "NAME":
            yield detail


def _parse(text: str, name: str) -> Types:
    """Return the types of a definition in .msg or .idl format; raise any exception."""
    if not text.startswith(_IDL):
        return dict(get_types_from_msg(text, name))
    types: Types = {}
    for part in text.split(_IDL)[1:]:
        types |= get_types_from_idl(part.split("\n", 1)[1])
    return types


def _of_ros2(name: str) -> Types:
    """Return a type of ROS 2 itself; {} if it is none."""
    fields = ros2_types().fielddefs
    return {name: fields[name]} if name in fields else {}


def _shipped(name: str) -> Types:
    """Return a type of `DETECTORS`; {} if it is none."""
    return dict(get_types_from_msg(DETECTORS[name], name)) if name in DETECTORS else {}


def _installed(name: str) -> Types:
    """Return a type of an installed package; {} if there is none."""
    prefixes = os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)
    return _installed_in((*filter(None, prefixes), sys.prefix), name)


@cache
def _installed_in(prefixes: tuple[str, ...], name: str) -> Types:
    """Return a type of a package in the folders `prefixes`; {} if there is none."""
    for prefix in prefixes:
        file = Path(prefix, "share", f"{name}.msg")
        if file.is_file():
            return dict(get_types_from_msg(file.read_text(encoding="utf-8"), name))
    return {}
