# SPDX-License-Identifier: Apache-2.0
"""Virtual people: motion capture with other bodies, and with joints where detectors put them.

Motion capture has few people, and all of them have the joints of one skeleton. Detectors put hips
further apart than it has them, shoulders closer and the nose further forward, each in its own way.
A virtual person has the pose of one frame, a body of other proportions, and a definition of the
joints that is drawn at random between those of motion capture and of detectors. The lifter's error
covariance and bones are learned from such people, so that they know how far a detector's joints may
be from those of the training.

The ranges were chosen with the proportions of OpenPose's and HumanEva's people in mind; each of
them is worth at most 1 mm (docs/devlog/accuracy.md). Source: ours, not in the paper.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deep_nrsfm_ros.data.dataset import Dataset
from deep_nrsfm_ros.data.mocap import (
    FaceShape,
    Motion,
    TrialSelection,
    face,
    foot,
    read_amc,
    read_asf,
    selected_trials,
)
from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.layouts.presets import CMU31, HUMAN17, HUMAN25
from deep_nrsfm_ros.nrsfm.geometry import centre, random_cameras

Floats = NDArray[Any]

BODY_SPREAD, BODY_LIMIT = 0.1, 2.5  # of a bone's length relative to CMU's; limit in spreads
NOSE_UP = (0.35, 1.05)  # from the base of the head to its top
NOSE_FORWARD = (0.08, 0.13)  # m
HIPS_APART, SHOULDERS_APART = (0.9, 1.4), (0.8, 1.02)  # times the distance of CMU's joints
HIP_SPREAD, TOE_SPREAD = 0.02, 0.015  # m, per axis
JOINT_SPREAD = 0.03  # of the bone that ends at a joint, along it
FACE = ((0.02, 0.05), (0.01, 0.04), (0.028, 0.038), (0.0, 0.04), (0.08, 0.13), (0.06, 0.085))
"""Ranges in metres of the numbers of `FaceShape`, in their order."""
FACE_KEYPOINTS = ("nose", "left_eye", "right_eye", "left_ear", "right_ear")
"""Keypoints that some detectors lack altogether; the network then sees less of the head's pose."""
FEET_KEYPOINTS = tuple(
    f"{side}_{part}" for part in ("big_toe", "small_toe", "heel") for side in ("left", "right")
)
"""Keypoints of the feet below the ankles, which detectors with the keypoints of COCO lack."""
_PARTS = (
    ("root", ("hipjoint",)),
    ("hipjoint", ("femur",)),
    ("femur", ("tibia",)),
    ("tibia", ("foot", "toes")),
    ("thorax", ("clavicle",)),
    ("clavicle", ("humerus",)),
    ("humerus", ("radius", "wrist")),
)
"""Parts of a side: where it begins, and the bones of CMU in it."""
_TRUNK = ("root", "lowerback", "upperback", "thorax")
_NECK = ("thorax", "lowerneck", "upperneck")
_SIDES = ("left", "right")


def read_virtual_people(
    selection: TrialSelection,
    count: int,
    layout: KeypointLayout = HUMAN17,
    on_progress: Callable[[int, int], None] = lambda done, total: None,
) -> Dataset:
    """Return virtual people as a dataset, each before an orthonormal camera of its own.

    Args:
        selection: the motion capture; `camera_seed` seeds all random numbers.
        count: of people; each has the pose of another frame, so there are at most as many as there
            are frames.
        layout: HUMAN17 or HUMAN25.
        on_progress: called with the number of trials done and their total number.

    Raises:
        ValueError: the layout is another.
    """
    if not set(layout.keypoints) <= set(HUMAN25.keypoints):
        raise ValueError(f"virtual people have the keypoints of human25, not of {layout.name}")
    motions, paths = [], selected_trials(selection)
    for done, path in enumerate(paths):
        motion = read_amc(path, read_asf(path.parent / f"{path.parent.name}.asf"))
        motions.append([part[:: selection.stride] for part in _parts(motion)])
        on_progress(done + 1, len(paths))
    parts = [np.concatenate(part) for part in zip(*motions, strict=True)]
    rng = np.random.default_rng(selection.camera_seed)
    chosen = rng.permutation(len(parts[0]))[:count]
    S = centre(virtual_people(Motion(*(part[chosen] for part in parts)), layout, rng))
    W = (S @ random_cameras(len(S), rng)).astype(np.float32)
    source = f"virtual people in poses of CMU, subjects {' '.join(selection.subjects)}"
    return Dataset(W, np.ones(W.shape[:2], bool), layout, source, S)


def _parts(motion: Motion) -> tuple[NDArray[np.float32], ...]:
    """Return the arrays of a motion, each of f frames."""
    return motion.joints, motion.head, motion.feet


