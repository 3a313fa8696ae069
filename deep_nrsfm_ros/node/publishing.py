# SPDX-License-Identifier: Apache-2.0
"""Build the lifter's messages from arrays.

Messages of the hot path are built serialised. They differ only in stamp and numbers, so a message
that ROS has serialised once is a template for the next ones.
"""

from __future__ import annotations

from array import array
from collections.abc import Sequence
from functools import lru_cache
from itertools import count
from typing import Any, NamedTuple

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Point, QuaternionStamped, Vector3
from numpy.typing import NDArray
from rclpy.event_handler import PublisherEventCallbacks
from rclpy.publisher import Publisher
from rclpy.serialization import serialize_message
from sensor_msgs.msg import MultiDOFJointState, PointCloud2, PointField
from std_msgs import msg as std_msgs
from visualization_msgs.msg import Marker, MarkerArray

from deep_nrsfm_ros.body.kinematic_tree import quaternions
from deep_nrsfm_ros.lifting.lifter import Lifted
from deep_nrsfm_ros.messages.decoding import POINT_FIELDS, POINT_STEP
from deep_nrsfm_ros.messages.serialised import Header
from deep_nrsfm_ros.messages.stamps import Moment
from deep_nrsfm_ros.node.serialised_template import (
    LIFETIME,
    TRANSFORM_NUMBERS,
    SerialisedTemplate,
    mark,
    template_header,
    template_transform,
)
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


class Outbox:
    """Messages that are made one after the other and sent together.

    Each sending wakes threads of the middleware. They are still awake for the next message if it
    follows at once, which saves a tenth of the time of twenty messages.
    """

    def __init__(self) -> None:
        """Start empty."""
        self._messages: list[tuple[Publisher, Any]] = []

    def add(self, publisher: Publisher, message: Any) -> None:
        """Keep a message, serialised or not, for `send`."""
        self._messages.append((publisher, message))

    def send(self) -> None:
        """Publish the messages in their order, and keep none."""
        messages, self._messages = self._messages, []
        for publisher, message in messages:
            publisher.publish(message)


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
) -> bytes:
    """Return the serialised identity and transform of the object in each row of the point cloud.

    Among the standard messages, only MultiDOFJointState has a header, a list of names and a
    transform for each: an object before a camera is a floating joint. TFMessage is in a package on
    which this one does not depend, and a field of the cloud would have to be a number.

    Args:
        header: of the message.
        lifted: n objects.
        identities: n, "" for an object without one.
        positioned: whether the shapes are at their positions before the camera.

    Returns:
        A MultiDOFJointState: transforms from the axes of each object to those of the camera, NaN
        for objects that are not lifted. The origin is the mean of the keypoints, 0 if not
        `positioned`.
    """
    template = _objects(header.frame_id, tuple(identities))
    shapes = lifted.shapes
    places = shapes.mean(1) if positioned else np.zeros((len(shapes), 3))
    turns = quaternions(lifted.rotations.astype(np.float64))
    return template(header, np.concatenate([places, turns], -1))


@lru_cache(_MAX_TEMPLATES)
def _objects(frame_id: str, identities: tuple[str, ...]) -> SerialisedTemplate:
    """Return the template of the transforms of objects."""
    message = MultiDOFJointState(header=template_header(frame_id), joint_names=list(identities))
    message.transforms = [template_transform(i) for i in range(len(identities))]
    return SerialisedTemplate(message, TRANSFORM_NUMBERS * len(identities))


def markers(
    header: Header,
    lifted: Lifted,
    edges: Sequence[tuple[int, int]],
    moment: Moment = _NO_MOMENT,
    *,
    positioned: bool = False,
) -> bytes:
    """Return the serialised MarkerArray of lifted objects: lines (edges), spheres (keypoints).

    Args:
        header: of the message.
        lifted: n objects.
        edges: pairs of keypoint indices.
        moment: time of the message: markers live for 0.3 s or 3 periods; where the stamps begin
            anew, all earlier markers are deleted.
        positioned: whether the shapes are at their positions. If not, the first object is at the
            origin, as in the point cloud, and the others stand beside it as in the image.
    """
    lifted = lifted.at(~np.isnan(lifted.residual))
    n, p, _ = lifted.shapes.shape
    sizes = np.sqrt((centre(lifted.shapes) ** 2).sum(-1).mean(-1))[:, None]
    places = np.zeros((n, 2))
    if not positioned:
        places[:] = (lifted.translation - lifted.translation[:1]) / lifted.scale[:, None]
    ends = lifted.shapes[:, np.array(edges, int).reshape(-1)].reshape(n, -1)
    joints, points = np.repeat(_JOINT_SIZE * sizes, 3, 1), lifted.shapes.reshape(n, 3 * p)
    numbers = np.concatenate([ends, places, _BONE_SIZE * sizes, points, places, joints], 1)
    template = _markers(header.frame_id, n, p, len(edges), moment.restarted)
    return template(header, numbers, max(_LIFETIME, _INTERVALS * moment.period))


@lru_cache(_MAX_TEMPLATES)
def _markers(frame_id: str, n: int, p: int, edges: int, restarted: bool) -> SerialisedTemplate:
    """Return the template of the markers of n objects with p keypoints."""
    message, header, marks = MarkerArray(), template_header(frame_id), count()
    if restarted:
        message.markers.append(Marker(header=header, action=Marker.DELETEALL))

    def numbers(k: int) -> list[float]:
        return [mark(next(marks)) for _ in range(k)]

    def points(k: int) -> list[Point]:
        return [Point(x=x, y=y, z=z) for x, y, z in (numbers(3) for _ in range(k))]

    for i in range(n):
        bones, joints = Marker(ns="bones", type=Marker.LINE_LIST), Marker(ns="joints")
        joints.type, joints.color, bones.color = Marker.SPHERE_LIST, _JOINTS, _BONES
        for marker, k, sides in ((bones, 2 * edges, "x"), (joints, p, "xyz")):
            marker.header, marker.id, marker.lifetime = header, i, LIFETIME
            marker.points = points(k)
            marker.pose.position = Point(**dict(zip("xy", numbers(2), strict=True)))
            marker.scale = Vector3(**dict(zip(sides, numbers(len(sides)), strict=True)))
        message.markers += [bones, joints]
    return SerialisedTemplate(message, next(marks))
