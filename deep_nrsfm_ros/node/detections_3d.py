# SPDX-License-Identifier: Apache-2.0
"""The topic ~/detections_3d, for nodes that expect the 3D detections of yolo_ros."""

from __future__ import annotations

from rclpy.node import Node

from deep_nrsfm_ros.messages.detections_3d import Lifted3D, add_keypoints
from deep_nrsfm_ros.messages.field_mapping import YOLO
from deep_nrsfm_ros.node import publishing
from deep_nrsfm_ros.node.message_types import decoder, message_class

_PACKAGE = YOLO.type.partition("/")[0]


class DetectionsPublisher:
    """Publishes the detections of yolo_ros with 3D keypoints and boxes."""

    def __init__(self, node: Node) -> None:
        """Create the publisher, with the quality of service of yolo_ros.

        Raises:
            ValueError: yolo_msgs is not installed.
        """
        quiet = publishing.NO_EVENT_CALLBACKS
        kind = message_class(YOLO.type)
        self._publisher = node.create_publisher(kind, "~/detections_3d", 10, event_callbacks=quiet)
        self._decode, self._keypoint = decoder(YOLO.type), message_class(f"{_PACKAGE}/KeyPoint3D")

    def has_subscriber(self) -> bool:
        """Return whether somebody listens."""
        return bool(self._publisher.get_subscription_count())

    def publish(self, raw: bytes, found: Lifted3D) -> None:
        """Publish the detections of a serialised DetectionArray in 3D."""
        message = self._decode(raw)
        add_keypoints(message, found, self._keypoint)
        self._publisher.publish(message)
