# SPDX-License-Identifier: Apache-2.0
"""Hands as right hands: left and right told apart by their places, and one side mirrored.

A model of hands learns right hands. Detectors report both, and recordings often do not say which is
which. An orthographic image does not tell either: a left palm and the back of a right hand look
alike. So a mistake here makes no reprojection error; it teaches a mirrored depth.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from deep_nrsfm_ros.layouts.presets import preset

Float32 = NDArray[np.float32]

_MIRROR = np.array([-1, 1], np.float32)


def mirrored(points: Float32) -> Float32:
    """Return keypoints (..., 2) of the mirrored image: x with the other sign."""
    return points * _MIRROR


def right_hands(points: Float32, *, mirrored_image: bool = False) -> Float32:
    """Return both hands of people who face the camera as right hands, sorted by their places.

    The right hand of a person who faces the camera is on the left of the image. Crossed hands are
    mistaken for each other.

    Args:
        points: (f, 2, 21, 2) both hands of a person in f frames, in any order and unit.
        mirrored_image: whether the image was mirrored before detection, as selfie cameras do.

    Returns:
        (2f, 21, 2): the right hands, then the left ones, mirrored.
    """
    if mirrored_image:
        points = mirrored(points)
    order = points[..., 0].mean(2).argsort(1)
    in_order = np.take_along_axis(points, order[:, :, None, None], 1)
    return np.concatenate((in_order[:, 0], mirrored(in_order[:, 1])))


def palms_as_right_hands(points: Float32) -> Float32:
    """Return single hands (f, 21, 2) as right hands, as if each showed its palm to the camera.

    For gestures shown to a camera, where nothing else tells left from right.
    """
    layout = preset("hand21")
    wrist, index, pinky = (layout.index(k) for k in ("wrist", "index_mcp", "pinky_mcp"))
    a, b = points[:, index] - points[:, wrist], points[:, pinky] - points[:, wrist]
    # A right palm with its fingers up has the index finger right of the little one: from one to the
    # other the turn is anticlockwise, which is negative with y down.
    left = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0] > 0
    return np.where(left[:, None, None], mirrored(points), points)
