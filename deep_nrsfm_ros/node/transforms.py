# SPDX-License-Identifier: Apache-2.0
"""Frames of the objects on /tf."""

from __future__ import annotations

import math
from collections.abc import Sequence

from geometry_msgs.msg import TransformStamped
from rclpy.node import Node

from deep_nrsfm_ros.lifting.lifter import Lifted
from deep_nrsfm_ros.messages.serialised import Header
from deep_nrsfm_ros.node import publishing


class TransformBroadcaster:
    """Publishes a frame for each object: origin at the mean of its keypoints, axes of the object.

    tf2_msgs is imported only here: ROS has it, PyPI has not.
    """

    def __init__(self, node: Node, prefix: str) -> None:
        """Create the publisher.

        Args:
            node: owns the publisher.
            prefix: of the names of the frames.

        Raises:
            ValueError: the package tf2_msgs is not installed.
        """
        try:
            from tf2_msgs.msg import TFMessage
        except ModuleNotFoundError:
            raise ValueError(
                f"tf_prefix is {prefix!r} and the package tf2_msgs is missing; install it "
                "(apt install ros-jazzy-tf2-msgs), or leave tf_prefix empty"
            ) from None
        self._message, self._prefix = TFMessage, prefix
        # Depth 100, as in tf2_ros.
        self._publisher = node.create_publisher(TFMessage, "/tf", 100)

    def send(self, header: Header, lifted: Lifted, identities: Sequence[str]) -> None:
        """Publish the frames of lifted objects, named by identity or, without one, by row."""
        names = [f"{self._prefix}{identity or i}" for i, identity in enumerate(identities)]
        self._publisher.publish(self._message(transforms=frames(header, lifted, names)))


def frames(header: Header, lifted: Lifted, names: Sequence[str]) -> list[TransformStamped]:
    """Return the transforms from object frames to the header's frame; lifted objects only.

    Args:
        header: of the message.
        lifted: n objects at their positions.
        names: n names of frames.
    """
    transforms = publishing.transforms(lifted, positioned=True)
    stamped = publishing.to_header(header)
    return [
        TransformStamped(header=stamped, child_frame_id=name, transform=transform)
        for name, transform in zip(names, transforms, strict=True)
        if not math.isnan(transform.translation.x)
    ]
