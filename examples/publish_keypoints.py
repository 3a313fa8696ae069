# SPDX-License-Identifier: Apache-2.0
"""Publish keypoints of one person to the lifter, ten times a second: put your detector in here."""

from typing import Any

import numpy as np
import rclpy
from rclpy.node import Node
from sensor_msgs.msg import PointCloud2, PointField


def detect() -> Any:
    """Return (17, 3): x and y in pixels and confidence of the keypoints of coco17."""
    return np.random.default_rng(0).uniform(100, 400, (17, 3)) * [1, 1, 0.002]


rclpy.init()
node = Node("detector")
publisher = node.create_publisher(PointCloud2, "keypoints", 10)
names = ("x", "y", "confidence")
fields = [PointField(name=n, offset=4 * i, datatype=7, count=1) for i, n in enumerate(names)]


def send() -> None:
    """Publish what the detector sees."""
    points = detect().astype(np.float32)
    message = PointCloud2(height=1, width=len(points), fields=fields, point_step=12)
    message.header.stamp, message.header.frame_id = node.get_clock().now().to_msg(), "camera"
    message.row_step, message.data = points.nbytes, points.tobytes()
    publisher.publish(message)


node.create_timer(0.1, send)
rclpy.spin(node)
