# SPDX-License-Identifier: Apache-2.0
"""Kinematic trees of layouts: joints, the directions that their frames follow, their angles."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from deep_nrsfm_ros.similar_names import did_you_mean

Pair = tuple[str, str]

WORDS = {
    "front": (1, 0, 0),
    "back": (-1, 0, 0),
    "left": (0, 1, 0),
    "right": (0, -1, 0),
    "up": (0, 0, 1),
    "down": (0, 0, -1),
}
"""Directions in the axes of a frame: x front, y left, z up, as in REP-103."""
MAX_ANGLES = 3


@dataclass(frozen=True)
class Joint:
    """A joint of a kinematic tree: a frame that turns about a point of its parent.

    At rest, with all angles 0, the axes of all frames are parallel: x front, y left, z up.

    Attributes:
        name: of the joint and of its frame.
        at: keypoints whose mean is the origin of the frame.
        parent: name of the parent; "" for the root, which is the first joint.
        directions: (direction, pair) each: the direction of the frame that points from the first
            name of the pair to the second. A direction is a word of `WORDS`, or several, which are
            added: "front up" is halfway. A name is that of a keypoint, or of a joint: its origin.
            The frame follows the first direction exactly, and the second as far as it
            can. Further ones and the parent's frame count only where the second is nearly parallel
            to the first, as in a straight arm.
        angles: (name, axis) of up to three rotations from the parent's frame, in order; an axis is
            one word. None: the frame is fixed to the parent's.
        max_twist: largest twist in degrees, relative to the parent's frame, that the second
            direction may give; beyond it that direction is taken to point the other way, as where a
            knee was lifted as if it bent forward.
    """

    name: str
    at: tuple[str, ...]
    parent: str = ""
    directions: tuple[tuple[str, Pair], ...] = ()
    angles: tuple[tuple[str, str], ...] = ()
    max_twist: float = 180.0


def direction_vector(direction: str) -> tuple[float, float, float]:
    """Return the unit vector of a direction; raise ValueError for other words."""
    words = direction.split()
    unknown = [word for word in words if word not in WORDS]
    if unknown or not words:
        raise ValueError(f"direction {direction!r} is not made of {', '.join(WORDS)}")
    x, y, z = (sum(axis) for axis in zip(*(WORDS[word] for word in words), strict=True))
    length = math.sqrt(x * x + y * y + z * z)
    if not length:
        raise ValueError(f"direction {direction!r} cancels itself")
    return x / length, y / length, z / length


def check_joints(joints: Sequence[Joint], keypoints: Sequence[str]) -> None:
    """Raise ValueError unless the joints are a tree over the keypoints, parents first."""
    names: list[str] = []
    angles: list[str] = []
    for joint in joints:
        where = f"joint {joint.name!r}"
        if joint.name in names:
            raise ValueError(f"{where} occurs twice")
        if bool(joint.parent) != bool(names):
            raise ValueError(f"{where}: the first joint is the root, and only it has no parent")
        if joint.parent and joint.parent not in names:
            raise ValueError(f"{where}: its parent {joint.parent!r} is not a joint before it")
        if missing := [name for name in joint.at if name not in keypoints]:
            hint = did_you_mean(missing[0], keypoints)
            raise ValueError(f"{where}: there is no keypoint {missing[0]!r}{hint and '; ' + hint}")
        if not joint.at:
            raise ValueError(f"{where} is at no keypoint")
        names.append(joint.name)
        angles += [name for name, _ in joint.angles]
        if len(set(angles)) < len(angles):
            raise ValueError(f"{where}: an angle of it has the name of another angle")
        inner = [name for name, _ in joint.angles[:-1]]
        if clash := {*inner} & {each.name for each in joints}:
            raise ValueError(
                f"{where}: its angle {min(clash)!r} has the name of a joint, which only the last "
                "angle of that joint may have"
            )
        _check_angles(joint, where)
    every = {*keypoints, *names}
    for joint in joints:
        for direction, pair in joint.directions:
            direction_vector(direction)
            for name in pair:
                if name not in every:
                    raise ValueError(
                        f"joint {joint.name!r}: {direction} has {name!r}, which is neither a "
                        "keypoint nor a joint"
                    )
    if joints and len(joints[0].directions) < 2:
        raise ValueError(f"joint {joints[0].name!r} is the root: its frame needs two directions")


def _check_angles(joint: Joint, where: str) -> None:
    """Raise ValueError for angles that the directions of a joint do not give."""
    if len(joint.angles) > MAX_ANGLES:
        raise ValueError(f"{where} has {len(joint.angles)} angles; at most {MAX_ANGLES} are needed")
    if joint.angles and not joint.parent:
        raise ValueError(f"{where} is the root: it turns freely, without angles")
    axes = []
    for name, word in joint.angles:
        if word not in WORDS:
            raise ValueError(f"{where}: axis {word!r} of {name} is not one of {', '.join(WORDS)}")
        axes.append([abs(x) for x in WORDS[word]])
    if any(a == b for a, b in zip(axes, axes[1:], strict=False)):
        raise ValueError(f"{where}: two angles in a row have the same axis")
    if not joint.angles:
        return
    if not joint.directions:
        raise ValueError(f"{where} has angles and no direction that would give them")
    first = direction_vector(joint.directions[0][0])
    if len(joint.angles) < MAX_ANGLES:
        axis = WORDS[joint.angles[-1][1]]
        if abs(sum(a * b for a, b in zip(axis, first, strict=True))) > 1e-9:
            raise ValueError(
                f"{where}: {joint.directions[0][0]} does not move by {joint.angles[-1][0]}, the "
                f"rotation about {joint.angles[-1][1]}"
            )


def fitting_joints(joints: Sequence[Joint], keypoints: Sequence[str]) -> tuple[Joint, ...]:
    """Return the joints of a shared tree that a layout has the keypoints of.

    A joint whose place is missing is left out, and so are its descendants; a direction with a
    missing end is left out. A joint without a direction becomes fixed to its parent.

    Args:
        joints: of the tree, parents first.
        keypoints: of the layout.
    """
    fitting: list[Joint] = []
    names: set[str] = set()
    for joint in joints:
        if not set(joint.at) <= set(keypoints) or (joint.parent and joint.parent not in names):
            continue
        names.add(joint.name)
        fitting.append(joint)
    every = {*keypoints, *names}
    result = []
    for joint in fitting:
        directions = tuple(d for d in joint.directions if set(d[1]) <= every)
        angles = joint.angles if directions else ()
        result.append(
            Joint(joint.name, joint.at, joint.parent, directions, angles, joint.max_twist)
        )
    return tuple(result)


def joints_from_json(values: Any) -> tuple[Joint, ...]:
    """Return the joints of a model file; raise ValueError or TypeError if they are damaged."""
    joints = []
    for value in values:
        joint = Joint(**value)
        texts = [joint.name, joint.parent, *joint.at]
        texts += [text for each in joint.directions for text in (each[0], *each[1])]
        texts += [text for each in joint.angles for text in each]
        if any(type(text) is not str for text in texts):
            raise ValueError("layout has joints with names that are no texts")
        if any(len(pair) != 2 for _, pair in joint.directions) or not math.isfinite(
            joint.max_twist
        ):
            raise ValueError(f"joint {joint.name[:60]!r} is damaged")
        joints.append(joint)
    return tuple(joints)
