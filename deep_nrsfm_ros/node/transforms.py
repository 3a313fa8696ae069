# SPDX-License-Identifier: Apache-2.0
"""Frames of the objects on /tf."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from rclpy.node import Node

from deep_nrsfm_ros.body.kinematic_tree import Pose
from deep_nrsfm_ros.lifting.lifter import Lifted
from deep_nrsfm_ros.messages.serialised import Header
from deep_nrsfm_ros.node.body_messages import FrameMessages
from deep_nrsfm_ros.node.message_types import message_class


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
            kind = message_class("tf2_msgs/TFMessage")
        except ValueError:
            raise ValueError(
                f"tf_prefix is {prefix!r} and the package tf2_msgs is missing; install it "
                "(apt install ros-jazzy-tf2-msgs), or leave tf_prefix empty"
            ) from None
        self._messages, self._prefix = FrameMessages(kind), prefix
        # Depth 100, as in tf2_ros.
        self._publisher = node.create_publisher(kind, "/tf", 100)

    def send(self, header: Header, lifted: Lifted, identities: Sequence[str]) -> None:
        """Publish the frames of lifted objects, named by identity or, without one, by row."""
        names = [f"{self._prefix}{identity or i}" for i, identity in enumerate(identities)]
        self._publisher.publish(object_frames(self._messages, header, lifted, names))


def object_frames(
    messages: FrameMessages, header: Header, lifted: Lifted, names: Sequence[str]
) -> bytes:
    """Return the serialised transforms from lifted objects' frames to the header's frame.

    Args:
        messages: makes the message.
        header: of the message.
        lifted: n objects at their positions.
        names: n names of frames.
    """
    known = np.isfinite(lifted.residual)
    shapes, rotations = lifted.shapes[known], lifted.rotations[known].astype(np.float64)
    pose = Pose(shapes.mean(1)[:, None].astype(np.float64), rotations[:, None], np.empty((0, 0)))
    shown = tuple(name for name, is_known in zip(names, known, strict=True) if is_known)
    return messages(header, pose, (-1,), shown)
