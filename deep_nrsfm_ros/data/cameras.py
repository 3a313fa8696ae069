# SPDX-License-Identifier: Apache-2.0
"""Calibrated cameras, and triangulation of points from several of them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from deep_nrsfm_ros.lifting.intrinsics import Intrinsics

Array: TypeAlias = NDArray[np.float64]

_OUTLIER = 10.0  # reprojection error in pixels at which a detection has half its weight


@dataclass(frozen=True)
class Camera:
    """A perspective camera with the lens distortion of OpenCV.

    Attributes:
        name: e.g. "cam01".
        matrix: (3, 3) intrinsics in pixels.
        distortion: (4,) k1 k2 p1 p2.
        rotation: (3, 3) from world to camera.
        translation: (3,) in world units: a world point X is at rotation @ X + translation in the
            optical frame (x right, y down, z forward).
        size: width and height in pixels.
    """

    name: str
    matrix: Array
    distortion: Array
    rotation: Array
    translation: Array
    size: tuple[int, int]

    def to_camera(self, world: Array) -> Array:
        """Return world points (..., 3) in the optical frame."""
        return world @ self.rotation.T + self.translation

    @property
    def intrinsics(self) -> Intrinsics:
        """Return focal lengths, principal point and distortion."""
        focal, principal = self.matrix.diagonal(), self.matrix[:2, 2]
        return Intrinsics(
            (float(focal[0]), float(focal[1])),
            (float(principal[0]), float(principal[1])),
            tuple(self.distortion.tolist()),
        )

    def project(self, world: Array) -> Array:
        """Return the pixels (..., 2) of world points (..., 3)."""
        X = self.to_camera(world)
        return self.intrinsics.pixels(X[..., :2] / X[..., 2:])

    def undistort(self, pixels: Array) -> Array:
        """Return pixels (..., 2) without lens distortion."""
        intrinsics = self.intrinsics
        return intrinsics.without_lens().pixels(intrinsics.rays(pixels))

    def without_lens(self) -> Camera:
        """Return the camera without distortion, which projects to the pixels of `undistort`."""
        return replace(self, distortion=np.zeros(4))


def triangulate(
    cameras: list[Camera], pixels: Array, weights: Array, rounds: int = 8
) -> tuple[Array, Array]:
    """Return points triangulated from several views.

    Iteratively reweighted linear least squares. The weights are the inverse depth and a robust
    function of the error, so that a wrong detection in one view has little influence.

    Args:
        cameras: c cameras without distortion.
        pixels: (c, ..., 2) undistorted.
        weights: (c, ...), e.g. confidences; 0 where missing.
        rounds: number of reweightings.

    Returns:
        Points (..., 3) in world units, and residuals (c, ..., 2) in pixels, reprojection minus
        detection. Both are NaN where fewer than two cameras see the point.
    """
    inner = (1,) * (weights.ndim - 1)
    projections = np.stack(
        [c.matrix @ np.column_stack([c.rotation, c.translation]) for c in cameras]
    )
    first, third = (
        projections[:, rows].reshape(-1, *inner, n, 4)
        for rows, n in ((slice(2), 2), (slice(2, 3), 1))
    )
    # u * depth = first . (X, 1), so (first - u * third) . (X, 1) = 0; over depth it is in pixels.
    system = first - pixels[..., None] * third
    visible = (weights > 0) & ((weights > 0).sum(0) >= 2)
    factor = np.where(visible, weights, 0.0)
    for _ in range(rounds):
        weighted = factor[..., None, None] ** 2 * system[..., :3]
        normal = np.einsum("c...ij,c...ik->...jk", weighted, system[..., :3])
        right = -np.einsum("c...ij,c...i->...j", weighted, system[..., 3])
        normal[~visible.any(0)] = np.eye(3)
        points = np.linalg.solve(normal, right[..., None])[..., 0]
        depth = (third[..., 0, :3] * points).sum(-1) + third[..., 0, 3]
        residual = (system[..., :3] @ points[..., None])[..., 0] + system[..., 3]
        residual /= depth[..., None]
        robust = 1 / np.sqrt(1 + (np.linalg.norm(residual, axis=-1) / _OUTLIER) ** 2)
        factor = np.where(visible, weights * robust / np.abs(depth), 0.0)
    points[~visible.any(0)] = np.nan
    return points, np.where(visible[..., None], residual, np.nan)
