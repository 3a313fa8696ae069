# SPDX-License-Identifier: Apache-2.0
"""Build the lifter's messages from arrays.

Messages of the hot path are built serialised. They differ only in stamp and numbers, so a message
that ROS has serialised once is a template for the next ones.
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
from deep_nrsfm_ros.messages.stamps import Moment
from deep_nrsfm_ros.nrsfm.geometry import centre, quaternion

NO_EVENT_CALLBACKS = PublisherEventCallbacks(use_default_callbacks=False)
"""For the lifter's publishers: rclpy polls two events of a publisher with callbacks per message.

The events report subscribers with an incompatible quality of service, which the subscriber's own
node reports as well.
"""

_MAX_TEMPLATES = 16  # kept of each kind of message: one per camera and number of objects

_LIFETIME = 0.3  # s, of markers in a stream of at least 10 Hz
_INTERVALS = 3  # between messages, for which markers live at least
_NO_MOMENT = Moment(0.0)
_BONES = std_msgs.ColorRGBA(r=0.2, g=0.6, b=1.0, a=1.0)
_JOINTS = std_msgs.ColorRGBA(r=1.0, g=0.7, b=0.1, a=1.0)
_JOINT_SIZE = 0.08  # diameter, relative to the shape's RMS radius
_BONE_SIZE = 0.03


class _Template(NamedTuple):
    """A serialised message whose stamp and numbers are overwritten.

    Attributes:
        raw: the bytes.
        values: view of the numbers in them.
    """

    raw: bytearray
    values: NDArray[Any]


def point_cloud(header: Header, lifted: Lifted) -> bytes:
    """Return the serialised PointCloud2 of n objects (rows) with p points (columns)."""
    raw, values = _point_cloud(header.frame_id, *lifted.confidence.shape)
    header.write_stamp(raw)
    values[..., :3] = lifted.shapes
    values[..., 3] = lifted.confidence
    raw[-1] = not np.isnan(lifted.residual).any()  # is_dense
    return bytes(raw)


def camera_rotation(header: Header, rotation: NDArray[np.float32]) -> bytes:
    """Return the serialised QuaternionStamped of a rotation (3, 3)."""
    raw, values = _quaternion(header.frame_id)
    header.write_stamp(raw)
    values[:] = quaternion(rotation)
    return bytes(raw)


@lru_cache(_MAX_TEMPLATES)
def _point_cloud(frame_id: str, n: int, p: int) -> _Template:
    """Return a template of the cloud with height n and width p."""
    message = PointCloud2(header=std_msgs.Header(frame_id=frame_id), height=n, width=p)
    message.fields = [
        PointField(name=name, offset=offset, datatype=PointField.FLOAT32, count=1)
        for name, offset in POINT_FIELDS
    ]
    message.point_step, message.row_step = POINT_STEP, p * POINT_STEP
    message.data = array("B", bytes(n * p * POINT_STEP))
    raw = bytearray(serialize_message(message))
    # The data is followed only by the byte is_dense.
    values = np.frombuffer(raw, "<f4", n * p * 4, len(raw) - 1 - len(message.data))
    return _Template(raw, values.reshape(n, p, 4))


@lru_cache(_MAX_TEMPLATES)
def _quaternion(frame_id: str) -> _Template:
    """Return a template of the quaternion x, y, z, w."""
    message = QuaternionStamped(header=std_msgs.Header(frame_id=frame_id))
    raw = bytearray(serialize_message(message))
    return _Template(raw, np.frombuffer(raw, "<f8", 4, len(raw) - 4 * 8))


def to_header(header: Header) -> std_msgs.Header:
    """Return a header as a message of ROS."""
    stamp = Time(sec=header.sec, nanosec=header.nanosec)
    return std_msgs.Header(stamp=stamp, frame_id=header.frame_id)


def objects(
    header: Header, lifted: Lifted, identities: Sequence[str], *, positioned: bool = False
) -> MultiDOFJointState:
    """Return identity and transform of the object in each row of the point cloud.

    Among the standard messages, only MultiDOFJointState has a header, a list of names and a
    transform for each: an object before a camera is a floating joint. TFMessage is in a package on
    which this one does not depend, and a field of the cloud would have to be a number.

    Args:
        header: of the message.
        lifted: n objects.
        identities: n, "" for an object without one.
        positioned: whether the shapes are at their positions before the camera.

    Returns:
        Transforms as `transforms` gives them, NaN for objects that are not lifted.
    """
    message = MultiDOFJointState(header=to_header(header), joint_names=list(identities))
    message.transforms = transforms(lifted, positioned=positioned)
    return message


def transforms(lifted: Lifted, *, positioned: bool) -> list[Transform]:
    """Return the transform from the axes of each object to those of the camera.

    The origin of an object is the mean of its keypoints.

    Args:
        lifted: n objects.
        positioned: whether the shapes are at their positions; if not, translations are 0.
    """
    means = lifted.shapes.mean(1) if positioned else np.zeros((len(lifted.shapes), 3))
    translations = (Vector3(x=x, y=y, z=z) for x, y, z in means.tolist())
    rotations = map(to_quaternion, lifted.rotations)
    pairs = zip(translations, rotations, strict=True)
    return [Transform(translation=t, rotation=q) for t, q in pairs]


def to_quaternion(rotation: NDArray[np.float32]) -> Quaternion:
    """Return the Quaternion of a rotation (3, 3); NaN stays NaN."""
    x, y, z, w = quaternion(rotation).tolist()
    return Quaternion(x=x, y=y, z=z, w=w)


def markers(
    header: Header,
    lifted: Lifted,
    edges: Sequence[tuple[int, int]],
    moment: Moment = _NO_MOMENT,
    *,
    positioned: bool = False,
) -> MarkerArray:
    """Return for each lifted object a list of lines (edges) and a list of spheres (keypoints).

    Args:
        header: of the message.
        lifted: n objects.
        edges: pairs of keypoint indices.
        moment: time of the message: markers live for 0.3 s or 3 periods; where the stamps begin
            anew, all earlier markers are deleted.
        positioned: whether the shapes are at their positions. If not, the first object is at the
            origin, as in the point cloud, and the others stand beside it as in the image.
    """
    message, stamped = MarkerArray(), to_header(header)
    if moment.restarted:
        message.markers.append(Marker(header=stamped, action=Marker.DELETEALL))
    seconds = max(_LIFETIME, _INTERVALS * moment.period)
    lifetime = Duration(sec=int(seconds), nanosec=int(seconds % 1 * 1e9))
    lifted = Lifted(*(part[~np.isnan(lifted.residual)] for part in lifted))
    sizes = np.sqrt((centre(lifted.shapes) ** 2).sum(-1).mean(-1)).tolist()
    offsets = (lifted.translation - lifted.translation[:1]) / lifted.scale[:, None]
    positions = (np.zeros_like(offsets) if positioned else offsets).tolist()
    for i, (shape, size, (x, y)) in enumerate(
        zip(lifted.shapes.tolist(), sizes, positions, strict=True)
    ):
        points = [Point(x=px, y=py, z=pz) for px, py, pz in shape]
        bones, joints = Marker(ns="bones", type=Marker.LINE_LIST), Marker(ns="joints")
        joints.type, joints.points, joints.color = Marker.SPHERE_LIST, points, _JOINTS
        bones.points, bones.color = [points[end] for edge in edges for end in edge], _BONES
        joint, bone = _JOINT_SIZE * size, _BONE_SIZE * size
        joints.scale, bones.scale = Vector3(x=joint, y=joint, z=joint), Vector3(x=bone)
        for marker in (bones, joints):
            marker.header, marker.id, marker.lifetime = stamped, i, lifetime
            marker.pose.position = Point(x=x, y=y)
        message.markers += [bones, joints]
    return message
