# SPDX-License-Identifier: Apache-2.0
"""As much of MediaPipe as the detector uses: a person whose first landmark tells the colour seen.

Nobody is in a black image.
"""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np

FIRST = np.random.default_rng(0).uniform(0.2, 0.8, (33, 3))


class Pose:
    def __init__(self, smooth_landmarks: bool) -> None:
        assert isinstance(smooth_landmarks, bool)

    def process(self, image: np.ndarray) -> Any:
        assert image.dtype == np.uint8 and image.shape[2] == 3 and image.flags.c_contiguous
        if not image.any():
            return SimpleNamespace(pose_landmarks=None, pose_world_landmarks=None)
        points = FIRST.copy()
        points[0] = image[0, 0] / 255
        marks = [SimpleNamespace(x=x, y=y, z=z, visibility=0.9) for x, y, z in points.tolist()]
        found = SimpleNamespace(landmark=marks)
        return SimpleNamespace(pose_landmarks=found, pose_world_landmarks=found)


def hand(place: float) -> Any:
    """Return 21 landmarks about a place; hands have no visibility."""
    across = (place + 0.01 * i for i in range(21))
    return SimpleNamespace(
        landmark=[SimpleNamespace(x=x, y=0.5, z=0.0, visibility=0.0) for x in across]
    )


class Hands:
    """A hand on the left of the image that is called Left, and one on the right called Right."""

    def __init__(self, max_num_hands: int) -> None:
        assert max_num_hands >= 2

    def process(self, image: np.ndarray) -> Any:
        if not image.any():
            return SimpleNamespace(multi_handedness=None, multi_hand_landmarks=None)
        labels = (("Left", 0.9), ("Right", 0.8))
        sides = [
            SimpleNamespace(classification=[SimpleNamespace(label=label, score=score)])
            for label, score in labels
        ]
        return SimpleNamespace(multi_handedness=sides, multi_hand_landmarks=[hand(0.1), hand(0.6)])


class Holistic(Pose):
    """The person of `Pose` with a left hand; the right one is not seen."""

    def process(self, image: np.ndarray) -> Any:
        found = super().process(image)
        found.left_hand_landmarks = hand(0.6) if image.any() else None
        found.right_hand_landmarks = None
        return found


solutions = SimpleNamespace(
    pose=SimpleNamespace(Pose=Pose),
    hands=SimpleNamespace(Hands=Hands),
    holistic=SimpleNamespace(Holistic=Holistic),
)
