"""Objects at their place before a camera whose intrinsics are known.

A weak-perspective camera sees along the optical axis. An object beside the axis is seen
along another ray, and would come out turned by the angle between the two. So a virtual camera is
turned towards each object, what it would see is lifted, and the result is turned back. Its scale
is then that of perspective, 1 / z, from which the place follows: z = 1 / scale, in the unit of
the reference length.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from deep_nrsfm_ros.nrsfm.geometry import weak_perspective
from deep_nrsfm_ros.nrsfm.intrinsics import Intrinsics
from deep_nrsfm_ros.nrsfm.lifting import Float32, Lifted, Lifter, blank

_NEAREST = 0.1  # cosine of the widest angle between a point and its object's ray


class Aimed(NamedTuple):
    """What virtual cameras see that are turned towards one of n objects each."""

    points: Float32  # (n, p, 2) on the plane z = 1 of its camera; 0 where missing
    confidence: Float32  # (n, p) 0 where missing, as well as where no ray leads to the pixel
    turns: NDArray[np.float64]  # (n, 3, 3) from the camera to the virtual one: p_v = turn p


def aim(intrinsics: Intrinsics, points: Float32, confidence: Float32) -> Aimed:
    """Turn a camera towards the centroid of the visible points of each object.

    points: (n, p, 2) pixels. confidence: (n, p), 0 = missing.
    """
    rays = intrinsics.rays(points)
    visible = (confidence > 0) & ~np.isnan(rays[..., 0])
    rays[~visible] = 0
    axis = np.ones((len(rays), 3))
    axis[:, :2] = rays.sum(1) / np.maximum(visible.sum(1), 1)[:, None]
    turns = _towards(axis / np.linalg.norm(axis, axis=1, keepdims=True))
    seen = rays @ turns[:, :, :2].swapaxes(1, 2) + turns[:, None, :, 2]
    depth = seen[..., 2:]
    visible &= depth[..., 0] > _NEAREST
    mask = visible[..., None]
    aimed = np.where(mask, seen[..., :2], 0) / np.where(mask, depth, 1)
    return Aimed(aimed.astype(np.float32), np.where(visible, confidence, np.float32(0)), turns)


def lift_at_place(
    lifter: Lifter, intrinsics: Intrinsics, points: Float32, confidence: Float32
) -> Lifted:
    """Lift keypoints (n, p, 2) in pixels as `Lifter` does, with the shapes at their place.

    The optical frame's zero is the camera, not the shape's centre; rotations are to that frame.
    W = scale S[..., :2] + translation holds as well as weak perspective can. Objects whose scale
    comes out as no scale are NaN.
    """
    aimed = aim(intrinsics, points, confidence)
    lifted = lifter(aimed.points, aimed.confidence)
    lost = ~(lifted.scale > 0)
    z = 1 / np.where(lost, np.float32(np.nan), lifted.scale)
    place = np.column_stack((z[:, None] * lifted.translation, z))
    back = aimed.turns.astype(np.float32)
    S = ((lifted.shapes + place[:, None]) @ back).astype(np.float32)
    scale, translation = weak_perspective(points, S[..., :2], aimed.confidence > 0)
    placed = lifted._replace(
        shapes=S,
        rotations=back.swapaxes(1, 2) @ lifted.rotations,
        scale=scale,
        translation=translation,
    )
    return blank(placed, lost) if lost.any() else placed


def _towards(axis: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the least rotations (n, 3, 3) that take unit vectors (n, 3), z > 0, to z."""
    x, y, z = axis.T
    share = 1 / (1 + z)
    rows = (
        (1 - x * x * share, -x * y * share, -x),
        (-x * y * share, 1 - y * y * share, -y),
        (x, y, z),
    )
    turns: NDArray[np.float64] = np.moveaxis(np.array(rows), -1, 0)
    return turns
