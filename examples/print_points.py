# SPDX-License-Identifier: Apache-2.0
"""Print where the nose of each lifted person is: a subscriber to copy."""

import json
import signal

stop: list[int] = []  # gets the signal of Ctrl-C, also during the other imports
for number in (signal.SIGINT, signal.SIGTERM):
    signal.signal(number, lambda number, _: stop.append(number))


import numpy as np
import rclpy
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import String

names: list[str] = []  # of the model's keypoints: the columns of the points


def take_names(message: String) -> None:
    """Take the names of the keypoints; they come again when the model changes."""
    names[:] = json.loads(message.data)["keypoints"]


def show(message: PointCloud2) -> None:
    """Print x, y, z and confidence of a keypoint of each object; NaN: it is not lifted."""
    points = np.frombuffer(message.data, "<f4").reshape(message.height, message.width, -1)
    if message.width != len(names):  # the names have not come yet
        return
    for x, y, z, confidence in points[:, names.index("nose"), :4]:
        print(f"{x:.3f} {y:.3f} {z:.3f}, confidence {confidence:.2f}", flush=True)


rclpy.init(signal_handler_options=SignalHandlerOptions.NO)  # its own ones break a call
node = Node("reader")
latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
node.create_subscription(String, "lifter/skeleton", take_names, latched)
node.create_subscription(PointCloud2, "lifter/points", show, qos_profile_sensor_data)
print("waiting for points of the lifter on /lifter/points", flush=True)
while not stop:
    rclpy.spin_once(node, timeout_sec=0.1)
rclpy.shutdown()
