# SPDX-License-Identifier: Apache-2.0
"""Say where to point at each person's left wrist, in the frame of the lifter (target_frame)."""

import json
import math
import os
import signal

signal.signal(signal.SIGINT, lambda *_: os._exit(0))  # Ctrl-C, also during the other imports

import numpy as np
import rclpy
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import MultiDOFJointState, PointCloud2
from std_msgs.msg import String

names: list[str] = []  # of the keypoints: the columns of the points
points = PointCloud2()


def take_names(message: String) -> None:
    """Take the names of the model's keypoints; they come again when the model changes."""
    names[:] = json.loads(message.data)["keypoints"]


def take_points(message: PointCloud2) -> None:
    """Keep the points; the identities of their rows come next, with the same stamp."""
    global points
    points = message


def point(message: MultiDOFJointState) -> None:
    """Print the direction of each wrist that is likely to be right."""
    if points.header.stamp != message.header.stamp or points.width != len(names):
        return
    wrists = np.frombuffer(points.data, "<f4").reshape(points.height, points.width, 4)
    for identity, (x, y, z, confidence) in zip(
        message.joint_names, wrists[:, names.index("left_wrist")].tolist(), strict=True
    ):
        if math.isnan(x) or confidence < 0.5:  # not lifted, or a guess
            continue
        pan, tilt = math.atan2(y, x), math.atan2(z, math.hypot(x, y))
        place = f"({x:.2f}, {y:.2f}, {z:.2f}) m in {points.header.frame_id}"
        angles = f"pan {math.degrees(pan):.0f}, tilt {math.degrees(tilt):.0f} degrees"
        print(f"{identity}: {place}: {angles}, confidence {confidence:.2f}", flush=True)


rclpy.init(signal_handler_options=SignalHandlerOptions.NO)  # its own ones break a call
node = rclpy.create_node("point_at_wrist")
latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
node.create_subscription(String, "lifter/skeleton", take_names, latched)
node.create_subscription(PointCloud2, "lifter/points", take_points, qos_profile_sensor_data)
node.create_subscription(MultiDOFJointState, "lifter/objects", point, qos_profile_sensor_data)
print("waiting for people of the lifter on /lifter/points", flush=True)
while True:
    rclpy.spin_once(node, timeout_sec=0.1)  # rclpy.spin would hold Ctrl-C back
