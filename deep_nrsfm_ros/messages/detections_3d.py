# SPDX-License-Identifier: Apache-2.0
"""The detections of yolo_ros with the lifted keypoints, as its own node for depth cameras has them.

Source: detect_3d_node of yolo_ros 4.6 publishes the detections that it can place, with
`keypoints3d` and `bbox3d` in metres in one frame; a keypoint has the id of its 2D keypoint.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from deep_nrsfm_ros.lifting.lifter import Lifted
from deep_nrsfm_ros.messages.field_mapping import YOLO


class Lifted3D(NamedTuple):
    """The lifted objects of a message.

    Attributes:
        frame_id: of the points.
        lifted: n objects at their positions; those behind the detected ones are not in the message.
        places: m <= n, the index in the message of each detected object.
        shared: pairs of the indices of a keypoint in the detector's and in the model's layout.
    """

    frame_id: str
    lifted: Lifted
    places: Sequence[int]
    shared: Sequence[tuple[int, int]]


def add_keypoints(message: Any, found: Lifted3D, make: Callable[[], Any]) -> None:
    """Add 3D keypoints and boxes to a DetectionArray, and drop the detections that have none.

    A detection that is not lifted is dropped, as yolo_ros drops one without depth: its box would be
    at the origin. All keypoints that both layouts have are there, those that the detector does not
    see too; their score is the confidence of the 3D point.

    Args:
        message: is changed; of rclpy or rosbags.
        found: its lifted objects.
        make: returns a KeyPoint3D.
    """
    placed = []
    for row, place in enumerate(found.places):
        shape, confidence = found.lifted.shapes[row], found.lifted.confidence[row]
        if not np.isfinite(shape).all():
            continue
        detection = message.detections[place]
        low, high = shape.min(0).astype(float), shape.max(0).astype(float)
        box = detection.bbox3d
        box.frame_id = detection.keypoints3d.frame_id = found.frame_id
        _set(box.center.position, (low + high) / 2)
        _set(box.size, high - low)
        box.center.orientation.w = 1.0
        points = []
        for theirs, ours in found.shared:
            point = make()
            point.id, point.score = theirs + YOLO.first_id, float(confidence[ours])
            _set(point.point, shape[ours])
            points.append(point)
        detection.keypoints3d.data = points
        placed.append(detection)
    message.detections = placed


def _set(vector: Any, values: Any) -> None:
    """Set x, y and z of a message."""
    vector.x, vector.y, vector.z = map(float, values)
