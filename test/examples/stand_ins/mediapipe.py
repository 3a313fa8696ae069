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


solutions = SimpleNamespace(pose=SimpleNamespace(Pose=Pose))
