"""Keypoint layouts: names in order, edges for drawing, and what fixes the right way round.

A layout is the contract between a detector, a model and a viewer. `LAYOUTS` holds the presets,
`object_file` reads those of anything else; `KeypointMap` takes points from a detector's layout to
a model's by name.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

Edge = tuple[str, str]
Tetrahedron = tuple[str, str, str, str]
MOST_KEYPOINTS = 1000
"""Of one object: what lifting takes grows with their square."""


@dataclass(frozen=True)
class KeypointLayout:
    """Names of p keypoints in the order in which they come.

    edges: pairs of names, for drawing, and bones: how well each keeps its length is learned.
    handedness: one or more (left, right, up, front), four keypoints of which the tetrahedron has
        positive volume on the real object: seen from behind, `left` is left of `right`, `up` is
        above them and `front` before them. Each is a vote on whether depth is mirrored; the
        first also gives the object's axes. Empty: depth may come out mirrored.
    reference: the pair of keypoints whose distance is the reference length. None: the RMS
        radius of the shape takes its place.
    derived: keypoints that a source without them can give as the mean of others.
    reference_length: length of the reference pair on the real object, in metres, for the output
        to be in metres. None: it is not known.
    rigid: pairs that keep their distance as bones do, without an edge to be drawn.
    """

    name: str
    keypoints: tuple[str, ...]
    edges: tuple[Edge, ...] = ()
    handedness: tuple[Tetrahedron, ...] = ()
    reference: Edge | None = None
    derived: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    reference_length: float | None = None
    rigid: tuple[Edge, ...] = ()

    def __post_init__(self) -> None:
        """Refuse a layout that repeats a keypoint or names one that it does not have."""
        if len(self.keypoints) > MOST_KEYPOINTS:
            raise ValueError(
                f"layout {self.name!r} has {len(self.keypoints)} keypoints; at most "
                f"{MOST_KEYPOINTS} are possible"
            )
        seen = set(self.keypoints)
        if len(seen) != len(self.keypoints):
            twice = sorted({k for k in self.keypoints if self.keypoints.count(k) > 1})
            raise ValueError(f"layout {self.name!r} names {', '.join(twice)} more than once")
        groups: list[tuple[str, int, tuple[str, ...]]]
        groups = [("edge", 2, edge) for edge in self.edges]
        groups += [("rigid pair", 2, pair) for pair in self.rigid]
        groups += [("handedness", 4, four) for four in self.handedness]
        groups += [("reference", 2, self.reference)] if self.reference else []
        for what, size, group in groups:
            if isinstance(group, str) or len(group) != size:
                raise ValueError(f"layout {self.name!r}: {what} {group!r} must be {size} names")
            if len(set(group)) != size:
                raise ValueError(f"layout {self.name!r}: {what} {group!r} repeats a name")
        named = [name for _, _, group in groups for name in group]
        for keypoint in [*named, *self.derived]:
            if keypoint not in seen:
                raise ValueError(f"layout {self.name!r} has no keypoint {keypoint!r}")
        for keypoint, parts in self.derived.items():
            if isinstance(parts, str) or not parts:
                raise ValueError(
                    f"layout {self.name!r}: derived {keypoint!r} is a mean of no names"
                )
        if self.reference_length is not None:
            self._check_reference_length(self.reference_length)

    def _check_reference_length(self, length: float) -> None:
        """Raise ValueError unless the length is one, and of something."""
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
        """Return the place of `keypoint`; raise KeyError naming the layout if it has none."""
        try:
            return self.keypoints.index(keypoint)
        except ValueError:
            raise KeyError(f"layout {self.name!r} has no keypoint {keypoint!r}") from None

    @property
    def warning(self) -> str:
        """Return what somebody who trains on this layout should know, or ""."""
        if self.handedness:
            return ""
        return (
            f"layout {self.name!r} names no handedness: depth may come out mirrored as a whole; "
            "an object file can name it"
        )

    def edge_indices(self) -> list[tuple[int, int]]:
        """Return the edges as pairs of places."""
        return [(self.index(a), self.index(b)) for a, b in self.edges]

    def bone_indices(self) -> list[tuple[int, int]]:
        """Return the edges and the rigid pairs as pairs of places."""
        return [(self.index(a), self.index(b)) for a, b in (*self.edges, *self.rigid)]

    def partners(self) -> list[int] | None:
        """Return the place of each keypoint in the mirror image, left_ and right_ exchanged.

        None if nothing is, or if the layout does not say where left is.
        """
        exchanged = {"left": "right", "right": "left"}
        places = []
        for i, name in enumerate(self.keypoints):
            side, _, part = name.partition("_")
            other = f"{exchanged.get(side, '')}_{part}"
            places.append(self.index(other) if other in self.keypoints else i)
        changed = places != list(range(len(self)))
        return places if self.handedness and changed else None

    @classmethod
    def numbered(cls, p: int) -> KeypointLayout:
        """Return a layout of p nameless points, for an object nobody has described."""
        return cls(name=f"points{p}", keypoints=tuple(f"point_{i}" for i in range(p)))


class KeypointMap:
    """Points of a source layout in the order of a target layout, matched by name."""

    def __init__(self, source: KeypointLayout, target: KeypointLayout) -> None:
        """Match names; a target keypoint that the source cannot give stays missing.

        Raises ValueError when fewer than 4 keypoints match: no shape can be lifted from them.
        """
        self.source, self.target = source, target
        self.identical = source.keypoints == target.keypoints
        have = {name: i for i, name in enumerate(source.keypoints)}
        direct = [(t, have[name]) for t, name in enumerate(target.keypoints) if name in have]
        self._to = np.array([t for t, _ in direct], int)
        self._from = np.array([s for _, s in direct], int)
        self._derived = [
            (t, [have[part] for part in target.derived[name]])
            for t, name in enumerate(target.keypoints)
            if name not in have
            and name in target.derived
            and all(part in have for part in target.derived[name])
        ]
        if len(direct) + len(self._derived) < 4:
            raise ValueError(
                f"layouts {source.name!r} and {target.name!r} share "
                f"{len(direct) + len(self._derived)} keypoints; at least 4 are needed"
            )

    def __call__(
        self, points: NDArray[np.float32], confidence: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Map points (n, q, 2) and confidence (n, q) to (n, p, 2) and (n, p).

        Confidence 0 marks a missing point, in and out. A derived point is as certain as the
        least certain of its parts.
        """
        if self.identical:
            return points, confidence
        shape = (len(points), len(self.target))
        mapped, sure = np.zeros((*shape, 2), np.float32), np.zeros(shape, np.float32)
        mapped[:, self._to] = points[:, self._from]
        sure[:, self._to] = confidence[:, self._from]
        for t, parts in self._derived:
            mapped[:, t] = points[:, parts].mean(1)
            sure[:, t] = confidence[:, parts].min(1)
        mapped[sure == 0] = 0
        return mapped, sure


