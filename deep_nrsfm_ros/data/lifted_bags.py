"""The lifter's answers in bags: its points and camera rotations, written and read without ROS."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from rosbags.rosbag2 import Writer
from rosbags.typesys import Stores, get_typestore

from deep_nrsfm_ros.data.bag_files import BagError, BagFile, Topic, lifter_topics, open_bag
from deep_nrsfm_ros.data.bags import STORAGES, point_cloud
from deep_nrsfm_ros.data.detections import Detections
from deep_nrsfm_ros.data.keypoint_files import stamp_of
from deep_nrsfm_ros.lifting.lifter import Lifted
from deep_nrsfm_ros.messages.decoding import read_points
from deep_nrsfm_ros.nrsfm.geometry import quaternion, rotation_from_quaternion

KEYPOINTS, POINTS, ROTATION = "/keypoints", "/lifter/points", "/lifter/camera_rotation"
"""The topics of the lifter, as it is named unless somebody says otherwise."""

_STORE = get_typestore(Stores.ROS2_JAZZY)
_CLOUD, _QUATERNION = "sensor_msgs/msg/PointCloud2", "geometry_msgs/msg/QuaternionStamped"


class LiftedMessage(NamedTuple):
    """What the lifter said of one frame: n objects of p keypoints.

    stamp: ns. shapes: (n, p, 3) camera axes, NaN where not lifted. confidence: (n, p).
    rotation: (3, 3) of the first object, or None.
    """

    stamp: int
    shapes: NDArray[np.float32]
    confidence: NDArray[np.float32]
    rotation: NDArray[np.float32] | None


def has_lifted_messages(path: Path) -> bool:
    """Tell whether a lifter's answers were recorded in the bag; raise BagError for no bag."""
    with closing(open_bag(path)) as bag:
        return any(points.total for points, _ in lifter_topics(bag))


def read_lifted_messages(
    path: Path,
    on_progress: Callable[[int, int], None] = lambda done, total: None,
    warn: Callable[[str], None] = lambda message: None,
) -> list[LiftedMessage]:
    """Return the answers in a bag by time; raise BagError unless they are of one lifter."""
    with closing(open_bag(path)) as bag:
        pairs = lifter_topics(bag)
        if len(pairs) != 1:
            names = ", ".join(points.name for points, _ in pairs) or "none"
            raise BagError(f"bag {path} has {len(pairs)} lifters' points ({names}); expected one")
        points, rotation = pairs[0]
        rotations: dict[int, NDArray[np.float32]] = {}
        for stamp, message in _messages(bag, rotation, warn):
            q = message.quaternion
            rotations[stamp] = rotation_from_quaternion(np.array([q.x, q.y, q.z, q.w]))
        answers = []
        for stamp, message in _messages(bag, points, warn):
            values = read_points(message)
            shapes, confidence = values[..., :3], values[..., 3]
            answers.append(LiftedMessage(stamp, shapes, confidence, rotations.get(stamp)))
            on_progress(len(answers), max(len(answers), points.total))
    return sorted(answers, key=lambda answer: answer.stamp)


def _messages(bag: BagFile, topic: Topic, warn: Callable[[str], None]) -> list[tuple[int, Any]]:
    """Return the stamped messages of a topic; those that cannot be read are counted and told."""
    found: list[tuple[int, Any]] = []
    reason, damaged = "", 0
    for record in bag.records(topic):
        try:
            message = _STORE.deserialize_cdr(record.raw, topic.type)
            found.append((stamp_of(message) or record.time, message))
        except Exception as error:  # whatever bytes a bag holds, the others still count
            reason, damaged = reason or repr(error), damaged + 1
    if warning := bag.warning(topic):
        warn(warning)
    if damaged:
        warn(f"{damaged} messages of {topic.name} cannot be decoded: {reason}")
    return found


def write_lifted_bag(path: Path, seen: Detections, lifted: Lifted, storage: str = "mcap") -> int:
    """Write a bag as a recording of the lifter at work; return how many messages it has.

    seen: the keypoints, on `KEYPOINTS`; lifted: what came of them, as the lifter publishes it.
    Raises BagError if `path` exists.
    """
    if path.exists():
        raise BagError(f"bag {path} exists already; choose another name or remove it")
    count, ends = 0, np.searchsorted(seen.frame, np.arange(len(seen.stamps) + 1)).tolist()
    with Writer(path, version=9, storage_plugin=STORAGES[storage]) as writer:
        topics = {KEYPOINTS: _CLOUD, POINTS: _CLOUD, ROTATION: _QUATERNION}
        connections = {
            name: writer.add_connection(name, kind, typestore=_STORE)
            for name, kind in topics.items()
        }
        for stamp, start, end in zip(seen.stamps.tolist(), ends, ends[1:], strict=False):
            rows, header = slice(start, end), _header(stamp, seen.frame_id)
            visible = seen.confidence[rows, :, None] > 0
            keypoints = np.where(visible, seen.points[rows], np.nan)
            messages = {KEYPOINTS: point_cloud(header, keypoints, seen.confidence[rows])}
            if start < end and not np.isnan(lifted.residual[rows]).all():
                shapes, confidence = lifted.shapes[rows], lifted.confidence[rows]
                messages[POINTS] = point_cloud(header, shapes, confidence)
                if not np.isnan(lifted.residual[start]):
                    messages[ROTATION] = _rotation(header, lifted.rotations[start])
            for name, message in messages.items():
                raw = _STORE.serialize_cdr(message, topics[name])
                writer.write(connections[name], stamp, raw)
                count += 1
    return count


def _header(stamp: int, frame_id: str) -> Any:
    """Return a header of a stamp in ns."""
    time = _STORE.types["builtin_interfaces/msg/Time"](*divmod(stamp, 1_000_000_000))
    return _STORE.types["std_msgs/msg/Header"](time, frame_id)


def _rotation(header: Any, rotation: NDArray[np.float32]) -> Any:
    """Return a rotation (3, 3) as a QuaternionStamped."""
    values = _STORE.types["geometry_msgs/msg/Quaternion"](*quaternion(rotation).tolist())
    return _STORE.types[_QUATERNION](header, values)
