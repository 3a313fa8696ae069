# SPDX-License-Identifier: Apache-2.0
"""The points of a running lifter as text: identity, keypoint, x, y, z and confidence."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from sensor_msgs.msg import MultiDOFJointState, PointCloud2
from std_msgs.msg import String

from deep_nrsfm_ros.messages.decoding import read_points
from deep_nrsfm_ros.node.subscriptions import LOG_PERIOD
from deep_nrsfm_ros.similar_names import did_you_mean

_LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


class PointsText:
    """Writes messages of a lifter as text, at most so many a second.

    Attributes:
        problem: a sentence on a keypoint that the lifter's model has not; "": there is none.
        written: number of messages written.
    """

    def __init__(
        self,
        node: Node,
        lifter: str,
        keypoints: Sequence[str],
        rate: float,
        write: Callable[[str], None],
    ) -> None:
        """Subscribe to the lifter.

        Args:
            node: subscribes.
            lifter: name of the lifter's node.
            keypoints: names of those to write; (): all.
            rate: messages a second at most; 0: all.
            write: takes the text of a message.
        """
        self.problem, self.written = "", 0
        self._node, self._lifter, self._keypoints, self._write = node, lifter, keypoints, write
        self._interval, self._last = 1 / rate if rate else 0.0, -np.inf
        self._names: list[str] = []
        self._waiting: PointCloud2 | None = None  # until the identities of its objects arrive
        sensor = qos_profile_sensor_data
        node.create_subscription(String, f"{lifter}/skeleton", self._skeleton, _LATCHED)
        node.create_subscription(PointCloud2, f"{lifter}/points", self._points, sensor)
        node.create_subscription(MultiDOFJointState, f"{lifter}/objects", self._objects, sensor)

    def _skeleton(self, message: String) -> None:
        """Keep the names of the model's keypoints, and check those that are asked for."""
        self._names = json.loads(message.data)["keypoints"]
        missing = [name for name in self._keypoints if name not in self._names]
        if missing:
            hint = did_you_mean(missing[0], self._names) or f"it has {', '.join(self._names)}"
            self.problem = f"the model of {self._lifter} has no keypoint {missing[0]!r}; {hint}"

    def _points(self, message: PointCloud2) -> None:
        """Keep the points until their identities arrive; write those whose identities did not."""
        if self._waiting is not None:
            self._take(self._waiting, ())
        self._waiting = message

    def _objects(self, message: MultiDOFJointState) -> None:
        """Write the waiting points with the identities of their objects."""
        points = self._waiting
        if points is not None and points.header.stamp == message.header.stamp:
            self._waiting = None
            self._take(points, message.joint_names)

    def _take(self, message: PointCloud2, identities: Sequence[str]) -> None:
        """Write a message, unless one was written a moment ago."""
        now = time.monotonic()
        if self.problem or now - self._last < self._interval:
            return
        try:
            points = read_points(message)
        except ValueError as problem:
            self._node.get_logger().warning(str(problem), throttle_duration_sec=LOG_PERIOD)
            return
        if points.shape[1] != len(self._names):
            return  # the names of this model have not arrived
        self._last = now
        self.written += 1
        self._write(self._text(message, points, identities))

    def _text(
        self, message: PointCloud2, points: NDArray[np.float32], identities: Sequence[str]
    ) -> str:
        """Return the text of a message: a line each keypoint of each object."""
        header = message.header
        frame = f" in {header.frame_id}" if header.frame_id else ""
        seconds = header.stamp.sec + 1e-9 * header.stamp.nanosec
        lines = [f"{seconds:.3f} s: x, y, z{frame}, confidence"]
        names = identities if len(identities) == len(points) else range(len(points))
        width = max(map(len, self._keypoints or self._names))
        for identity, row in zip(names, points, strict=True):
            if np.isnan(row[:, 0]).all():
                lines.append(f"{identity} is not lifted: too few keypoints")
                continue
            lines += [
                f"{identity} {name:{width}} {x:8.3f} {y:8.3f} {z:8.3f} {confidence:5.2f}"
                for name, (x, y, z, confidence) in zip(self._names, row.tolist(), strict=True)
                if not self._keypoints or name in self._keypoints
            ]
        return "\n".join(lines)
