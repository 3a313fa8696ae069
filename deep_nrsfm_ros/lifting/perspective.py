"""Objects at their place before a camera whose intrinsics are known.

A weak-perspective camera sees along the optical axis. An object beside the axis is seen
along another ray, and would come out turned by the angle between the two. So a virtual camera is
turned towards each object, what it would see is lifted, and the result is turned back. The place
follows from the rays: x + t_x = u (z + t_z) and y + t_y = v (z + t_z) are linear in t, which is in
the unit of the reference length.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from deep_nrsfm_ros.lifting.intrinsics import Intrinsics
from deep_nrsfm_ros.lifting.lifter import Lifted, Lifter, mark_not_lifted
from deep_nrsfm_ros.lifting.numpy_backend import Float32
from deep_nrsfm_ros.nrsfm.geometry import Floats, weak_perspective

_NEAREST = 0.1  # cosine of the widest angle between a point and its object's ray


class VirtualViews(NamedTuple):
    """What virtual cameras see that are turned towards one of n objects each."""

    points: Float32  # (n, p, 2) on the plane z = 1 of its camera; 0 where missing
    confidence: Float32  # (n, p) 0 where missing, as well as where no ray leads to the pixel
    turns: NDArray[np.float64]  # (n, 3, 3) from the camera to the virtual one: p_v = turn p


def virtual_views(intrinsics: Intrinsics, points: Float32, confidence: Float32) -> VirtualViews:
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
    views = np.where(mask, seen[..., :2], 0) / np.where(mask, depth, 1)
    return VirtualViews(
        views.astype(np.float32), np.where(visible, confidence, np.float32(0)), turns
    )


def lift_perspective(
    lifter: Lifter, intrinsics: Intrinsics, points: Float32, confidence: Float32
) -> Lifted:
    """Lift keypoints (n, p, 2) in pixels as `Lifter` does, with the shapes at their place.

    The optical frame's zero is the camera, not the shape's centre; rotations are to that frame.
    W = scale S[..., :2] + translation holds as well as weak perspective can. Objects that come
    out behind the camera are NaN.
    """
    views = virtual_views(intrinsics, points, confidence)
    lifted = lifter(views.points, views.confidence, perspective=True)
    visible = views.confidence > 0
    place = solve_translation(lifted.shapes, views.points, visible)
    lost = ~(place[:, 2] > 0)
    back = views.turns.astype(np.float32)
    S = ((lifted.shapes + place[:, None]) @ back).astype(np.float32)
    scale, translation = weak_perspective(points, S[..., :2], visible)
    placed = lifted._replace(
        shapes=S,
        rotations=back.swapaxes(1, 2) @ lifted.rotations,
        scale=scale,
        translation=translation,
    )
    return mark_not_lifted(placed, lost) if lost.any() else placed


def solve_translation(S: Floats, rays: Floats, visible: NDArray[np.bool_]) -> Floats:
    """Return the places t (n, 3) from which S + t is seen along the rays best.

    Least squares, over the visible points, of x + t_x - u (z + t_z) and the same of y. S: (n, p, 3)
    in camera axes, which look at the object. rays: (n, p, 2), (u, v) on the plane z = 1.
    """
    m = visible.astype(S.dtype)
    n = np.maximum(m.sum(1), 1)
    u = (rays * m[..., None]).sum(1) / n[:, None]
    r = rays * S[..., 2:] - S[..., :2]  # t_x - u t_z = r
    mean = (r * m[..., None]).sum(1) / n[:, None]
    U, V = (rays - u[:, None]) * m[..., None], (r - mean[:, None]) * m[..., None]
    z = -(U * V).sum((1, 2)) / np.maximum((U * U).sum((1, 2)), 1e-12)
    place: Floats = np.column_stack((mean + u * z[:, None], z))
    return place


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
