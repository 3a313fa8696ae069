# SPDX-License-Identifier: Apache-2.0
"""The topic ~/detections_3d, with stand-ins for rclpy's yolo_msgs, which PyPI lacks."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
import pytest

from deep_nrsfm_ros.messages.detections_3d import Lifted3D
from deep_nrsfm_ros.node import detections_3d
from test.fixtures.detector_messages import Detectors
from test.messages.test_detections_3d import KIND, people, shapes


class Publisher:
    """Stands in for a node and for its publisher."""

    def __init__(self) -> None:
        self.created: tuple[Any, ...] = ()
        self.sent: list[Any] = []
        self.listeners = 0

    def create_publisher(self, *arguments: Any, **_: Any) -> Publisher:
        self.created = arguments
        return self

    def get_subscription_count(self) -> int:
        return self.listeners

    def publish(self, message: Any) -> None:
        self.sent.append(message)


def test_the_topic_is_that_of_yolo_ros(
    recorded: Detectors, monkeypatch: pytest.MonkeyPatch
) -> None:
    def message_class(name: str) -> Any:
        return partial(recorded.make, name)

    def decoder(name: str) -> Any:
        kind = name.replace("/", "/msg/")
        return partial(recorded.store.deserialize_cdr, typename=kind)

    monkeypatch.setattr(detections_3d, "message_class", message_class)
    monkeypatch.setattr(detections_3d, "decoder", decoder)
    node: Any = Publisher()
    publisher = detections_3d.DetectionsPublisher(node)
    kind, *others = node.created
    assert kind.args == ("yolo_msgs/DetectionArray",) and others == ["~/detections_3d", 10]
    assert not publisher.has_subscriber()
    node.listeners = 1
    assert publisher.has_subscriber()
    raw = bytes(recorded.store.serialize_cdr(recorded.detections(people()), KIND))
    publisher.publish(raw, Lifted3D("optical", shapes(1, 17), (3,), [(5, 1)]))
    (message,) = node.sent
    (detection,) = message.detections
    (point,) = detection.keypoints3d.data
    assert (detection.id, point.id) == ("9", 6)
    np.testing.assert_allclose(point.point.x, shapes(1, 17).shapes[0, 1, 0])


def test_without_yolo_msgs_the_reason_is_told() -> None:
    node: Any = Publisher()
    with pytest.raises(ValueError, match="need the package yolo_msgs"):
        detections_3d.DetectionsPublisher(node)
