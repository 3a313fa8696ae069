# SPDX-License-Identifier: Apache-2.0
"""Message classes are imported when they are asked for."""

import pytest
from geometry_msgs.msg import PoseArray

from deep_nrsfm_ros.node.message_types import message_class


def test_a_class_by_its_name() -> None:
    assert message_class("geometry_msgs/PoseArray") is PoseArray


def test_an_absent_package_is_named_with_the_mend() -> None:
    with pytest.raises(ValueError, match="need the package yolo_msgs.*ros-jazzy-yolo-msgs"):
        message_class("yolo_msgs/DetectionArray")


def test_a_message_that_its_package_lacks() -> None:
    with pytest.raises(ValueError, match="package geometry_msgs has no message Nose"):
        message_class("geometry_msgs/Nose")
