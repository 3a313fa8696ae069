# SPDX-License-Identifier: Apache-2.0
"""Show the angle of each person's left elbow, live: ros2 run deep_nrsfm_ros lifter, then this."""

import signal

stop: list[int] = []  # gets the signal of Ctrl-C, also during the other imports
for number in (signal.SIGINT, signal.SIGTERM):
    signal.signal(number, lambda number, _: stop.append(number))

import math

import rclpy
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import JointState


def show(message: JointState) -> None:
    """Print the elbows of all people of a message."""
    for name, radians in zip(message.name, message.position, strict=True):
        if name.endswith("/l_elbow"):
            print(f"{name}: {math.degrees(radians):5.1f} degrees", flush=True)


rclpy.init(signal_handler_options=SignalHandlerOptions.NO)  # its own ones break a call
node = Node("elbow_angle")
node.create_subscription(JointState, "lifter/joint_states", show, qos_profile_sensor_data)
print("waiting for joints of the lifter on /lifter/joint_states", flush=True)
while not stop:
    rclpy.spin_once(node, timeout_sec=0.1)
rclpy.shutdown()
