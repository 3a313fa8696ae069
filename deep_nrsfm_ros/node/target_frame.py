# SPDX-License-Identifier: Apache-2.0
"""Objects in a fixed frame, such as map, and not in that of the camera."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from rclpy.node import Node

from deep_nrsfm_ros.configuration import described, option
from deep_nrsfm_ros.lifting.lifter import Lifted
from deep_nrsfm_ros.lifting.observation import MessageError
from deep_nrsfm_ros.messages.frame_tree import FrameTree, Transform
from deep_nrsfm_ros.messages.serialised import Header
from deep_nrsfm_ros.node.gravity import FRAME_MEND, Gravity, subscribe_to_frames
from deep_nrsfm_ros.node.message_types import message_class

_NUMBERS = 7
_MAX_GAP = 0.05  # s between keypoints and the nearest transform, above which there is a warning

_POSE_MEND = (
    "check the quaternion of camera_pose: it turns the optical frame's axes (x right, y down, z "
    "forward), so that of a level camera that looks along x is -0.5 0.5 -0.5 0.5"
)


@dataclass(frozen=True)
@described
class TargetOptions:
    """Fixed frame."""

    target_frame: str = option(
        "",
        "frame in which points, markers, objects and joints are given, such as map, odom or "
        "base_link, with z up, so that the direction against gravity is known too; needs "
        "camera_info or field_of_view, and /tf (tf2_msgs) or camera_pose; empty = the camera's "
        "optical frame",
        read_only=True,
    )
    camera_pose: tuple[float, ...] = option(
        (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
        "pose of a camera at rest in target_frame, where nobody publishes it on /tf: x y z in "
        "metres, then the quaternion x y z w of the optical frame's axes (x right, y down, z "
        "forward), as in 0 0 1.4 -0.5 0.5 -0.5 0.5 for a level camera 1.4 m high that looks along "
        "x; a quaternion of zeros = from /tf",
        read_only=True,
    )

    def __post_init__(self) -> None:
        """Raise ValueError unless the pose is seven finite numbers."""
        if len(self.camera_pose) != _NUMBERS or not all(map(math.isfinite, self.camera_pose)):
            raise ValueError(f"camera_pose is {list(self.camera_pose)}; it must be seven numbers")


class TargetFrame:
    """Transforms lifted objects from the camera's frame to a fixed one."""

    def __init__(self, node: Node, options: TargetOptions, *, positioned: bool) -> None:
        """Use the pose of the options, or subscribe to /tf.

        Args:
            node: subscribes.
            options: name the frame.
            positioned: whether objects are at their positions.

        Raises:
            ValueError: there are no positions, or the package tf2_msgs is needed and missing.
        """
        self.name = options.target_frame
        self._pose = options.camera_pose if any(options.camera_pose[3:]) else None
        self._tree = FrameTree()
        self._node, self._warned = node, False
        if not self.name:
            if self._pose:
                raise ValueError("camera_pose is set without target_frame, the frame that it is in")
            return
        if not positioned:
            raise ValueError(
                f"target_frame is {self.name!r} without camera_info or field_of_view: only an "
                "object with a place has one in another frame; set camera_info to the topic of the "
                "CameraInfo"
            )
        if self._pose is None:
            try:
                message = message_class("tf2_msgs/TFMessage")
            except ValueError as error:
                raise ValueError(
                    f"target_frame is {self.name!r}: {error}, or set camera_pose"
                ) from None
            subscribe_to_frames(node, message, self._tree)

    def transform(self, header: Header) -> Transform | None:
        """Return the transform from a camera's frame to the target at a stamp; None: unknown."""
        frame = header.frame_id or "camera"
        if self._pose is not None:
            x, y, z, *q = self._pose
            self._tree.add(self.name, frame, (q[0], q[1], q[2], q[3]), (x, y, z))
        found = self._tree.transform(self.name, frame, header.stamp)
        if found and found.gap > _MAX_GAP and not self._warned:
            self._warned = True
            self._node.get_logger().warning(
                f"no transform from {frame!r} to target_frame {self.name!r} at the stamps of the "
                f"keypoints ({found.gap:.3f} s off): the nearest in time is used"
            )
        return found

    def up(self, header: Header) -> NDArray[np.float64] | None:
        """Return the direction (3,) of the target's z axis in a camera's axes; None: unknown."""
        return self.gravity(header).up

    def gravity(self, header: Header) -> Gravity:
        """Return the direction of the target's z axis in a camera's axes, and its source."""
        if not self.name:
            return Gravity(None)
        found = self.transform(header)
        if found is None:
            return Gravity(None, f"target_frame {self.name} on /tf")
        by = f"target_frame {self.name}"
        up = np.ascontiguousarray(found.rotation[2])
        if self._pose is None:
            return Gravity(up, by, FRAME_MEND)
        return Gravity(up, f"camera_pose in {by}", _POSE_MEND)

    def __call__(self, header: Header, lifted: Lifted) -> tuple[Header, Lifted]:
        """Return objects in the target frame, and their header.

        Raises:
            MessageError: the camera's pose in the target frame is not known yet.
        """
        found = self.transform(header)
        if found is None:
            raise MessageError(
                f"no transform from {header.frame_id!r} to target_frame {self.name!r} on /tf yet"
            )
        R, t = (part.astype(np.float32) for part in found[:2])
        moved = lifted._replace(shapes=lifted.shapes @ R.T + t, rotations=R @ lifted.rotations)
        return header._replace(frame_id=self.name), moved
