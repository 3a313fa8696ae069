# SPDX-License-Identifier: Apache-2.0
"""Print where the nose of each lifted person is: a subscriber to copy."""

import signal

stop: list[int] = []  # gets the signal of Ctrl-C, also during the other imports
for number in (signal.SIGINT, signal.SIGTERM):
    signal.signal(number, lambda number, _: stop.append(number))


import numpy as np
import rclpy
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import PointCloud2

from deep_nrsfm_ros import load_model

NOSE = load_model("human").layout.keypoints.index("nose")


def show(message: PointCloud2) -> None:
    """Print x, y, z and confidence of a keypoint of each object."""
    points = np.frombuffer(message.data, "<f4").reshape(message.height, message.width, -1)
    for x, y, z, confidence in points[:, NOSE, :4]:
        print(f"{x:.3f} {y:.3f} {z:.3f}, confidence {confidence:.2f}", flush=True)


rclpy.init(signal_handler_options=SignalHandlerOptions.NO)  # its own ones break a call
node = Node("reader")
node.create_subscription(PointCloud2, "lifter/points", show, qos_profile_sensor_data)
print("waiting for points of the lifter on /lifter/points", flush=True)
while not stop:
    rclpy.spin_once(node, timeout_sec=0.1)
rclpy.shutdown()
