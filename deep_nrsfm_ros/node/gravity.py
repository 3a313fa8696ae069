# SPDX-License-Identifier: Apache-2.0
"""The direction of gravity in the camera's axes, from a parameter, an IMU or /tf."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Imu

from deep_nrsfm_ros.configuration import described, option
from deep_nrsfm_ros.messages.frame_tree import FrameTree
from deep_nrsfm_ros.messages.serialised import Header
from deep_nrsfm_ros.nrsfm.geometry import rotation_from_quaternion

_STREAM = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
_STATIC = QoSProfile(
    depth=100,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)
_GRAVITY = 9.81  # m/s^2
_MAX_ACCELERATION = 3.0  # m/s^2 beside gravity, above which a measurement is left out
_AVERAGED = 0.5  # s, time constant of the mean of the measurements
_MAX_AGE = 5.0  # s after which the last measurement is no longer used


def subscribe_to_frames(node: Node, kind: type, tree: FrameTree) -> None:
    """Keep the transforms of /tf and /tf_static in a tree.

    Args:
        node: subscribes.
        kind: class tf2_msgs/TFMessage.
        tree: is filled.
    """

    def receive(message: Any, *, is_static: bool = False) -> None:
        for each in message.transforms:
            q, t, at = each.transform.rotation, each.transform.translation, each.header.stamp
            stamp = 0 if is_static else Header(at.sec, at.nanosec).stamp
            turn, shift = (q.x, q.y, q.z, q.w), (t.x, t.y, t.z)
            tree.add(each.header.frame_id, each.child_frame_id, turn, shift, stamp)

    node.create_subscription(kind, "/tf", receive, QoSProfile(depth=100))
    node.create_subscription(kind, "/tf_static", partial(receive, is_static=True), _STATIC)


@dataclass(frozen=True)
@described
class GravitySources:
    """Sources of the direction of gravity."""

    imu: str = option(
        "",
        "topic of a sensor_msgs/Imu that is fixed to the camera: its mean acceleration of half a "
        "second is the direction against gravity; its frame is turned to that of the keypoints by "
        "/tf, or is taken as the camera's optical frame where there is no /tf; empty = no IMU",
        read_only=True,
    )
    frame: str = option(
        "",
        "frame on /tf whose z axis points up, such as map, odom or base_link: gives the direction "
        "against gravity in the frame of the keypoints; needs tf2_msgs; empty = no frame",
        read_only=True,
    )


class Gravity(NamedTuple):
    """The direction against gravity, and who says so.

    Attributes:
        up: (3,) unit vector against gravity in the axes of the keypoints' frame; None: unknown.
        source: of the direction, or what is waited for.
        mend: what to check where the direction is wrong.
    """

    up: NDArray[np.float64] | None
    source: str = ""
    mend: str = ""

    @property
    def status(self) -> str:
        """The state as text, for diagnostics."""
        if self.up is None:
            return f"waiting for {self.source}" if self.source else "unknown"
        x, y, z = np.round(self.up, 2) + 0.0  # without -0.00
        return f"up is {x:.2f} {y:.2f} {z:.2f} in the camera's axes, by {self.source}"


_BY_PARAMETER = (
    "gravity.up",
    "check its sign and its axes (x right, y down, z forward): it points up, so that of a level "
    "camera is [0.0, -1.0, 0.0]",
)
FRAME_MEND = (
    "check that the frame_id of the keypoints is the camera's optical frame (z forward) and not "
    "that of its body (x forward), and its rotation on /tf"
)
"""What to check where a transform of /tf gives a wrong direction."""


class GravityDirection:
    """Keeps the direction against gravity; a frame comes before an IMU, and both before `up`."""

    def __init__(self, node: Node, sources: GravitySources) -> None:
        """Subscribe to what the options name.

        Raises:
            ValueError: the package tf2_msgs is needed and is not installed.
        """
        self._sources, self._node = sources, node
        self._tree = FrameTree()
        self._mean: NDArray[Any] | None = None
        self._imu_frame, self._measured = "", -math.inf
        if sources.imu:
            node.create_subscription(Imu, sources.imu, self._receive_imu, _STREAM)
        if sources.imu or sources.frame:
            self._listen_to_frames(required=bool(sources.frame))

    def __call__(
        self, up: NDArray[np.float64] | None, frame: str, stamp: int = 0
    ) -> NDArray[np.float64] | None:
        """Return the unit vector (3,) against gravity in the axes of `frame`; None: unknown.

        Args:
            up: what the parameter says; None: nothing.
            frame: optical frame of the keypoints.
            stamp: of the keypoints in ns, for the transforms of /tf; 0: the newest.
        """
        return self.find(up, frame, stamp).up

    def find(self, up: NDArray[np.float64] | None, frame: str, stamp: int = 0) -> Gravity:
        """Return the direction and its source; the arguments are those of a call."""
        sources = self._sources
        if sources.frame and frame:
            R = self._tree.rotation(frame, sources.frame, stamp)
            if R is not None:
                by = f"gravity.frame {sources.frame}"
                return Gravity(np.ascontiguousarray(R[:, 2]), by, FRAME_MEND)
        if self._mean is not None and self._now() - self._measured <= _MAX_AGE:
            return self._by_imu(self._mean, frame)
        if up is not None:
            return Gravity(up, *_BY_PARAMETER)
        waits = [f"frame {sources.frame} on /tf"] if sources.frame else []
        waits += [f"IMU on {sources.imu}"] if sources.imu else []
        return Gravity(None, " or ".join(waits))

    def status(self, up: NDArray[np.float64] | None, frame: str) -> str:
        """Return the state as text, for diagnostics."""
        return self.find(up, frame).status

    def _by_imu(self, mean: NDArray[Any], frame: str) -> Gravity:
        """Return the direction of the mean acceleration of the IMU."""
        R, own = self._tree.rotation(frame, self._imu_frame), self._imu_frame or "its frame"
        turned = mean if R is None else R @ mean
        by, is_camera = f"the IMU on {self._sources.imu}", self._imu_frame in ("", frame)
        mend = f"check the rotation from {own} to {frame or 'the camera'} on /tf"
        if R is None or is_camera:
            by += "" if is_camera else f", whose {own} is taken as the camera's optical frame"
            mend = (
                f"check that the axes of {own} are those of the camera's optical frame (x right, y "
                "down, z forward), or publish its frame on /tf; gravity.up says the direction too"
            )
        return Gravity(np.asarray(turned / np.linalg.norm(turned), np.float64), by, mend)

    def _listen_to_frames(self, *, required: bool) -> None:
        """Subscribe to /tf and /tf_static."""
        try:
            from tf2_msgs.msg import TFMessage
        except ModuleNotFoundError:
            if not required:
                return
            raise ValueError(
                f"gravity.frame is {self._sources.frame!r} and the package tf2_msgs is missing; "
                "install it (apt install ros-jazzy-tf2-msgs), or set gravity.up or gravity.imu"
            ) from None
        subscribe_to_frames(self._node, TFMessage, self._tree)

    def _receive_imu(self, message: Imu) -> None:
        """Average the acceleration of an Imu, or take its orientation if it has none."""
        a = message.linear_acceleration
        measured, q = np.array([a.x, a.y, a.z]), message.orientation
        if not measured.any() and message.orientation_covariance[0] >= 0 and (q.x or q.y or q.z):
            quaternion = np.array([q.x, q.y, q.z, q.w])
            measured = _GRAVITY * rotation_from_quaternion(quaternion)[2]
        if not abs(float(np.linalg.norm(measured)) - _GRAVITY) <= _MAX_ACCELERATION:
            return
        now = self._now()
        passed = max(now - self._measured, 0.0)
        if self._mean is None or passed > _MAX_AGE:
            self._mean = measured
        else:
            self._mean = self._mean + (1 - math.exp(-passed / _AVERAGED)) * (measured - self._mean)
        self._imu_frame, self._measured = message.header.frame_id, now

    def _now(self) -> float:
        """Return the time in seconds."""
        return 1e-9 * float(self._node.get_clock().now().nanoseconds)
