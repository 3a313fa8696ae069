"""Messages of the lifter from arrays.

Those of the hot path come serialised: all but stamp and numbers is the same in each, so one that
ROS has serialised serves for the next.
"""

from __future__ import annotations

from array import array
from collections.abc import Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from builtin_interfaces.msg import Duration, Time
from geometry_msgs.msg import Point, Quaternion, QuaternionStamped, Transform, Vector3
from numpy.typing import NDArray
from rclpy.event_handler import PublisherEventCallbacks
from rclpy.serialization import serialize_message
from sensor_msgs.msg import MultiDOFJointState, PointCloud2, PointField
from std_msgs import msg as std_msgs
from visualization_msgs.msg import Marker, MarkerArray

from deep_nrsfm_ros.lifting.lifter import Lifted
from deep_nrsfm_ros.messages.decoding import POINT_FIELDS, POINT_STEP
from deep_nrsfm_ros.messages.serialised import Header
from deep_nrsfm_ros.nrsfm.geometry import centre, quaternion

NO_EVENT_CALLBACKS = PublisherEventCallbacks(use_default_callbacks=False)
"""For publishers of the lifter: rclpy looks after two events of any other at every message.

They would tell of a subscriber whose quality of service does not fit. Its own node tells it too.
"""

_MAKES = 16  # of each kind of message that are kept: cameras, and numbers of objects

_LIFETIME = Duration(nanosec=300_000_000)
_BONES = std_msgs.ColorRGBA(r=0.2, g=0.6, b=1.0, a=1.0)
_JOINTS = std_msgs.ColorRGBA(r=1.0, g=0.7, b=0.1, a=1.0)
_JOINT_SIZE = 0.08  # of the shape's RMS radius
_BONE_SIZE = 0.03


class _Template(NamedTuple):
    """A serialised message, to be filled again for every message of its make."""

    raw: bytearray
    values: NDArray[Any]  # a view of the numbers in it


def point_cloud(header: Header, lifted: Lifted) -> bytes:
    """Return the points and confidence of n objects as a serialised PointCloud2."""
    raw, values = _point_cloud(header.frame_id, *lifted.confidence.shape)
    header.write_stamp(raw)
    values[..., :3] = lifted.shapes
    values[..., 3] = lifted.confidence
    raw[-1] = not np.isnan(lifted.residual).any()  # is_dense
    return bytes(raw)


def camera_rotation(header: Header, rotation: NDArray[np.float32]) -> bytes:
    """Return the rotation (3, 3) of an object as a serialised QuaternionStamped."""
    raw, values = _quaternion(header.frame_id)
    header.write_stamp(raw)
    values[:] = quaternion(rotation)
    return bytes(raw)


@lru_cache(_MAKES)
def _point_cloud(frame_id: str, n: int, p: int) -> _Template:
    """Return a template of the cloud of n objects (its height) of p keypoints (its width)."""
    message = PointCloud2(header=std_msgs.Header(frame_id=frame_id), height=n, width=p)
    message.fields = [
        PointField(name=name, offset=offset, datatype=PointField.FLOAT32, count=1)
        for name, offset in POINT_FIELDS
    ]
    message.point_step, message.row_step = POINT_STEP, p * POINT_STEP
    message.data = array("B", bytes(n * p * POINT_STEP))
    raw = bytearray(serialize_message(message))
    # The data comes last but for is_dense.
    values = np.frombuffer(raw, "<f4", n * p * 4, len(raw) - 1 - len(message.data))
    return _Template(raw, values.reshape(n, p, 4))


@lru_cache(_MAKES)
def _quaternion(frame_id: str) -> _Template:
    """Return a template of the quaternion x, y, z, w."""
    message = QuaternionStamped(header=std_msgs.Header(frame_id=frame_id))
    raw = bytearray(serialize_message(message))
    return _Template(raw, np.frombuffer(raw, "<f8", 4, len(raw) - 4 * 8))


def to_header(header: Header) -> std_msgs.Header:
    """Return a header as a message."""
    stamp = Time(sec=header.sec, nanosec=header.nanosec)
    return std_msgs.Header(stamp=stamp, frame_id=header.frame_id)


def objects(
    header: Header, lifted: Lifted, identities: Sequence[str], *, positioned: bool = False
) -> MultiDOFJointState:
    """Return who is in which row of the point cloud, and how each is turned.

    Of the standard messages this one alone holds a header, a list of names and a transform for
    each: an object before a camera is a floating joint. (TFMessage is in a package that this one
    does not need; an id as a field of the cloud would have to be a number.)

    identities: n, "" for an object without one. A transform leads from the axes of the object, its
    origin the mean of its keypoints, to those of the cloud: its rotation is that of
    ~/camera_rotation, its translation the object's place, zero unless the shapes are `positioned`.
    NaN where the object could not be lifted.
    """
    message = MultiDOFJointState(header=to_header(header), joint_names=list(identities))
    message.transforms = transforms(lifted, positioned=positioned)
    return message


def transforms(lifted: Lifted, *, positioned: bool) -> list[Transform]:
    """Return what leads from the axes of each object to those of the camera."""
    means = lifted.shapes.mean(1) if positioned else np.zeros((len(lifted.shapes), 3))
    moves = (Vector3(x=x, y=y, z=z) for x, y, z in means.tolist())
    turns = map(to_quaternion, lifted.rotations)
    return [Transform(translation=t, rotation=q) for t, q in zip(moves, turns, strict=True)]


def to_quaternion(rotation: NDArray[np.float32]) -> Quaternion:
    """Return a rotation (3, 3) as a message, NaN if it is."""
    x, y, z, w = quaternion(rotation).tolist()
    return Quaternion(x=x, y=y, z=z, w=w)


def markers(
    header: Header, lifted: Lifted, edges: Sequence[tuple[int, int]], *, positioned: bool = False
) -> MarkerArray:
    """Return each object as a list of lines, one an edge, and a list of spheres.

    positioned: the shapes are at their place. Where they are not, the first object is at the
    origin, as in the point cloud; the others stand beside it as they do in the image. Objects that
    are NaN are left out.
    """
    array_of_markers, stamped = MarkerArray(), to_header(header)
    lifted = Lifted(*(part[~np.isnan(lifted.residual)] for part in lifted))
    sizes = np.sqrt((centre(lifted.shapes) ** 2).sum(-1).mean(-1)).tolist()
    apart = (lifted.translation - lifted.translation[:1]) / lifted.scale[:, None]
    places = (np.zeros_like(apart) if positioned else apart).tolist()
    for i, (shape, size, (x, y)) in enumerate(
        zip(lifted.shapes.tolist(), sizes, places, strict=True)
    ):
        points = [Point(x=px, y=py, z=pz) for px, py, pz in shape]
        bones, joints = Marker(ns="bones", type=Marker.LINE_LIST), Marker(ns="joints")
        joints.type, joints.points, joints.color = Marker.SPHERE_LIST, points, _JOINTS
        bones.points, bones.color = [points[end] for edge in edges for end in edge], _BONES
        joint, bone = _JOINT_SIZE * size, _BONE_SIZE * size
        joints.scale, bones.scale = Vector3(x=joint, y=joint, z=joint), Vector3(x=bone)
        for marker in (bones, joints):
            marker.header, marker.id, marker.lifetime = stamped, i, _LIFETIME
            marker.pose.position = Point(x=x, y=y)
        array_of_markers.markers += [bones, joints]
    return array_of_markers
