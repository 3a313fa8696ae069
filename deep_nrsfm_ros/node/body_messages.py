# SPDX-License-Identifier: Apache-2.0
"""Messages about the joints of objects: frames, angles, state of tracking, names."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import (
    PointStamped,
    TransformStamped,
    Twist,
    TwistStamped,
    Vector3,
)
from numpy.typing import NDArray
from rclpy.serialization import serialize_message
from sensor_msgs.msg import JointState, MultiDOFJointState
from std_msgs import msg as std_msgs

from deep_nrsfm_ros.body.kinematic_tree import Pose, quaternions
from deep_nrsfm_ros.body.motion import BRIDGED, LOST, Motion
from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.messages.serialised import Header
from deep_nrsfm_ros.node.serialised_template import (
    TRANSFORM_NUMBERS,
    SerialisedTemplate,
    TextTemplate,
    mark,
    template_header,
    template_transform,
    text_mark,
)

Floats = NDArray[Any]

_MAX_TEMPLATES = 32  # kept of each kind of message: one per set of names
_LEVELS = {BRIDGED: DiagnosticStatus.WARN, LOST: DiagnosticStatus.STALE}


def skeleton(layout: KeypointLayout) -> std_msgs.String:
    """Return names of keypoints, edges and joints of a layout as JSON."""
    description = {
        "layout": layout.name,
        "keypoints": list(layout.keypoints),
        "edges": [list(edge) for edge in layout.edges],
        "joints": [
            {
                "name": j.name,
                "parent": j.parent,
                "at": list(j.at),
                "angles": [a for a, _ in j.angles],
            }
            for j in layout.joints
        ],
    }
    return std_msgs.String(data=json.dumps(description))


@lru_cache(_MAX_TEMPLATES)
def joint_names(identities: tuple[str, ...], names: tuple[str, ...]) -> tuple[str, ...]:
    """Return the name of each joint or angle of each object: IDENTITY/NAME."""
    return tuple(f"{identity}/{name}" for identity in identities for name in names)


def joints(header: Header, names: tuple[str, ...], pose: Pose, velocities: Floats) -> bytes:
    """Return the serialised MultiDOFJointState of all joints of n objects.

    Args:
        header: of the message; transforms are to its frame.
        names: n j names, object by object.
        pose: of the objects.
        velocities: (n, j, 3) linear, in the axes of the header's frame.
    """
    n, j = pose.origins.shape[:2]
    template = _joints(header.frame_id, names)
    numbers = np.concatenate([pose.origins, quaternions(pose.rotations)], -1).reshape(n * j, -1)
    return template(header, np.concatenate([numbers.ravel(), velocities.ravel()]))


@lru_cache(_MAX_TEMPLATES)
def _joints(frame_id: str, names: tuple[str, ...]) -> SerialisedTemplate:
    """Return the template of the joints' transforms and velocities."""
    message = MultiDOFJointState(header=template_header(frame_id), joint_names=list(names))
    count = len(names)
    message.transforms = [template_transform(i) for i in range(count)]
    start = TRANSFORM_NUMBERS * count
    message.twist = [
        Twist(linear=Vector3(**{k: mark(start + 3 * i + d) for d, k in enumerate("xyz")}))
        for i in range(count)
    ]
    return SerialisedTemplate(message, start + 3 * count)


def angles(header: Header, names: tuple[str, ...], values: Floats) -> bytes:
    """Return the serialised JointState of angles (n, a) in radians with n a names."""
    return _angles(header.frame_id, names)(header, values)


@lru_cache(_MAX_TEMPLATES)
def _angles(frame_id: str, names: tuple[str, ...]) -> SerialisedTemplate:
    """Return the template of angles."""
    message = JointState(header=template_header(frame_id), name=list(names))
    message.position = [mark(i) for i in range(len(names))]
    return SerialisedTemplate(message, len(names))