def layout(name: str) -> KeypointLayout:
    """Return the preset called `name`; raise ValueError that lists the presets."""
    if name not in LAYOUTS:
        raise ValueError(f"no keypoint layout {name!r}; presets: {', '.join(LAYOUTS)}")
    return LAYOUTS[name]


def _both(*pairs: Edge) -> tuple[Edge, ...]:
    """Return the edges with each side's prefix: ("hip", "knee") -> left and right."""
    return tuple((f"{s}_{a}", f"{s}_{b}") for s in ("left", "right") for a, b in pairs)


def _sides(*parts: str) -> tuple[str, ...]:
    """Return ("left_x", "right_x", ...) for each part."""
    return tuple(f"{side}_{part}" for part in parts for side in ("left", "right"))


def _leg_votes(hips: Edge, ankle: str, *fronts: str) -> tuple[Tetrahedron, ...]:
    """Return votes on a person's handedness: `fronts` are before the plane of hips and ankle.

    Seen from behind, and upside down: the ankle is up, and the right hip on the left.
    """
    left, right = hips
    return tuple((right, left, ankle, front) for front in fronts)


_LIMBS = _both(("shoulder", "elbow"), ("elbow", "wrist"), ("hip", "knee"), ("knee", "ankle"))
_TRUNK: tuple[Edge, ...] = (("left_shoulder", "right_shoulder"), ("left_hip", "right_hip"))
_FLANKS = _both(("shoulder", "hip"))
_COCO_BODY = _sides("shoulder", "elbow", "wrist", "hip", "knee", "ankle")

HUMAN17 = KeypointLayout(
    "human17",
    (*_COCO_BODY, "neck", "mid_hip", "nose", "left_big_toe", "right_big_toe"),
    edges=(
        *_LIMBS,
        *_both(("ankle", "big_toe")),
        *(("neck", f"{side}_shoulder") for side in ("left", "right")),
        *(("mid_hip", f"{side}_hip") for side in ("left", "right")),
        ("neck", "mid_hip"),
        ("neck", "nose"),
    ),
    handedness=(
        ("left_hip", "right_hip", "neck", "nose"),
        *_leg_votes(("left_hip", "right_hip"), "left_ankle", "left_knee", "left_big_toe"),
        *_leg_votes(("left_hip", "right_hip"), "right_ankle", "right_knee", "right_big_toe"),
    ),
    reference=("neck", "mid_hip"),
    derived={
        "neck": ("left_shoulder", "right_shoulder"),
        "mid_hip": ("left_hip", "right_hip"),
    },
    rigid=(*_TRUNK, *_FLANKS, ("left_shoulder", "right_hip"), ("right_shoulder", "left_hip")),
)

