# SPDX-License-Identifier: Apache-2.0
"""A node that publishes each message again: the lower bound of the latency of a node in Python.

It receives a PointCloud2 on `keypoints` and publishes it on ~/points, with a quaternion on
~/camera_rotation. The parameter `input` names another topic.
"""

from __future__ import annotations

import rclpy
from geometry_msgs.msg import QuaternionStamped
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions
from sensor_msgs.msg import PointCloud2


class RelayNode(Node):
    """Publishes each received message again."""

    def __init__(self) -> None:
        """Subscribe with the quality of service of the lifter."""
        super().__init__("relay")
        self._points = self.create_publisher(PointCloud2, "~/points", 10)
        self._rotation = self.create_publisher(QuaternionStamped, "~/camera_rotation", 10)
        self.create_subscription(
            PointCloud2,
            str(self.declare_parameter("input", "keypoints").value),
            self._send_back,
            QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT),
            qos_overriding_options=QoSOverridingOptions.with_default_policies(),
        )

    def _send_back(self, message: PointCloud2) -> None:
        """Publish the message, and a quaternion."""
        self._points.publish(message)
        self._rotation.publish(QuaternionStamped(header=message.header))


def main() -> None:
    """Run the node until a signal."""
    rclpy.init()
    try:
        # The same executor as the lifter.
        executor = SingleThreadedExecutor()
        executor.add_node(RelayNode())
        executor.spin()
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