class FrameMessages:
    """Makes the serialised TFMessages of joints, each in the frame of its parent.

    tf2_msgs is not imported here: ROS has it, PyPI has not.
    """

    def __init__(self, kind: Any, serialise: Callable[[Any], bytes] = serialize_message) -> None:
        """Prepare messages of a type.

        Args:
            kind: class TFMessage.
            serialise: returns the bytes of such a message.
        """
        self._kind, self._serialise = kind, serialise

    def __call__(
        self, header: Header, pose: Pose, parents: tuple[int, ...], names: tuple[str, ...]
    ) -> bytes:
        """Return the serialised TFMessage of the j joints of n objects.

        Args:
            header: of the message; a joint without a parent is given in its frame.
            pose: of the objects.
            parents: j indices, -1 for none.
            names: n j names of frames, object by object.
        """
        above = [max(parent, 0) for parent in parents]
        upper = pose.rotations[:, above].swapaxes(-1, -2)
        R = upper @ pose.rotations
        t = (upper @ (pose.origins - pose.origins[:, above])[..., None])[..., 0]
        R[:, 0], t[:, 0] = pose.rotations[:, 0], pose.origins[:, 0]
        template = _frames(self._kind, header.frame_id, names, parents, self._serialise)
        return template(header, np.concatenate([t, quaternions(R)], -1))


@lru_cache(_MAX_TEMPLATES)
def _frames(
    kind: Any,
    frame_id: str,
    names: tuple[str, ...],
    parents: tuple[int, ...],
    serialise: Callable[[Any], bytes],
) -> SerialisedTemplate:
    """Return the template of a TFMessage."""
    j = len(parents)
    transforms = []
    for i, name in enumerate(names):
        parent = parents[i % j]
        above = names[i - i % j + parent] if parent >= 0 else frame_id
        transforms.append(
            TransformStamped(
                header=template_header(above),
                child_frame_id=name,
                transform=template_transform(i),
            )
        )
    count = TRANSFORM_NUMBERS * len(names)
    return SerialisedTemplate(kind(transforms=transforms), count, serialise)


def tracks(header: Header, identities: Sequence[str], motion: Motion, confidence: Floats) -> bytes:
    """Return the serialised state of tracking of each identity, and those that are lost.

    Args:
        header: of the message.
        identities: n.
        motion: of them.
        confidence: (n,) of the objects.
    """
    pairs = zip(motion.ages.tolist(), confidence.tolist(), strict=True)
    texts = [f"{value:.3f}" for pair in pairs for value in pair]
    states = (*zip(identities, motion.states, strict=True), *((n, LOST) for n in motion.lost))
    return _tracks(header.frame_id, states, tuple(map(len, texts)))(header, texts)


@lru_cache(_MAX_TEMPLATES)
def _tracks(
    frame_id: str, states: tuple[tuple[str, str], ...], lengths: tuple[int, ...]
) -> TextTemplate:
    """Return the template of names and states; the first of them have two texts, of two lengths."""
    message = DiagnosticArray(header=template_header(frame_id))
    for i, (identity, state) in enumerate(states):
        pair = range(2 * i, min(2 * i + 2, len(lengths)))
        texts = zip(("age", "confidence"), pair, strict=False)
        values = [KeyValue(key=key, value=text_mark(k, lengths[k])) for key, k in texts]
        level = _LEVELS.get(state, DiagnosticStatus.OK)
        message.status.append(
            DiagnosticStatus(level=level, name=identity, message=state, values=values)
        )
    return TextTemplate(message, lengths)


def position(header: Header, point: Floats) -> bytes:
    """Return the serialised PointStamped of a point (3,)."""
    return _position(header.frame_id)(header, point)


@lru_cache(_MAX_TEMPLATES)
def _position(frame_id: str) -> SerialisedTemplate:
    """Return the template of a point."""
    message = PointStamped(header=template_header(frame_id))
    message.point.x, message.point.y, message.point.z = mark(0), mark(1), mark(2)
    return SerialisedTemplate(message, 3)


def velocity(header: Header, linear: Floats) -> bytes:
    """Return the serialised TwistStamped of a linear velocity (3,)."""
    return _velocity(header.frame_id)(header, linear)


@lru_cache(_MAX_TEMPLATES)
def _velocity(frame_id: str) -> SerialisedTemplate:
    """Return the template of a velocity."""
    message = TwistStamped(header=template_header(frame_id))
    v = message.twist.linear
    v.x, v.y, v.z = mark(0), mark(1), mark(2)
    return SerialisedTemplate(message, 3)
