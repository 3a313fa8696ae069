# SPDX-License-Identifier: Apache-2.0
"""Show the angle of each person's left elbow, live: ros2 run deep_nrsfm_ros lifter, then this."""

import math
from contextlib import suppress

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import JointState


def show(message: JointState) -> None:
    """Print the elbows of all people of a message."""
    for name, radians in zip(message.name, message.position, strict=True):
        if name.endswith("/l_elbow"):
            print(f"{name}: {math.degrees(radians):5.1f} degrees", flush=True)


rclpy.init()
node = Node("elbow_angle")
node.create_subscription(JointState, "lifter/joint_states", show, qos_profile_sensor_data)
print("waiting for joints of the lifter on /lifter/joint_states", flush=True)
with suppress(KeyboardInterrupt, ExternalShutdownException):
    rclpy.spin(node)
