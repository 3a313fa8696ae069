# SPDX-License-Identifier: Apache-2.0
"""The keypoint layout: keypoints in order, edges, handedness and reference length."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from deep_nrsfm_ros.layouts.joints import Joint, check_joints
from deep_nrsfm_ros.similar_names import did_you_mean

Edge = tuple[str, str]
Tetrahedron = tuple[str, str, str, str]
TRUNK = ("neck", "mid_hip")
"""Reference pair of people."""
SIDE_WORDS = {"left": "left", "l": "left", "right": "right", "r": "right"}
"""Words in the names of keypoints -> their side."""
_FIELDS = {
    "edge": "edges",
    "rigid pair": "rigid",
    "handedness": "handedness",
    "reference": "reference",
}
MAX_KEYPOINTS = 1000
"""Most keypoints of a layout: time and memory of lifting grow with the square of the number."""


@dataclass(frozen=True)
class KeypointLayout:
    """The contract between a detector, a model and a viewer: names of p keypoints in order.

    Attributes:
        name: name of the layout.
        keypoints: p different names, in the order of the arrays.
        edges: pairs of keypoints that are drawn as lines. They are bones too: training measures
            how well each keeps its length.
        handedness: fours (left, right, up, front) of keypoints. Seen from behind, `left` is left
            of `right`, `up` is above them and `front` is in front of them, so their tetrahedron
            has a positive volume. Each four is a vote on whether depth is mirrored; the first
            also gives the object's axes. Empty: depth may come out mirrored.
        reference: the pair of keypoints whose distance is the reference length. None: the RMS
            radius of the shape is the reference length.
        derived: keypoint -> keypoints whose mean it is, for sources that lack the keypoint.
        reference_length: distance of the reference pair on the real object, in metres. The output
            is in metres then. None: unknown.
        rigid: pairs that keep their distance as bones do, and are not drawn.
        top: keypoints whose mean is the upper end of the object when it is upright. (): unknown.
        bottom: keypoints whose mean is its lower end.
        joints: kinematic tree, parents first: frames of joints, angles, URDF. (): none.
    """

    name: str
    keypoints: tuple[str, ...]
    edges: tuple[Edge, ...] = ()
    handedness: tuple[Tetrahedron, ...] = ()
    reference: Edge | None = None
    derived: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    reference_length: float | None = None
    rigid: tuple[Edge, ...] = ()
    top: tuple[str, ...] = ()
    bottom: tuple[str, ...] = ()
    joints: tuple[Joint, ...] = ()

    def __post_init__(self) -> None:
        """Raise ValueError for a layout that repeats a keypoint or names one that it lacks."""
        if len(self.keypoints) > MAX_KEYPOINTS:
            raise ValueError(
                f"layout {self.name!r} has {len(self.keypoints)} keypoints; at most "
                f"{MAX_KEYPOINTS} are possible"
            )
        own = set(self.keypoints)
        if len(own) != len(self.keypoints):
            repeated = sorted({k for k in self.keypoints if self.keypoints.count(k) > 1})
            raise ValueError(f"layout {self.name!r} names {', '.join(repeated)} more than once")
        groups: list[tuple[str, int, tuple[str, ...]]]
        groups = [("edge", 2, edge) for edge in self.edges]
        groups += [("rigid pair", 2, pair) for pair in self.rigid]
        groups += [("handedness", 4, four) for four in self.handedness]
        groups += [("reference", 2, self.reference)] if self.reference else []
        for kind, size, group in groups:
            if isinstance(group, str) or len(group) != size:
                raise ValueError(f"layout {self.name!r}: {kind} {group!r} must be {size} names")
            if len(set(group)) != size:
                raise ValueError(f"layout {self.name!r}: {kind} {group!r} repeats a name")
        named = [(_FIELDS[kind], group) for kind, _, group in groups]
        named += [("derived", tuple(self.derived)), ("top", self.top), ("bottom", self.bottom)]
        for field_name, keypoints in named:
            for keypoint in keypoints:
                if keypoint not in own:
                    hint = did_you_mean(keypoint, self.keypoints)
                    raise ValueError(
                        f"layout {self.name!r} has no keypoint {keypoint!r}, which {field_name} "
                        f"names{hint and '; ' + hint}"
                    )
        for keypoint, parts in self.derived.items():
            if isinstance(parts, str) or not parts:
                raise ValueError(
                    f"layout {self.name!r}: derived {keypoint!r} is a mean of no names"
                )
        if bool(self.top) != bool(self.bottom) or set(self.top) & set(self.bottom):
            raise ValueError(
                f"layout {self.name!r}: top is {', '.join(self.top) or 'nothing'} and bottom is "
                f"{', '.join(self.bottom) or 'nothing'}; name different keypoints for both"
            )
        try:
            check_joints(self.joints, self.keypoints)
        except ValueError as error:
            raise ValueError(f"layout {self.name!r}: {error}") from None
        if self.reference_length is not None:
            self._check_reference_length(self.reference_length)

    def _check_reference_length(self, length: float) -> None:
        """Raise ValueError unless the length is positive, finite and of a reference pair."""
        if not 0 < length < math.inf:
            raise ValueError(f"layout {self.name!r}: reference_length is {length}, not above 0 m")
        if not self.reference:
            raise ValueError(
                f"layout {self.name!r}: reference_length is of no pair; name reference"
            )

    def __len__(self) -> int:
        """Return p, the number of keypoints."""
        return len(self.keypoints)

    def index(self, keypoint: str) -> int:
        """Return the index of `keypoint`; raise KeyError if the layout lacks it."""
        try:
            return self.keypoints.index(keypoint)
        except ValueError:
            raise KeyError(f"layout {self.name!r} has no keypoint {keypoint!r}") from None

    @property
    def warning(self) -> str:
        """A warning for whoever trains on this layout; "" if there is none."""
        for left, right, *_ in self.handedness[:1]:  # another four may be upside down, as a knee's
            if side_in_name(left) == "right" and side_in_name(right) == "left":
                return (
                    f"layout {self.name!r}: its handedness has left: {left} and right: {right}, "
                    "against their names. Left and right are the object's own, as seen from "
                    "behind: exchange the two, or all comes out mirrored. It is right only where "
                    "the keypoints are named as a camera in front sees them"
                )
        if self.handedness:
            return ""
        return (
            f"layout {self.name!r} names no handedness: depth may come out mirrored as a whole; "
            "a layout file can name it, or lifting with `mirrored` undo it"
        )

    def edge_indices(self) -> list[tuple[int, int]]:
        """Return the edges as pairs of indices."""
        return [(self.index(a), self.index(b)) for a, b in self.edges]

    def bone_indices(self) -> list[tuple[int, int]]:
        """Return the bones, which are the edges and the rigid pairs, as pairs of indices."""
        return [(self.index(a), self.index(b)) for a, b in (*self.edges, *self.rigid)]

    def sides(self) -> list[int]:
        """Return for each keypoint that of the other side, left_ or right_; else its own index."""
        exchanged = {"left": "right", "right": "left"}
        partners = []
        for i, name in enumerate(self.keypoints):
            side, _, part = name.partition("_")
            other = f"{exchanged.get(side, '')}_{part}"
            partners.append(self.index(other) if other in self.keypoints else i)
        return partners

    def vertical_axis(self) -> NDArray[np.float64] | None:
        """Return weights (p,) of the keypoints in the vector from bottom to top; None: unknown."""
        if not self.top:
            return None
        axis = np.zeros(len(self))
        for keypoints, sign in ((self.top, 1), (self.bottom, -1)):
            axis[[self.index(keypoint) for keypoint in keypoints]] = sign / len(keypoints)
        return axis

    def partners(self) -> list[int] | None:
        """Return the permutation of the keypoints that exchanges left_ and right_.

        Returns:
            For each keypoint the index of its partner, which is its own index for a keypoint in
            the middle. None if no keypoint has a partner, or if the layout has no handedness.
        """
        partners = self.sides()
        changed = partners != list(range(len(self)))
        return partners if self.handedness and changed else None

    @classmethod
    def numbered(cls, p: int) -> KeypointLayout:
        """Return a layout of p points named point_0, point_1, ..., for an object without names."""
        return cls(name=f"points{p}", keypoints=tuple(f"point_{i}" for i in range(p)))


def side_in_name(keypoint: str) -> str:
    """Return "left" or "right" where the name of a keypoint has it as a word or letter, else ""."""
    words = re.split(r"[\W_]+|(?<=[a-z])(?=[A-Z])", keypoint)
    found = {SIDE_WORDS[word.lower()] for word in words if word.lower() in SIDE_WORDS}
    return found.pop() if len(found) == 1 else ""
