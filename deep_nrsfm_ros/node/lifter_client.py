# SPDX-License-Identifier: Apache-2.0
"""Client of a running lifter: its points and rotations, joined with their keypoints."""

from __future__ import annotations

import time
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import QuaternionStamped
from rclpy.context import Context
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node, NodeNameNonExistentError
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import PointCloud2

from deep_nrsfm_ros.data.detections import gather
from deep_nrsfm_ros.data.keypoint_files import stamp_of
from deep_nrsfm_ros.data.lifted_bags import LiftedMessage
from deep_nrsfm_ros.data.recording import Recording, join_lifted_messages
from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.lifting.observation import Observation
from deep_nrsfm_ros.messages.decoding import INPUT_TYPES, read_observation, read_points
from deep_nrsfm_ros.messages.field_mapping import Size
from deep_nrsfm_ros.node.message_types import message_class
from deep_nrsfm_ros.node.shutdown import shut_down
from deep_nrsfm_ros.node.subscriptions import LOG_PERIOD
from deep_nrsfm_ros.nrsfm.geometry import rotation_from_quaternion

_MAX_WAITING = 100  # observations that are kept until their points arrive
_SEARCH_PERIOD = 0.5  # seconds between two searches for the keypoints' topic
_QOS = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)


def running_layout(lifter: str, seconds: float, domain: int | None = None) -> str:
    """Return the name of the keypoint layout with which a running lifter lifts.

    Args:
        lifter: name of the node.
        seconds: to wait for its diagnostics.
        domain: of DDS; None: that of ROS_DOMAIN_ID.

    Returns:
        The name as its diagnostics give it; "" if none were received.
    """
    found: list[str] = []
    name = f"/{lifter.strip('/')}: lifting"

    def receive(message: DiagnosticArray) -> None:
        for status in message.status:
            if status.name == name:
                found.extend(v.value for v in status.values if v.key == "keypoint layout")

    context = Context()
    rclpy.init(context=context, domain_id=domain)
    executor = SingleThreadedExecutor(context=context)
    node = Node("layout_client", context=context)
    node.create_subscription(DiagnosticArray, "/diagnostics", receive, 10)
    executor.add_node(node)
    try:
        end = time.monotonic() + seconds
        while not found and time.monotonic() < end:
            executor.spin_once(timeout_sec=0.1)
    except ExternalShutdownException:
        pass
    finally:
        executor.shutdown()
        node.destroy_node()
        shut_down(context)
    return found[0].split(" (")[0] if found else ""


@dataclass(frozen=True)
class LifterTopics:
    """Names and layouts of what a lifter receives and publishes.

    Attributes:
        lifter: name of the node.
        keypoints: topic of the keypoints; "" = the one that the lifter receives.
        source: layout of the keypoints.
        target: layout of the lifted points.
        min_confidence: in [0, 1]; a keypoint with less is missing.
        size: width and height of the image in pixels; None: unknown.
    """

    lifter: str
    keypoints: str
    source: KeypointLayout
    target: KeypointLayout
    min_confidence: float
    size: Size | None = None


class LifterClient(Node):
    """Passes on every lifted message as a `Recording` of one frame.

    The rotation is published after the points. A frame whose rotation does not arrive is passed on
    when the next points arrive.
    """

    def __init__(
        self,
        topics: LifterTopics,
        on_frame: Callable[[Recording], None],
        context: Context | None = None,
    ) -> None:
        """Subscribe to the lifter; the type of the keypoints is found when they are published.

        Args:
            topics: names and layouts.
            on_frame: called with each frame.
            context: of rclpy; None: the default context.
        """
        super().__init__("lifter_client", context=context)
        self._topics, self._on_frame = topics, on_frame
        # With its frame_id, by stamp; 0 for messages without a header.
        self._observations: OrderedDict[int, tuple[Observation, str]] = OrderedDict()
        self._waiting: LiftedMessage | None = None
        self._fixed_frame = ""
        self._keypoints = topics.keypoints and self.resolve_topic_name(topics.keypoints)
        lifter = topics.lifter.rstrip("/")
        self._lifter = self.resolve_topic_name(lifter)  # a node's full name follows the same rules
        self.create_subscription(PointCloud2, f"{lifter}/points", self._receive_points, 10)
        self.create_subscription(
            QuaternionStamped, f"{lifter}/camera_rotation", self._receive_rotation, 10
        )
        self._search = self.create_timer(_SEARCH_PERIOD, self._find_keypoints)

    def _find_keypoints(self) -> None:
        """Subscribe to the keypoints once they are published with a type that can be read."""
        for name, types in self._received_topics():
            for kind in (kind.replace("/msg/", "/") for kind in types):
                if self._keypoints in ("", name) and kind in INPUT_TYPES:
                    self.create_subscription(message_class(kind), name, self._receiver(kind), _QOS)
                    self.get_logger().info(f"subscribed to {name} ({kind})")
                    self._search.cancel()
                    return

    def _received_topics(self) -> list[tuple[str, list[str]]]:
        """Return names and types of the topics among which the keypoints are."""
        if self._keypoints:
            return self.get_topic_names_and_types()
        namespace, _, name = self._lifter.rpartition("/")
        try:
            return self.get_subscriber_names_and_types_by_node(name, namespace or "/")
        except NodeNameNonExistentError:  # not discovered yet
            return []

    def _receiver(self, kind: str) -> Callable[[Any], None]:
        """Return the callback that keeps the observation of a message of type `kind`."""

        def receive(message: Any) -> None:
            try:
                observation = read_observation(
                    message,
                    kind,
                    len(self._topics.source),
                    self._topics.min_confidence,
                    self._topics.size,
                )
            except ValueError as problem:
                self._warn(str(problem))
                return
            frame_id = getattr(getattr(message, "header", None), "frame_id", "")
            self._observations[stamp_of(message)] = observation, frame_id
            while len(self._observations) > _MAX_WAITING:
                self._observations.popitem(last=False)

        return receive

    def _receive_points(self, message: PointCloud2) -> None:
        """Keep the points until their rotation arrives."""
        self._flush()
        try:
            values = read_points(message)
        except ValueError as problem:
            self._warn(str(problem))
            return
        stamp, frame_id = stamp_of(message), message.header.frame_id
        self._waiting = LiftedMessage(stamp, values[..., :3], values[..., 3], None, frame_id)

    def _receive_rotation(self, message: QuaternionStamped) -> None:
        """Add the rotation to its points and pass them on."""
        q = message.quaternion
        if self._waiting and self._waiting.stamp == stamp_of(message):
            R = rotation_from_quaternion(np.array([q.x, q.y, q.z, q.w]))
            self._waiting = self._waiting._replace(rotation=R.astype(np.float32))
            self._flush()

    def _flush(self) -> None:
        """Pass on the waiting points, joined with the keypoints of their stamp."""
        lifted, self._waiting = self._waiting, None
        if lifted is None:
            return
        found = self._observations.get(lifted.stamp) or self._observations.get(0)
        source, target, fixed = self._topics.source, self._topics.target, ""
        detections = found and gather([found[0]], [lifted.stamp], len(source), found[1])
        if not detections and lifted.frame_id == self._fixed_frame:
            fixed = self._fixed_frame
        try:
            recording = join_lifted_messages([lifted], detections, source, target, fixed)
        except ValueError as problem:
            self._warn(str(problem))
            return
        if detections:
            self._fixed_frame = recording.fixed_frame
        self._on_frame(recording)

    def _warn(self, problem: str) -> None:
        """Log a problem, throttled."""
        self.get_logger().warning(problem, throttle_duration_sec=LOG_PERIOD)
