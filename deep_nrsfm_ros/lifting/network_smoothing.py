# SPDX-License-Identifier: Apache-2.0
"""Smoothing of what the network finds, before the keypoints correct it: no lag in the image.

The shape and the rotation that a network finds jump from frame to frame, because each frame is seen
for itself. Both are smoothed over time here, and then corrected by the keypoints of the present
frame: what the image shows is met at once, and only what it does not show, the depth above all,
follows slowly. A filter after the correction would lag in the image.

A keypoint that is missing in the image keeps its place in the object for longer.

Where a network turns an object over from one frame to the next, as a person whose front it takes
for the back, no smoothing helps: the mean of both is neither. So frames vote.

Symbols: n objects, p keypoints, S (n, p, 3) shapes in object axes, R (n, 3, 3) from object axes to
those of the camera.

Source: ours, not in the paper.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from deep_nrsfm_ros.nrsfm.geometry import Floats, rotation_from_vector, rotation_vector
from deep_nrsfm_ros.nrsfm.metrics import rotation_angles

MAX_TURN = 60.0
"""Degrees from the remembered rotation to a new one above which a frame is taken for turned."""
MAX_AGREEMENT = 0.5
"""Most seconds for which turned frames are not believed."""


def gain(seconds: Floats, time_constant: float) -> Floats:
    """Return the weight in (0, 1] of the newest value in a low-pass, after `seconds`."""
    if not time_constant:
        return np.ones_like(seconds)
    weight: Floats = 1 - np.exp(-seconds / time_constant)
    return weight


def smooth_shapes(
    previous: Floats,
    S: Floats,
    visible: NDArray[np.bool_],
    seconds: Floats,
    times: tuple[float, float],
) -> Floats:
    """Return the smoothed centred shapes (n, p, 3).

    The previous shape first gets the size of the new one: units change with the visible keypoints.

    Args:
        previous: (n, p, 3) smoothed shapes of the last frames, centred.
        S: (n, p, 3) new shapes, centred.
        visible: (n, p) whether the keypoint is in the image.
        seconds: (n,) since the last frames.
        times: time constants in seconds of a visible and of a missing keypoint.
    """
    sizes = np.linalg.norm(S, axis=(1, 2)), np.linalg.norm(previous, axis=(1, 2))
    predicted = previous * (sizes[0] / np.maximum(sizes[1], 1e-9))[:, None, None]
    seen, hidden = (gain(seconds, time)[:, None] for time in times)
    smoothed: Floats = predicted + np.where(visible, seen, hidden)[..., None] * (S - predicted)
    return smoothed


def weigh_turns(
    previous: Floats, R: Floats, agreement: Floats, seconds: Floats
) -> tuple[NDArray[np.bool_], NDArray[np.bool_], Floats]:
    """Return which new rotations are not believed, which are begun anew with, and the agreement.

    The agreement is the time for which the network has found rotations near the remembered one, at
    most `MAX_AGREEMENT`. The time of turned frames is taken off. While some is left, the object
    stays as it is remembered; when it is used up, the new rotation is the remembered one.

    Args:
        previous: (n, 3, 3) remembered rotations.
        R: (n, 3, 3) new rotations.
        agreement: (n,) seconds, before the frame.
        seconds: (n,) since the last frames.
    """
    turned = rotation_angles(R @ previous.swapaxes(1, 2)) > MAX_TURN
    left = np.where(turned, agreement - seconds, np.minimum(agreement + seconds, MAX_AGREEMENT))
    begins = turned & ~(left > 0)
    return turned & ~begins, begins, np.where(begins, 0, left)


def smooth_rotations(previous: Floats, R: Floats, seconds: Floats, time: float) -> Floats:
    """Return the rotations (n, 3, 3) a part of the way from `previous` to R.

    Args:
        previous: (n, 3, 3) smoothed rotations of the last frames.
        R: (n, 3, 3) new rotations.
        seconds: (n,) since the last frames.
        time: time constant in seconds.
    """
    smoothed = [
        rotation_from_vector(part * rotation_vector(new @ old.T)) @ old
        for old, new, part in zip(previous, R, gain(seconds, time), strict=True)
    ]
    return np.array(smoothed).reshape(R.shape)
