# SPDX-License-Identifier: Apache-2.0
"""Whether objects lie where others lie, as one object does in frames that follow each other."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

SAME_PLACE = 0.5
"""Overlap of boxes, which two people in an image hardly have."""
CROWD = 5
"""Objects, of which as many in one frame may be one object in as many frames."""
_FEW = 4  # keypoints, which make no box
_ROWS, _STEPS = 32, 256  # that are looked at


def overlap_in_turn(points: NDArray[np.floating[Any]]) -> float:
    """Return the median overlap of the boxes of objects that follow each other.

    Args:
        points: (k, l, q, 2 or more) k rows of l objects that follow each other; 0, -1 or NaN where
            a keypoint is missing.

    Returns:
        Intersection over union, from 0 to 1; 0 without two objects.
    """
    step = -(-max(len(points), 1) // _ROWS)
    points = points[::step, :_STEPS, :, :2]
    seen = np.isfinite(points).all(-1)
    for missing in (0, -1):
        seen &= (points != missing).any(-1)
    mask = seen[..., None]
    low = np.where(mask, points, np.inf).min(2, initial=np.inf)
    high = np.where(mask, points, -np.inf).max(2, initial=-np.inf)
    usable = seen.sum(2) >= _FEW
    both = usable[:, 1:] & usable[:, :-1]
    if not both.any():
        return 0.0
    low, high = np.where(usable[..., None], low, 0), np.where(usable[..., None], high, 0)
    sides = np.minimum(high[:, 1:], high[:, :-1]) - np.maximum(low[:, 1:], low[:, :-1])
    common, area = np.prod(np.clip(sides, 0, None), -1), np.prod(high - low, -1)
    union = area[:, 1:] + area[:, :-1] - common
    return float(np.median((common / np.maximum(union, 1e-9))[both]))
