# SPDX-License-Identifier: Apache-2.0
"""The weight of a keypoint, from the confidence that the detector gives it.

A top-down detector puts a hidden keypoint somewhere, with a low confidence. The weight is relative
to the other keypoints of the object, because detectors differ in what they call confident: an
object whose keypoints all have confidence 0.3 is lifted as one whose keypoints all have 1.

    weight_i = min(c_i / c, 1)^6,    c = 0.85 sum(c_j^2) / sum(c_j)

The correction divides the variance of a keypoint's noise by its weight. A keypoint below
`TRUSTED_RATIO` of c is hidden from the network, and neither the residual nor the position of the
object depends on it.

Source: ours, not in the paper.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

TRUSTED_RATIO = 0.5
"""Confidence relative to c below which the network takes a keypoint as missing."""
FULL_RATIO = 0.85
"""Confidence relative to the mean, weighted by confidence, from which on the weight is 1."""
_TRUSTED_WEIGHT = TRUSTED_RATIO**6


def relative_confidence(confidence: NDArray[Any]) -> NDArray[np.float64]:
    """Return min(c_i / c, 1) (n, p): the confidence relative to that of the object's keypoints.

    Args:
        confidence: (n, p) of the detector; 0 where missing, above 1 counts as 1.
    """
    c = np.minimum(confidence, 1.0).astype(np.float64)
    usual = FULL_RATIO * (c * c).sum(1) / np.maximum(c.sum(1), 1e-30)
    ratio: NDArray[np.float64] = np.minimum(c / np.maximum(usual, 1e-30)[:, None], 1)
    return ratio


def keypoint_weight(confidence: NDArray[Any]) -> NDArray[np.float64]:
    """Return the weights (n, p) in [0, 1] of keypoints; 0 where missing.

    Args:
        confidence: (n, p) of the detector; 0 where missing, above 1 counts as 1.
    """
    square = relative_confidence(confidence) ** 2
    weight: NDArray[np.float64] = square * square * square
    return weight


def trusted(weight: NDArray[Any]) -> NDArray[np.bool_]:
    """Return which keypoints (n, p) of these weights the network reads."""
    reads: NDArray[np.bool_] = weight >= _TRUSTED_WEIGHT
    return reads