_CMU_PARENT = (
    # (bone, parent) in ASF order; a keypoint is the end of its bone, `root` the pelvis.
    "lhipjoint:root lfemur:lhipjoint ltibia:lfemur lfoot:ltibia ltoes:lfoot "
    "rhipjoint:root rfemur:rhipjoint rtibia:rfemur rfoot:rtibia rtoes:rfoot "
    "lowerback:root upperback:lowerback thorax:upperback lowerneck:thorax "
    "upperneck:lowerneck head:upperneck lclavicle:thorax lhumerus:lclavicle "
    "lradius:lhumerus lwrist:lradius lhand:lwrist lfingers:lhand lthumb:lwrist "
    "rclavicle:thorax rhumerus:rclavicle rradius:rhumerus rwrist:rradius rhand:rwrist "
    "rfingers:rhand rthumb:rwrist"
)
_CMU_EDGES = tuple((bone, parent) for bone, parent in (b.split(":") for b in _CMU_PARENT.split()))

CMU31 = KeypointLayout(
    "cmu31",
    ("root", *(bone for bone, _ in _CMU_EDGES)),
    edges=_CMU_EDGES,
    handedness=(  # a bone's name is that of its end: ltibia is the left ankle, lfemur the knee
        ("ltibia", "rtibia", "lfemur", "ltoes"),
        *_leg_votes(("lhipjoint", "rhipjoint"), "ltibia", "lfemur", "ltoes"),
        *_leg_votes(("lhipjoint", "rhipjoint"), "rtibia", "rfemur", "rtoes"),
    ),
    reference=("root", "thorax"),
)

COCO17 = KeypointLayout(
    "coco17",
    ("nose", *_sides("eye", "ear"), *_COCO_BODY),
    edges=(*_LIMBS, *_TRUNK, *_FLANKS, *_both(("eye", "ear"))),
)

_OPENPOSE_ARMS = (
    *("nose", "neck", "right_shoulder", "right_elbow", "right_wrist"),
    *("left_shoulder", "left_elbow", "left_wrist"),
)
_OPENPOSE_LEGS = (
    *("right_hip", "right_knee", "right_ankle"),
    *("left_hip", "left_knee", "left_ankle"),
)
_OPENPOSE_FACE = ("right_eye", "left_eye", "right_ear", "left_ear")
_OPENPOSE_EDGES = (
    *_LIMBS,
    *(("neck", f"{side}_shoulder") for side in ("left", "right")),
    ("neck", "nose"),
    *_both(("eye", "ear")),
)
_FEET = ("big_toe", "small_toe", "heel")
_FEET_EDGES = _both(*(("ankle", part) for part in _FEET))

OPENPOSE18 = KeypointLayout(
    "openpose18",
    (*_OPENPOSE_ARMS, *_OPENPOSE_LEGS, *_OPENPOSE_FACE),
    edges=(*_OPENPOSE_EDGES, *(("neck", f"{side}_hip") for side in ("left", "right"))),
)
REP155 = KeypointLayout(
    "rep155",
    (
        *_OPENPOSE_ARMS,
        *_OPENPOSE_LEGS,
        *_sides("eye", "ear"),
    ),  # as hri_msgs/Skeleton2D numbers them
    edges=OPENPOSE18.edges,
)
BODY25 = KeypointLayout(
    "body25",
    (
        *(*_OPENPOSE_ARMS, "mid_hip", *_OPENPOSE_LEGS, *_OPENPOSE_FACE),
        *(f"{side}_{part}" for side in ("left", "right") for part in _FEET),
    ),
    edges=(
        *(*_OPENPOSE_EDGES, ("neck", "mid_hip"), *_FEET_EDGES),
        *(("mid_hip", f"{side}_hip") for side in ("left", "right")),
    ),
)
BODY25B = KeypointLayout(
    "body25b",
    (
        *("nose", *_sides("eye", "ear"), *_COCO_BODY, "upper_neck", "head_top"),
        *(f"{side}_{part}" for side in ("left", "right") for part in _FEET),
    ),
    edges=(*_LIMBS, *_TRUNK, *_FLANKS, *_FEET_EDGES, ("upper_neck", "head_top")),
)
MEDIAPIPE33 = KeypointLayout(
    "mediapipe33",
    (
        *("nose", "left_eye_inner", "left_eye", "left_eye_outer"),
        *("right_eye_inner", "right_eye", "right_eye_outer", *_sides("ear", "mouth")),
        *(*_sides("shoulder", "elbow", "wrist", "pinky", "index", "thumb"),),
        *(*_sides("hip", "knee", "ankle", "heel", "big_toe"),),
    ),
    edges=(*_LIMBS, *_TRUNK, *_FLANKS, *_both(("ankle", "heel"), ("heel", "big_toe"))),
)

LAYOUTS: dict[str, KeypointLayout] = {
    preset.name: preset
    for preset in (HUMAN17, CMU31, COCO17, BODY25, BODY25B, OPENPOSE18, REP155, MEDIAPIPE33)
}
