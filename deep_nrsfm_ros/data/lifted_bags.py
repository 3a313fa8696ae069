# SPDX-License-Identifier: Apache-2.0
"""Bags with messages of the lifter, its points and camera rotations: read and written."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from rosbags.rosbag2 import Writer

from deep_nrsfm_ros.data.bag_files import BagError, BagFile, Topic, lifter_topics, open_bag
from deep_nrsfm_ros.data.bags import STORAGES, point_cloud
from deep_nrsfm_ros.data.definitions import ros2_types
from deep_nrsfm_ros.data.detections import Detections
from deep_nrsfm_ros.data.keypoint_files import stamp_of
from deep_nrsfm_ros.large_arrays import release
from deep_nrsfm_ros.lifting.lifter import Lifted
from deep_nrsfm_ros.messages.decoding import read_points
from deep_nrsfm_ros.messages.stamps import one_clock
from deep_nrsfm_ros.nrsfm.geometry import quaternion, rotation_from_quaternion

KEYPOINTS, POINTS, ROTATION = "/keypoints", "/lifter/points", "/lifter/camera_rotation"
"""The default topics of the lifter."""

_RELEASED = 1024  # messages after which results that are in files are taken out of memory
_CLOUD, _QUATERNION = "sensor_msgs/msg/PointCloud2", "geometry_msgs/msg/QuaternionStamped"


class LiftedMessage(NamedTuple):
    """The messages of a lifter about one frame: n objects of p keypoints.

    Attributes:
        stamp: time of the frame in ns.
        shapes: (n, p, 3) in the axes of `frame_id`, in output units; NaN where not lifted.
        confidence: (n, p) in [0, 1].
        rotation: (3, 3) from the first object to `frame_id`; None if not recorded.
        frame_id: frame of the points: the camera's, or the lifter's target_frame, with z up.
    """

    stamp: int
    shapes: NDArray[np.float32]
    confidence: NDArray[np.float32]
    rotation: NDArray[np.float32] | None
    frame_id: str = ""


def has_lifted_messages(path: Path) -> bool:
    """Return whether a bag has points of a lifter; raise BagError if it is no bag."""
    with closing(open_bag(path)) as bag:
        return any(points.total for points, _ in lifter_topics(bag))


def read_lifted_messages(
    path: Path,
    on_progress: Callable[[int, int], None] = lambda done, total: None,
    warn: Callable[[str], None] = lambda message: None,
) -> list[LiftedMessage]:
    """Return the messages of a lifter in a bag, in order of time.

    Args:
        path: bag folder or file.
        on_progress: called with the number of messages read and their total number.
        warn: called with a sentence about each damaged part.

    Raises:
        BagError: it is no bag, or has the messages of no lifter or of several.
    """
    with closing(open_bag(path)) as bag:
        pairs = lifter_topics(bag)
        if len(pairs) != 1:
            names = ", ".join(points.name for points, _ in pairs) or "none"
            raise BagError(f"bag {path} has {len(pairs)} lifters' points ({names}); expected one")
        points, rotation = pairs[0]
        rotations: dict[int, NDArray[np.float32]] = {}
        for _, stamp, message in _messages(bag, rotation, warn):
            q = message.quaternion
            rotations[stamp] = rotation_from_quaternion(np.array([q.x, q.y, q.z, q.w]))
        lifted, times = [], []
        for time, stamp, message in _messages(bag, points, warn):
            values = read_points(message)
            shapes, confidence = values[..., :3], values[..., 3]
            rotated, frame_id = rotations.get(stamp), str(message.header.frame_id)
            lifted.append(LiftedMessage(stamp, shapes, confidence, rotated, frame_id))
            times.append(time)
            on_progress(len(lifted), max(len(lifted), points.total))
    stamps, warnings = one_clock([each.stamp for each in lifted], times)
    for warning in warnings:
        warn(warning)
    lifted = [
        each._replace(stamp=stamp) for each, stamp in zip(lifted, stamps.tolist(), strict=True)
    ]
    return sorted(lifted, key=lambda each: each.stamp)


def _messages(
    bag: BagFile, topic: Topic, warn: Callable[[str], None]
) -> list[tuple[int, int, Any]]:
    """Return time of recording, stamp and message of a topic; warn about unreadable ones."""
    messages: list[tuple[int, int, Any]] = []
    reason, damaged = "", 0
    for record in bag.records(topic):
        try:
            message = ros2_types().deserialize_cdr(record.raw, topic.type)
            messages.append((record.time, stamp_of(message), message))
        except Exception as error:  # damaged bytes fail in many ways; read the others
            reason, damaged = reason or repr(error), damaged + 1
    if warning := bag.warning(topic):
        warn(warning)
    if damaged:
        warn(f"{damaged} messages of {topic.name} cannot be decoded: {reason}")
    return messages


def write_lifted_bag(
    path: Path, detections: Detections, lifted: Lifted, storage: str = "mcap"
) -> int:
    """Write a bag like a recording of a lifter, and return the number of messages.

    Args:
        path: folder of the new bag.
        detections: m objects, written to the topic `KEYPOINTS`.
        lifted: m lifted objects, written to `POINTS` and `ROTATION` as the lifter does.
        storage: "sqlite3" or "mcap".

    Raises:
        BagError: `path` exists.
    """
    if path.exists():
        raise BagError(f"bag {path} exists already; choose another name or remove it")
    count, stamps = 0, detections.stamps
    ends = np.searchsorted(detections.frame, np.arange(len(stamps) + 1)).tolist()
    with Writer(path, version=9, storage_plugin=STORAGES[storage]) as writer:
        topics = {KEYPOINTS: _CLOUD, POINTS: _CLOUD, ROTATION: _QUATERNION}
        connections = {
            name: writer.add_connection(name, kind, typestore=ros2_types())
            for name, kind in topics.items()
        }
        for stamp, start, end in zip(stamps.tolist(), ends, ends[1:], strict=False):
            rows, header = slice(start, end), _header(stamp, detections.frame_id)
            confidence = detections.confidence[rows]
            points = np.where(confidence[..., None] > 0, detections.points[rows], np.nan)
            messages = {KEYPOINTS: point_cloud(header, points, confidence)}
            if start < end and not np.isnan(lifted.residual[rows]).all():
                shapes = lifted.shapes[rows]
                messages[POINTS] = point_cloud(header, shapes, lifted.confidence[rows])
                if not np.isnan(lifted.residual[start]):
                    messages[ROTATION] = _rotation(header, lifted.rotations[start])
            for name, message in messages.items():
                raw = ros2_types().serialize_cdr(message, topics[name])
                writer.write(connections[name], stamp, raw)
                count += 1
            if count % _RELEASED == 0:
                release(lifted)
    return count


def _header(stamp: int, frame_id: str) -> Any:
    """Return a std_msgs/Header with a stamp in ns."""
    time = ros2_types().types["builtin_interfaces/msg/Time"](*divmod(stamp, 1_000_000_000))
    return ros2_types().types["std_msgs/msg/Header"](time, frame_id)


def _rotation(header: Any, rotation: NDArray[np.float32]) -> Any:
    """Return a rotation (3, 3) as a QuaternionStamped."""
    values = ros2_types().types["geometry_msgs/msg/Quaternion"](*quaternion(rotation).tolist())
    return ros2_types().types[_QUATERNION](header, values)
