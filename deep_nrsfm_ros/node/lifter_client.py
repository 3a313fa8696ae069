"""Watch a lifter at work: its answers, joined with the keypoints that they are about."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from typing import Any

import numpy as np
from geometry_msgs.msg import QuaternionStamped
from rclpy.context import Context
from rclpy.node import Node
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
from deep_nrsfm_ros.node.subscriptions import LOG_PERIOD
from deep_nrsfm_ros.nrsfm.geometry import rotation_from_quaternion

_KEPT = 100  # observations that wait for their answers
_LOOK = 0.5  # seconds between looks for the keypoints' topic
_QOS = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)


class LifterClient(Node):
    """Gives every frame that a lifter answers to `show`, as a `Recording` of one frame.

    The rotation follows the points; a frame without one is shown when the next points come.
    """

    def __init__(
        self,
        lifter: str,
        keypoints: str,
        source: KeypointLayout,
        target: KeypointLayout,
        min_confidence: float,
        size: Size | None,
        show: Callable[[Recording], None],
        context: Context | None = None,
    ) -> None:
        """Listen to the node called `lifter` and to the topic `keypoints`, whatever its type."""
        super().__init__("lifter_client", context=context)
        self._source, self._target, self._show = source, target, show
        self._min_confidence, self._size = min_confidence, size
        self._seen: OrderedDict[int, Observation] = OrderedDict()  # by stamp; 0: has no header
        self._waiting: LiftedMessage | None = None
        self._keypoints = self.resolve_topic_name(keypoints)
        lifter = lifter.rstrip("/")
        self.create_subscription(PointCloud2, f"{lifter}/points", self._take_points, 10)
        self.create_subscription(
            QuaternionStamped, f"{lifter}/camera_rotation", self._take_rotation, 10
        )
        self._search = self.create_timer(_LOOK, self._look_for_keypoints)

    def _look_for_keypoints(self) -> None:
        """Listen to the keypoints once somebody publishes them in a type that can be read."""
        for name, types in self.get_topic_names_and_types():
            for kind in (kind.replace("/msg/", "/") for kind in types):
                if name == self._keypoints and kind in INPUT_TYPES:
                    self.create_subscription(message_class(kind), name, self._taker(kind), _QOS)
                    self.get_logger().info(f"listening to {name} ({kind})")
                    self._search.cancel()
                    return

    def _taker(self, kind: str) -> Callable[[Any], None]:
        """Return what keeps the observation in a message of type `kind`."""

        def take(message: Any) -> None:
            try:
                seen = read_observation(
                    message, kind, len(self._source), self._min_confidence, self._size
                )
            except ValueError as problem:
                self._complain(str(problem))
                return
            self._seen[stamp_of(message)] = seen
            while len(self._seen) > _KEPT:
                self._seen.popitem(last=False)

        return take

    def _take_points(self, message: PointCloud2) -> None:
        """Keep the points until their rotation comes."""
        self._flush()
        try:
            values = read_points(message)
        except ValueError as problem:
            self._complain(str(problem))
            return
        self._waiting = LiftedMessage(stamp_of(message), values[..., :3], values[..., 3], None)

    def _take_rotation(self, message: QuaternionStamped) -> None:
        """Show the points that were waiting for it."""
        q = message.quaternion
        if self._waiting and self._waiting.stamp == stamp_of(message):
            R = rotation_from_quaternion(np.array([q.x, q.y, q.z, q.w]))
            self._waiting = self._waiting._replace(rotation=R.astype(np.float32))
            self._flush()

    def _flush(self) -> None:
        """Show the points that wait, beside the keypoints of their stamp."""
        answer, self._waiting = self._waiting, None
        if answer is None:
            return
        seen = self._seen.get(answer.stamp) or self._seen.get(0)
        detections = seen and gather([seen], [answer.stamp], len(self._source))
        try:
            self._show(join_lifted_messages([answer], detections, self._source, self._target))
        except ValueError as problem:
            self._complain(str(problem))

    def _complain(self, problem: str) -> None:
        self.get_logger().warning(problem, throttle_duration_sec=LOG_PERIOD)
