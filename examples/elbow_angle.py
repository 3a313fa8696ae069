# SPDX-License-Identifier: Apache-2.0
"""Show the angle of each person's left elbow, live: ros2 run deep_nrsfm_ros lifter, then this."""

import math
import os
import signal

signal.signal(signal.SIGINT, lambda *_: os._exit(0))  # Ctrl-C, also during the other imports

import rclpy
from rclpy.qos import qos_profile_sensor_data
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import JointState


def show(message: JointState) -> None:
    """Print the elbows of all people of a message."""
    for name, radians in zip(message.name, message.position, strict=True):
        if name.endswith("/l_elbow"):
            print(f"{name}: {math.degrees(radians):5.1f} degrees", flush=True)


rclpy.init(signal_handler_options=SignalHandlerOptions.NO)  # its own ones break a call
node = rclpy.create_node("elbow_angle")
node.create_subscription(JointState, "lifter/joint_states", show, qos_profile_sensor_data)
print("waiting for joints of the lifter on /lifter/joint_states", flush=True)
while True:
    rclpy.spin_once(node, timeout_sec=0.1)  # rclpy.spin would hold Ctrl-C back
