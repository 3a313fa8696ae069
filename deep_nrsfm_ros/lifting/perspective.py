# SPDX-License-Identifier: Apache-2.0
"""Lifting before a perspective camera whose intrinsics are known.

A weak-perspective camera sees along the optical axis. An object beside the axis is seen along
another ray, and its rotation would come out wrong by the angle between the two. Therefore each
object gets a virtual camera that is rotated towards it; the view of that camera is lifted, and the
result is rotated back. The position t of the object follows from the rays (u, v, 1) of its points:
x + t_x = u (z + t_z) and y + t_y = v (z + t_z) are linear in t. Its unit is that of the reference
length.

Source: ours, not in the paper.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from deep_nrsfm_ros.lifting.history import Context
from deep_nrsfm_ros.lifting.intrinsics import Intrinsics
from deep_nrsfm_ros.lifting.lifter import Lifted, Lifter, mark_not_lifted
from deep_nrsfm_ros.lifting.numpy_backend import Float32
from deep_nrsfm_ros.lifting.weights import keypoint_weight, trusted
from deep_nrsfm_ros.nrsfm.geometry import Floats, weak_perspective

_MIN_COSINE = 0.1  # of the angle between the rays of a point and of its object


class VirtualViews(NamedTuple):
    """Views of n virtual cameras, each rotated towards one object.

    Attributes:
        points: (n, p, 2) on the plane z = 1 of the virtual camera; 0 where missing.
        confidence: (n, p) of the detector; 0 where missing or where no ray reaches the pixel.
        rotations: (n, 3, 3) from the camera to the virtual camera, p_virtual = R p_camera.
    """

    points: Float32
    confidence: Float32
    rotations: NDArray[np.float64]


def virtual_views(intrinsics: Intrinsics, points: Float32, confidence: Float32) -> VirtualViews:
    """Return the view of a virtual camera towards the mean trusted ray of each object.

    Args:
        intrinsics: of the camera.
        points: (n, p, 2) pixels.
        confidence: (n, p) in [0, 1], 0 = missing.
    """
    rays = intrinsics.rays(points)
    visible = (confidence > 0) & ~np.isnan(rays[..., 0])
    rays[~visible] = 0
    axis = np.ones((len(rays), 3))
    aimed = visible & trusted(keypoint_weight(confidence))
    axis[:, :2] = (rays * aimed[..., None]).sum(1) / np.maximum(aimed.sum(1), 1)[:, None]
    rotations = _rotations_to_z(axis / np.linalg.norm(axis, axis=1, keepdims=True))
    rotated = rays @ rotations[:, :, :2].swapaxes(1, 2) + rotations[:, None, :, 2]
    depth = rotated[..., 2:]
    visible &= depth[..., 0] > _MIN_COSINE
    mask = visible[..., None]
    projected = np.where(mask, rotated[..., :2], 0) / np.where(mask, depth, 1)
    visible_confidence = np.where(visible, confidence, np.float32(0))
    return VirtualViews(projected.astype(np.float32), visible_confidence, rotations)


def lift_perspective(
    lifter: Lifter,
    intrinsics: Intrinsics,
    points: Float32,
    confidence: Float32,
    context: Context | None = None,
) -> Lifted:
    """Lift keypoints to shapes at their positions in the camera's optical frame.

    The origin is the camera, not the shape's centre, and rotations lead to the optical frame.
    Scale and translation fit W = scale S[..., :2] + translation by least squares. Objects whose
    position comes out behind the camera are not lifted.

    Args:
        lifter: a model with its options.
        intrinsics: of the camera.
        points: (n, p, 2) pixels in the model's layout.
        confidence: (n, p) in [0, 1], 0 = missing.
        context: as in `Lifter.lift`, in the camera's axes.

    Raises:
        ValueError: the shapes do not fit the model.
    """
    views = virtual_views(intrinsics, points, confidence)
    if context:
        context = context._replace(to_view=np.ascontiguousarray(views.rotations))
    lifted = lifter.lift(views.points, views.confidence, perspective=True, context=context)
    visible = trusted(keypoint_weight(views.confidence))
    position = solve_translation(lifted.shapes, views.points, visible)
    not_lifted = ~(position[:, 2] > 0)
    to_virtual = views.rotations.astype(np.float32)
    S = ((lifted.shapes + position[:, None]) @ to_virtual).astype(np.float32)
    scale, translation = weak_perspective(points, S[..., :2], visible)
    positioned = lifted._replace(
        shapes=S,
        rotations=to_virtual.swapaxes(1, 2) @ lifted.rotations,
        scale=scale,
        translation=translation,
    )
    return mark_not_lifted(positioned, not_lifted) if not_lifted.any() else positioned


def solve_translation(S: Floats, rays: Floats, visible: NDArray[np.bool_]) -> Floats:
    """Return the translation t (n, 3) with which S + t projects best onto the rays.

    Minimises the squares of x + t_x - u (z + t_z) and of y + t_y - v (z + t_z) over the visible
    points.

    Args:
        S: (n, p, 3) in the axes of the virtual camera.
        rays: (n, p, 2) u and v on its plane z = 1.
        visible: (n, p).
    """
    m = visible.astype(S.dtype)
    n = np.maximum(m.sum(1), 1)
    u = (rays * m[..., None]).sum(1) / n[:, None]
    r = rays * S[..., 2:] - S[..., :2]  # t_x - u t_z = r
    mean = (r * m[..., None]).sum(1) / n[:, None]
    U, V = (rays - u[:, None]) * m[..., None], (r - mean[:, None]) * m[..., None]
    z = -(U * V).sum((1, 2)) / np.maximum((U * U).sum((1, 2)), 1e-12)
    translation: Floats = np.column_stack((mean + u * z[:, None], z))
    return translation


def _rotations_to_z(axis: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the smallest rotations (n, 3, 3) that take unit vectors (n, 3), z > 0, to z."""
    x, y, z = axis.T
    k = 1 / (1 + z)
    rows = (
        (1 - x * x * k, -x * y * k, -x),
        (-x * y * k, 1 - y * y * k, -y),
        (x, y, z),
    )
    rotations: NDArray[np.float64] = np.moveaxis(np.array(rows), -1, 0)
    return rotations