def virtual_people(
    motion: Motion, layout: KeypointLayout, rng: np.random.Generator
) -> NDArray[np.float32]:
    """Return people in the poses of a motion, one a frame, with other bodies and joints.

    Args:
        motion: f frames of motion capture.
        layout: HUMAN17 or HUMAN25.
        rng: draws the bodies and the definitions of the joints.

    Returns:
        (f, p, 3) keypoints of the layout in metres.
    """
    joints = motion.joints.astype(np.float64)
    n = len(joints)
    at = CMU31.index

    def body() -> Floats:
        """Return the length (f, 1) of a part relative to that of the motion's skeleton."""
        growth = np.clip(rng.standard_normal((n, 1)), -BODY_LIMIT, BODY_LIMIT)
        return np.asarray(1 + BODY_SPREAD * growth)

    def along(spread: float = JOINT_SPREAD) -> Floats:
        """Return how far (f, 1) a joint lies beyond the end of its bone, in lengths of it."""
        return np.asarray(spread * rng.standard_normal((n, 1)))

    def uniform(limits: tuple[float, float]) -> Floats:
        return np.asarray(rng.uniform(*limits, (n, 1)))

    place: dict[str, Floats] = {"root": joints[:, at("root")]}
    for chain in (_TRUNK, _NECK):
        _grow(place, joints, chain, body())
    _grow(place, joints, ("upperneck", "head"), body())
    for first, bones in _PARTS:
        growth = body()
        for side in "lr":
            begin = first if first in ("root", "thorax") else side + first
            _grow(place, joints, (begin, *(side + bone for bone in bones)), growth)

    shift = {name: along() for name in ("elbow", "wrist", "knee", "ankle")}
    left, up, front = _pelvis(place)
    spread_hips, spread_shoulders = uniform(HIPS_APART), uniform(SHOULDERS_APART)
    hips = HIP_SPREAD * rng.standard_normal((2, n, 1))
    toes = TOE_SPREAD * rng.standard_normal((3, n, 1))
    points: dict[str, Floats] = {}
    for side, sign in zip(_SIDES, (1, -1), strict=True):
        s = side[0]
        for part, bone, from_ in (
            ("elbow", "humerus", "clavicle"),
            ("wrist", "wrist", "humerus"),
            ("knee", "femur", "hipjoint"),
            ("ankle", "tibia", "femur"),
        ):
            end = place[s + bone]
            points[f"{side}_{part}"] = end + shift[part] * (end - place[s + from_])
        for part, bone, apart in (
            ("hip", "hipjoint", spread_hips),
            ("shoulder", "clavicle", spread_shoulders),
        ):
            middle = (place["l" + bone] + place["r" + bone]) / 2
            points[f"{side}_{part}"] = middle + apart * (place[s + bone] - middle)
        points[f"{side}_hip"] = points[f"{side}_hip"] + hips[0] * up + hips[1] * front
        toe = place[s + "toes"]
        points[f"{side}_big_toe"] = toe + toes[0] * front + toes[1] * up + sign * toes[2] * left
    points["neck"] = (points["left_shoulder"] + points["right_shoulder"]) / 2
    points["mid_hip"] = (points["left_hip"] + points["right_hip"]) / 2
    base, top = place["upperneck"], place["head"]
    nose = base + uniform(NOSE_UP) * (top - base)
    points["nose"] = nose + uniform(NOSE_FORWARD) * motion.head[:, :, 2]
    # Drawn last, so that the other keypoints are the same in both layouts.
    points |= face(points["nose"], motion.head, FaceShape(*map(uniform, FACE)))
    ends = TOE_SPREAD * rng.standard_normal((2, 3, n, 1))
    for i, (side, sign) in enumerate(zip(_SIDES, (1, -1), strict=True)):
        axes = motion.feet[:, i].astype(np.float64)
        found = foot(side, points[f"{side}_ankle"], place[side[0] + "foot"], axes)
        for (name, end), (right, rise, ahead) in zip(found.items(), ends, strict=True):
            shifted = sign * right * axes[:, :, 0] + rise * axes[:, :, 1] + ahead * axes[:, :, 2]
            points[name] = end + shifted
    return np.stack([points[name] for name in layout.keypoints], 1).astype(np.float32)


def _grow(place: dict[str, Floats], joints: Floats, chain: Sequence[str], growth: Floats) -> None:
    """Add the joints of a chain to `place`, its first joint excepted, bones times `growth`."""
    for begin, end in zip(chain, chain[1:], strict=False):
        bone = joints[:, CMU31.index(end)] - joints[:, CMU31.index(begin)]
        place[end] = place[begin] + growth * bone


def _pelvis(place: dict[str, Floats]) -> tuple[Floats, Floats, Floats]:
    """Return the unit vectors (f, 3) to the pelvis' left, up and front."""
    left = place["lhipjoint"] - place["rhipjoint"]
    left /= np.linalg.norm(left, axis=1, keepdims=True)
    # Hip joints of CMU lie below the root, in the plane of the pelvis.
    up = place["root"] - (place["lhipjoint"] + place["rhipjoint"]) / 2
    up -= (up * left).sum(1, keepdims=True) * left
    up /= np.linalg.norm(up, axis=1, keepdims=True)
    return left, up, np.cross(left, up)
