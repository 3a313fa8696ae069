# SPDX-License-Identifier: Apache-2.0
"""The camera that the keypoints come from: its CameraInfo, or its field of view."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass

from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.subscription import Subscription
from sensor_msgs.msg import CameraInfo

from deep_nrsfm_ros.configuration import described, option
from deep_nrsfm_ros.lifting.intrinsics import Intrinsics
from deep_nrsfm_ros.lifting.observation import MessageError
from deep_nrsfm_ros.lifting.options import FieldOfViewOptions
from deep_nrsfm_ros.messages.camera_info import read_camera_info
from deep_nrsfm_ros.messages.field_mapping import Size

# Drivers publish CameraInfo with every image: best effort fits all of them. A simulator or a bag
# may publish it once, latched, and only a latched subscription receives what was sent before it.
_STREAM = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
_TYPE = "sensor_msgs/msg/CameraInfo"
_LOOK_PERIOD = 2.0  # seconds between two looks at the topics
_SEARCH_PERIOD = 0.2  # seconds between two looks for a latched publisher, while messages wait
_LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
_UNKNOWN_VIEW = FieldOfViewOptions()


@dataclass(frozen=True)
@described
class CameraOptions:
    """Camera of the keypoints."""

    camera_info: str = option(
        "",
        "topic of the camera's sensor_msgs/CameraInfo: objects are lifted to their positions in "
        "the optical frame, and only once a CameraInfo has been received; empty = they are so by "
        "field_of_view, or else centred on their keypoints",
        read_only=True,
    )
    rectified: bool = option(
        False,
        "whether the keypoints are those of the rectified image (CameraInfo's P) and not of the "
        "raw image (K and D)",
        read_only=True,
    )
    frame_id: str = option(
        "",
        "frame of points, markers and /tf where the header of the keypoints has no frame_id, or "
        "their type has no header; empty = the frame of CameraInfo, if that is known",
        read_only=True,
    )
    tf_prefix: str = option(
        "",
        "prefix of the frames of objects on /tf; the name of a frame is the prefix and the "
        "identity of the object (see ~/objects); needs camera_info or field_of_view; empty = no "
        "frames",
        read_only=True,
    )
    camera_height: float = option(
        0.0,
        "height in metres of the camera above the floor that people stand on: the lowest keypoint "
        "of each, averaged over seconds, says how large and how far away it is, whatever its "
        "height; needs camera_info or field_of_view and the direction of gravity (gravity.* or "
        "target_frame), and is wrong for people on steps or whose feet are hidden; 0 = unknown, "
        "1.4 typical",
        low=0.0,
        high=100.0,
        read_only=True,
    )


class Camera:
    """Keeps the intrinsics of the last CameraInfo, or those of the field of view.

    Attributes:
        enabled: whether the options name a topic or a field of view.
        intrinsics: of the camera; None before the first usable CameraInfo, and if not enabled.
        frame: frame_id of the camera, "" if unknown.
        size: width and height of the image in pixels, None if unknown.
    """

    def __init__(
        self,
        node: Node,
        options: CameraOptions,
        view: FieldOfViewOptions = _UNKNOWN_VIEW,
        image_size: Size | None = None,
    ) -> None:
        """Subscribe to the topic of the options, if they name one.

        Args:
            node: subscribes.
            options: name the topic.
            view: field of view, where there is no topic.
            image_size: width and height in pixels that the parameters give; see `set_image_size`.

        Raises:
            ValueError: an option needs another one, or two contradict each other.
        """
        if options.camera_info and view.field_of_view:
            raise ValueError(
                f"field_of_view is {view.field_of_view:g} and camera_info is "
                f"{options.camera_info!r}, whose CameraInfo says it too: leave field_of_view out"
            )
        if options.rectified and not options.camera_info:
            raise ValueError(
                "rectified is true without camera_info: it chooses between the two cameras of a "
                "CameraInfo; set camera_info to its topic, or leave rectified out"
            )
        self.enabled = bool(options.camera_info or view.field_of_view)
        if options.tf_prefix and not self.enabled:
            raise ValueError(
                f"tf_prefix is {options.tf_prefix!r} without camera_info or field_of_view: a frame "
                "needs a place; set camera_info to the topic of the camera's CameraInfo, or leave "
                "tf_prefix empty"
            )
        if options.camera_height and not self.enabled:
            raise ValueError(
                f"camera_height is {options.camera_height:g} without camera_info or field_of_view: "
                "the floor gives the size of objects that have a place; set one, or leave it out"
            )
        self.intrinsics: Intrinsics | None = None
        self._view = view
        self.frame = ""
        self.size: Size | None = None
        self._rectified = options.rectified
        self._topic, self._name = "", options.camera_info
        self._latched: Subscription | None = None
        self._searched = -math.inf
        self._problem = ""
        self._node, self._silence, self._looked = node, "", -math.inf
        self.set_image_size(image_size)
        if not options.camera_info:
            return
        stream = node.create_subscription(CameraInfo, options.camera_info, self._receive, _STREAM)
        self._topic = stream.topic_name
        self.update()

    def update(self) -> None:
        """Subscribe latched while there is a latched publisher; call it once a second.

        A latched subscription beside other publishers would make each of them warn of an
        incompatible quality of service.
        """
        if not self._topic:
            return
        self._searched = time.monotonic()
        publishers = self._node.get_publishers_info_by_topic(self._topic)
        offers = [publisher.qos_profile for publisher in publishers]
        latched = any(
            offer.durability == DurabilityPolicy.TRANSIENT_LOCAL
            and offer.reliability == ReliabilityPolicy.RELIABLE
            for offer in offers
        )
        if latched and self._latched is None:
            self._latched = self._node.create_subscription(
                CameraInfo,
                self._name,
                self._receive,
                _LATCHED,
                # Another publisher may not be latched: an incompatible QoS is no problem here.
                event_callbacks=SubscriptionEventCallbacks(use_default_callbacks=False),
            )
        elif not latched and self._latched is not None:
            self._node.destroy_subscription(self._latched)
            self._latched = None

    def set_image_size(self, size: Size | None) -> None:
        """Set width and height in pixels, which the intrinsics of a field of view depend on.

        Raises:
            ValueError: there is a field of view, and no size.
        """
        if self._view.field_of_view:
            self.intrinsics, self.size = self._view.intrinsics(size), size

    def require_intrinsics(self) -> Intrinsics | None:
        """Return the intrinsics, None if not enabled.

        Raises:
            MessageError: no usable CameraInfo has been received.
        """
        if self.enabled and self.intrinsics is None:
            if time.monotonic() - self._searched > _SEARCH_PERIOD:
                self.update()
            raise MessageError(self._missing())
        return self.intrinsics

    @property
    def status(self) -> str:
        """The state as text, for diagnostics."""
        if not self.enabled:
            return "none: objects are centred"
        if self.intrinsics is None:
            return self._missing()
        if angle := self._view.field_of_view:
            focal = f"focal length {self.intrinsics.focal[0]:.1f} pixels"
            return f"field of view {angle:g} degrees, {focal}"
        return f"{self.intrinsics.lens}, focal length {self.intrinsics.focal[0]:.1f} pixels"

    def _missing(self) -> str:
        """Return why there are no intrinsics, and the remedy."""
        if not self._problem and time.monotonic() - self._looked > _LOOK_PERIOD:
            self._looked = time.monotonic()
            self._silence = self._why_silent()
        return f"CameraInfo on {self._topic} {self._problem or self._silence}"

    def _why_silent(self) -> str:
        """Return why no CameraInfo has been received, from the topics that there are."""
        kinds = dict(self._node.get_topic_names_and_types())
        publishers = self._node.get_publishers_info_by_topic(self._topic)
        if others := [p.topic_type for p in publishers if p.topic_type != _TYPE]:
            return f"has not been received: the topic carries {others[0]}"
        if publishers:
            return (
                "has not been received: it has a publisher, which has sent nothing yet; is the "
                "camera's driver running?"
            )
        found = [
            name
            for name, types in kinds.items()
            if _TYPE in types and self._node.count_publishers(name)
        ]
        known = f"; CameraInfo is published on {', '.join(found)}: set camera_info" if found else ""
        return (
            f"has not been received: nobody publishes it{known or '; start the camera driver'}, or "
            "leave camera_info empty to lift without places, or by a field_of_view"
        )

    def _receive(self, message: CameraInfo) -> None:
        """Keep the intrinsics of a CameraInfo, or the reason why it has none."""
        try:
            self.intrinsics = read_camera_info(message, rectified=self._rectified)
        except MessageError as problem:
            self.intrinsics, self._problem = None, f"cannot be used: {problem}"
        self.frame = message.header.frame_id
        known = message.width and message.height
        self.size = (message.width, message.height) if known else None
