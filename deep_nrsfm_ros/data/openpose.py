# SPDX-License-Identifier: Apache-2.0
"""OpenPose JSON: people as flat lists of x, y, confidence."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deep_nrsfm_ros.lifting.observation import Observation, to_observation


def read_people(text: str | bytes, keypoints: int, min_confidence: float = 0.0) -> Observation:
    """Return all people in one frame of OpenPose JSON: `{"people": [{"pose_keypoints_2d": ...}]}`.

    Args:
        text: the JSON of the frame.
        keypoints: number q of keypoints of the body model, e.g. 25.
        min_confidence: keypoints with a confidence below it are missing.

    Raises:
        ValueError: the text is not such JSON, or has another number of keypoints.
    """
    try:
        frame: Mapping[str, Any] = json.loads(text)
        rows = [np.asarray(p["pose_keypoints_2d"], np.float64) for p in frame["people"]]
    except (KeyError, TypeError, ValueError, ArithmeticError, RecursionError) as error:
        raise ValueError(f"not a frame of OpenPose JSON: {error!r}") from None
    for row in rows:
        if row.shape != (3 * keypoints,):
            raise ValueError(f"a person has {row.size / 3:g} keypoints; expected {keypoints}")
    return to_observation(np.reshape(rows, (len(rows), keypoints, 3)), min_confidence)


def largest(people: Observation) -> int | None:
    """Return the index of the person with the largest bounding box; None if there is nobody."""
    areas = [_area(p[c > 0]) for p, c in zip(people.points, people.confidence, strict=True)]
    return int(np.argmax(areas)) if areas else None


def _area(points: NDArray[np.float32]) -> float:
    """Return the area of the bounding box of points (m, 2) in square pixels."""
    return float(np.prod(np.ptp(points, axis=0))) if len(points) else 0.0
