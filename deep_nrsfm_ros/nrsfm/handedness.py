# SPDX-License-Identifier: Apache-2.0
"""Handedness: whether lifted shapes are mirrored in depth.

No 2D image tells an object from its mirror image. The layout names tetrahedra of keypoints (left,
right, up, front), e.g. hips, neck and nose: on the real object the front keypoint lies before the
plane of the other three. Each tetrahedron has a vote.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from deep_nrsfm_ros.layouts.layout import KeypointLayout, Tetrahedron
from deep_nrsfm_ros.nrsfm.geometry import centre

Floats = NDArray[Any]

MIN_VISIBLE_SHARE = 0.1
"""Share of the shapes in which all four keypoints must be visible for their vote to count."""


def votes(S: Floats, layout: KeypointLayout) -> Floats:
    """Return the distance of each front keypoint before the plane of the other three.

    A distance, not the volume of the tetrahedron: four keypoints far from each other would outvote
    all others by their volume.

    Args:
        S: (f, p, 3) shapes, in any unit.
        layout: with v tetrahedra in `handedness`.

    Returns:
        (f, v) in RMS radii of the shape: positive on the real object (0.5 typical), negative where
        depth is mirrored.

    Raises:
        ValueError: the layout has no handedness.
    """
    if not layout.handedness:
        raise ValueError(f"layout {layout.name!r} has no handedness; name its four keypoints")
    left, right, up, front = (S[:, corner] for corner in _corners(layout).T)
    normal = np.cross(left - right, up - right)
    heights = ((front - right) * normal).sum(-1) / _norm(normal)
    radius = np.sqrt((centre(S) ** 2).sum(2).mean(1, keepdims=True))
    distances: Floats = heights / np.maximum(radius, 1e-12)
    return distances


def is_mirrored(
    S: Floats, layout: KeypointLayout, visible: NDArray[np.bool_] | None = None
) -> bool:
    """Return whether the shapes as a whole are mirrored: the sum of the median votes is negative.

    Medians make the vote robust: a few wrong shapes, a keypoint close to its plane, or one that is
    as often before as behind it, have little influence.

    Args:
        S: (f, p, 3) shapes, in any unit.
        layout: with a handedness.
        visible: (f, p) visible keypoints; None: all. Only shapes in which all four keypoints of a
            tetrahedron are visible vote, because missing keypoints may be lifted anywhere.

    Raises:
        ValueError: the layout has no handedness.
    """
    return bool(sum(np.median(vote) for _, vote in _counted(S, layout, visible)) < 0)


def front_shares(
    S: Floats, layout: KeypointLayout, visible: NDArray[np.bool_] | None = None
) -> list[tuple[str, float]]:
    """Return the front of each tetrahedron, with the share of the shapes in which it is there.

    On a sound model, each tetrahedron has the right side in most of the shapes. If one has not,
    depth is wrong in part, and mirroring the whole shape does not repair it.

    Args:
        S: (f, p, 3) shapes as a model lifts them, in any unit.
        layout: the layout of the shapes; without a handedness there are no shares.
        visible: (f, p) visible keypoints; None: all. As for `is_mirrored`.
    """
    counted = _counted(S, layout, visible) if layout.handedness else []
    return [(front, float((vote > 0).mean())) for (*_, front), vote in counted]


def object_frame(
    S: Floats, layout: KeypointLayout, visible: NDArray[np.bool_] | None = None
) -> NDArray[np.float32]:
    """Return the orthonormal A (3, 3) from the network's axes to the object's: S A.

    A contains a reflection (det -1) if the shapes are mirrored. It rotates the mean shape so that
    x points to the front, y to the left and z up (REP-103), by the first tetrahedron of the layout.
    A layout without handedness keeps the network's axes: A = I.

    Args:
        S: (f, p, 3) shapes in the network's axes, in any unit.
        layout: the layout of the shapes.
        visible: (f, p) visible keypoints; None: all. As for `is_mirrored`.
    """
    A = np.eye(3)
    if not layout.handedness:
        return A.astype(np.float32)
    if is_mirrored(S, layout, visible):
        A[2, 2] = -1
    left, right, up, _ = (S @ A).mean(0)[_corners(layout)[0]]
    y = (left - right) / _norm(left - right)
    z = up - (left + right) / 2
    z -= (z @ y) * y
    axes = np.stack((np.cross(y, z / _norm(z)), y, z / _norm(z)), 1)
    return np.asarray(A @ axes, np.float32)


def _counted(
    S: Floats, layout: KeypointLayout, visible: NDArray[np.bool_] | None
) -> list[tuple[Tetrahedron, Floats]]:
    """Return each tetrahedron that counts, with the votes of the shapes that count for it."""
    distances = votes(S, layout)
    counts = np.full(distances.shape, True)
    chosen = list(range(len(layout.handedness)))
    if visible is not None:
        all_four = np.asarray(visible[:, _corners(layout)].all(2), bool)
        enough = np.flatnonzero(all_four.mean(0) >= MIN_VISIBLE_SHARE).tolist()
        if enough:
            counts, chosen = all_four, enough
    return [(layout.handedness[i], distances[counts[:, i], i]) for i in chosen]


def _corners(layout: KeypointLayout) -> NDArray[np.int_]:
    """Return the indices (v, 4) of the keypoints of each tetrahedron."""
    return np.array([[layout.index(name) for name in four] for four in layout.handedness])


def _norm(vectors: Floats) -> Floats:
    """Return the lengths (...) of vectors (..., 3), at least 1e-12 so that they can divide."""
    lengths: Floats = np.maximum(np.linalg.norm(vectors, axis=-1), 1e-12)
    return lengths
