# SPDX-License-Identifier: Apache-2.0
"""Publish keypoints of one person to the lifter, 30 times a second: put your detector in here."""

import signal

stop: list[int] = []  # gets the signal of Ctrl-C, also during the other imports
for number in (signal.SIGINT, signal.SIGTERM):
    signal.signal(number, lambda number, _: stop.append(number))

from itertools import cycle

import numpy as np
import rclpy
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import PointCloud2, PointField

from deep_nrsfm_ros.data.clip import read_clip

# (100, 25, 3): x and y in pixels and confidence, in the order of body25b; (0, 0, 0) = missing.
view = read_clip().session.views[0]
detections = cycle(np.dstack([view.points, view.confidence]).astype(np.float32))
names = ("x", "y", "confidence")
fields = [PointField(name=n, offset=4 * i, datatype=7, count=1) for i, n in enumerate(names)]


def send() -> None:
    """Publish what the detector sees: a row for each person, here one."""
    points = next(detections)
    message = PointCloud2(height=1, width=len(points), fields=fields, point_step=12)
    message.header.stamp, message.header.frame_id = node.get_clock().now().to_msg(), "camera"
    message.row_step, message.data = points.nbytes, points.tobytes()
    publisher.publish(message)


rclpy.init(signal_handler_options=SignalHandlerOptions.NO)  # its own ones break a call
node = Node("detector")
publisher = node.create_publisher(PointCloud2, "keypoints", 10)
node.create_timer(1 / 30, send)
while not stop:
    rclpy.spin_once(node, timeout_sec=0.1)
rclpy.shutdown()
