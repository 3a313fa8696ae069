"""The objects as frames on /tf."""

from __future__ import annotations

import math
from collections.abc import Sequence

from geometry_msgs.msg import TransformStamped
from rclpy.node import Node

from deep_nrsfm_ros.lifting.lifter import Lifted
from deep_nrsfm_ros.messages.serialised import Header
from deep_nrsfm_ros.node import publishing


class TransformBroadcaster:
    """Sends the frame of each object: its origin the mean of the keypoints, its axes the object's.

    tf2_msgs is asked for only here: it comes with ROS, but not from PyPI.
    """

    def __init__(self, node: Node, prefix: str) -> None:
        """Raise ValueError, naming the package, where tf2_msgs is missing."""
        try:
            from tf2_msgs.msg import TFMessage
        except ModuleNotFoundError:
            raise ValueError(
                f"tf_prefix is {prefix!r} and the package tf2_msgs is missing; install it "
                "(apt install ros-jazzy-tf2-msgs), or leave tf_prefix empty"
            ) from None
        self._message, self._prefix = TFMessage, prefix
        # As tf2_ros has it.
        self._publisher = node.create_publisher(TFMessage, "/tf", 100)

    def send(self, header: Header, lifted: Lifted, identities: Sequence[str]) -> None:
        """Send the frames of the objects that were lifted, by their identities or numbers."""
        names = [f"{self._prefix}{identity or i}" for i, identity in enumerate(identities)]
        self._publisher.publish(self._message(transforms=frames(header, lifted, names)))


def frames(header: Header, lifted: Lifted, names: Sequence[str]) -> list[TransformStamped]:
    """Return what leads from the frame of each object to the header's; objects that are NaN lack.

    names: n, of the frames of the objects.
    """
    moves, stamped = publishing.transforms(lifted, positioned=True), publishing.to_header(header)
    return [
        TransformStamped(header=stamped, child_frame_id=name, transform=move)
        for name, move in zip(names, moves, strict=True)
        if not math.isnan(move.translation.x)
    ]
