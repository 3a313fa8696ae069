"""Calibrated cameras and the triangulation of what several of them see."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from deep_nrsfm_ros.lifting.intrinsics import Intrinsics

Array: TypeAlias = NDArray[np.float64]

_OUTLIER = 10.0  # pixels of reprojection error at which a detection counts half


@dataclass(frozen=True)
class Camera:
    """A perspective camera with OpenCV's lens distortion.

    matrix: (3, 3) intrinsics in pixels. distortion: k1 k2 p1 p2.
    rotation: (3, 3) and translation: (3,) take a world point X to rotation @ X + translation in
        the optical frame: x right, y down, z forward, in the unit of the world.
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
        """Return what does not depend on where the camera stands."""
        focal, principal = self.matrix.diagonal(), self.matrix[:2, 2]
        return Intrinsics(
            (float(focal[0]), float(focal[1])),
            (float(principal[0]), float(principal[1])),
            tuple(self.distortion.tolist()),
        )

    def project(self, world: Array) -> Array:
        """Return the pixels (..., 2) of world points (..., 3)."""
        inside = self.to_camera(world)
        return self.intrinsics.pixels(inside[..., :2] / inside[..., 2:])

    def undistort(self, pixels: Array) -> Array:
        """Return the pixels (..., 2) that a camera without a lens would have seen."""
        intrinsics = self.intrinsics
        return intrinsics.without_lens().pixels(intrinsics.rays(pixels))

    def without_lens(self) -> Camera:
        """Return the camera that sees what `undistort` returns."""
        return replace(self, distortion=np.zeros(4))


def triangulate(
    cameras: list[Camera], pixels: Array, weights: Array, rounds: int = 8
) -> tuple[Array, Array]:
    """Return world points (..., 3) and reprojected minus seen pixels (c, ..., 2) of each view.

    cameras: c of them, without lens. pixels: (c, ..., 2), undistorted. weights: (c, ...), 0 where
    not seen. Linear least squares, reweighted by the inverse depth and by the error of each view,
    so that a wrong detection in one view does not drag the point along. NaN where fewer than two
    cameras see the point.
    """
    inner = (1,) * (weights.ndim - 1)
    projections = np.stack(
        [c.matrix @ np.column_stack([c.rotation, c.translation]) for c in cameras]
    )
    first, third = (
        projections[:, rows].reshape(-1, *inner, n, 4)
        for rows, n in ((slice(2), 2), (slice(2, 3), 1))
    )
    # u * depth = first row . X, so (first - u * third) . (X, 1) = 0, and that over depth is pixels.
    system = first - pixels[..., None] * third
    seen = (weights > 0) & ((weights > 0).sum(0) >= 2)
    factor = np.where(seen, weights, 0.0)
    for _ in range(rounds):
        weighted = factor[..., None, None] ** 2 * system[..., :3]
        normal = np.einsum("c...ij,c...ik->...jk", weighted, system[..., :3])
        right = -np.einsum("c...ij,c...i->...j", weighted, system[..., 3])
        normal[~seen.any(0)] = np.eye(3)
        points = np.linalg.solve(normal, right[..., None])[..., 0]
        depth = (third[..., 0, :3] * points).sum(-1) + third[..., 0, 3]
        residual = (system[..., :3] @ points[..., None])[..., 0] + system[..., 3]
        residual /= depth[..., None]
        robust = 1 / np.sqrt(1 + (np.linalg.norm(residual, axis=-1) / _OUTLIER) ** 2)
        factor = np.where(seen, weights * robust / np.abs(depth), 0.0)
    points[~seen.any(0)] = np.nan
    return points, np.where(seen[..., None], residual, np.nan)
