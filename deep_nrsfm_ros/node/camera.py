"""The camera that the keypoints come from: its CameraInfo, as the lifter hears it."""

from __future__ import annotations

from dataclasses import dataclass

from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CameraInfo

from deep_nrsfm_ros.configuration import option
from deep_nrsfm_ros.lifting.intrinsics import Intrinsics
from deep_nrsfm_ros.lifting.observation import MessageError
from deep_nrsfm_ros.messages.camera_info import read_camera_info
from deep_nrsfm_ros.messages.field_mapping import Size

# Drivers send it with every image; a simulator or a bag may send it once and keep it.
_STREAM = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
_LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


@dataclass(frozen=True)
class CameraOptions:
    """Camera of the keypoints."""

    camera_info: str = option(
        "",
        "topic with the sensor_msgs/CameraInfo of the camera: objects come out at their place "
        "before it, and nothing is lifted before it is heard; empty: they come out centred",
        read_only=True,
    )
    rectified: bool = option(
        False,
        "the keypoints are those of the rectified image, without distortion, to which CameraInfo's "
        "P belongs, not K and D",
        read_only=True,
    )
    tf_prefix: str = option(
        "",
        "the frame of each object is sent on /tf, its name this and the identity of the object "
        "(see ~/objects); needs camera_info; empty: none",
        read_only=True,
    )


class CameraInfoSubscription:
    """What is known of the camera from the last CameraInfo.

    frame: its frame_id. size: width and height of the image, None if they are unknown.
    intrinsics: None before the first usable message, and always where no CameraInfo is wanted.
    """

    def __init__(self, node: Node, options: CameraOptions) -> None:
        """Listen where the options say; raise ValueError if they do not fit each other."""
        if options.tf_prefix and not options.camera_info:
            raise ValueError(
                f"tf_prefix is {options.tf_prefix!r} without camera_info: a frame needs a place"
            )
        self.wanted = bool(options.camera_info)
        self.intrinsics: Intrinsics | None = None
        self.frame = ""
        self.size: Size | None = None
        self._rectified = options.rectified
        self._topic = ""
        self._problem = "has not come yet: is the camera's driver running?"
        if not self.wanted:
            return
        for qos in (_STREAM, _LATCHED):
            subscription = node.create_subscription(
                CameraInfo,
                options.camera_info,
                self._take,
                qos,
                # Most publishers are not latched, which is no fault.
                event_callbacks=SubscriptionEventCallbacks(use_default_callbacks=False),
            )
            self._topic = subscription.topic_name

    def known(self) -> Intrinsics | None:
        """Return the intrinsics, None if none are wanted; raise MessageError while they lack."""
        if self.wanted and self.intrinsics is None:
            raise MessageError(f"CameraInfo on {self._topic} {self._problem}")
        return self.intrinsics

    @property
    def status(self) -> str:
        """Return in words what is known."""
        if not self.wanted:
            return "none: objects are centred"
        if self.intrinsics is None:
            return f"CameraInfo on {self._topic} {self._problem}"
        return f"{self.intrinsics.lens}, focal length {self.intrinsics.focal[0]:.1f} pixels"

    def _take(self, message: CameraInfo) -> None:
        """Keep what a CameraInfo says, or why it says nothing."""
        try:
            self.intrinsics = read_camera_info(message, rectified=self._rectified)
        except MessageError as problem:
            self.intrinsics, self._problem = None, f"cannot be used: {problem}"
        self.frame = message.header.frame_id
        known = message.width and message.height
        self.size = (message.width, message.height) if known else None
